"""Studies of segmentation, one module each."""
