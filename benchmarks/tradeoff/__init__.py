"""Error against time over every knob, one module per stage; `bench_tradeoff.py` runs them and prints docs/TRADEOFF.md."""
