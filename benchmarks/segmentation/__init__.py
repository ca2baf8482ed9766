"""Studies of segmentation, one module each; `bench_segmentation.py` runs them and prints docs/SEGMENTATION.md."""
