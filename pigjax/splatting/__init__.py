"""Rasterization of Gaussian splats: projection, spherical harmonics, binning into tiles, compositing, contributions."""
