"""Photos to Gaussians: initialisation, training, MCMC relocation, pruning."""
