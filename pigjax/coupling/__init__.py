"""Where splats and matter meet: seeding and filling, solids and their colliders, binding and posing."""
