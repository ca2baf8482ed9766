"""Studies of segmentation, one module each: `bench_segmentation.py` prints docs/results/SEGMENTATION.md."""
