"""Measurements of pigjax: `python -m benchmarks` lists them, `python -m benchmarks NAME [part ...]` runs one."""
