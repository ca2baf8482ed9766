"""Reconstruction of Gaussians from photos: initialisation, training, MCMC relocation, pruning."""
