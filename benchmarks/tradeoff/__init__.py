"""Error against time over every knob, one module per stage; `bench_tradeoff.py` prints docs/results/TRADEOFF.md."""
