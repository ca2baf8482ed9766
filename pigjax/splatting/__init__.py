"""Rasterization of Gaussian splats: projection, binning into tiles, compositing, contributions."""
