"""What a made-up scene requires, and round prices."""

import dataclasses

from pigjax.scene.costs import Body, Prices, Required

NEEDS = Required(
    bodies=(Body("duck", "neo_hookean", 1000, 8.0), Body("heap", "drucker_prager", 500, 8.0)),
    dx=0.02, nodes=4096, frames=10, substeps=20, gaussians=3000, moving=900, still=100, still_objects=1,
    sh_coefficients=4, colliders=1, pixels=64 * 48, states=11,
)  # fmt: skip
PRICES = Prices(
    run={"simulate": {"law neo_hookean": 1e-6, "law drucker_prager": 3e-6}, "draw": {"pixels": 1e-6}},
    compile={"simulate": {"start": 2.0}},
    memory={"start": 1e9, "particles": 1000.0},
    error={"neo_hookean": 0.05, "drucker_prager": 0.2},
    probe={"step": 0.1},
)


def scaled(needs, factor):
    return dataclasses.replace(needs, bodies=tuple(b._replace(particles=factor * b.particles) for b in needs.bodies))
