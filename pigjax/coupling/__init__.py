"""Coupling of splats and matter: solids, filling and seeding, colliders from Gaussians, binding and posing."""
