"""pigjax: differentiable physics in 3D Gaussian splat scenes."""
