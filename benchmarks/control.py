"""Control through contact: a throw that knocks a cube off the table, found with and without gradients.

The throw of a ball is sought (examples/studies/knock_off.toml) by the gradients of MLS-MPM through the contact on the
grid, and without gradients.
"""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common.pages import EXAMPLES, head, picture, row
from benchmarks.common.timing import measure
from pigjax import io
from pigjax.study import experiment, load_study
from pigjax.study.objectives import objective_of
from pigjax.study.optimize import Bounds, fit, search

STUDIES = EXAMPLES / "studies"
THROW = "objects.soccerball.velocity"
EDGE = -0.39  # of the table [m]
OFF = EDGE - 0.02  # a middle of the cube that is off [m]
WANTED = -0.5  # that the objective asks for [m]
WEAK = [0.1, -1.2, 0.3]  # reaches the cube and leaves it on the table
WIDE = [-0.8, -0.8, 0.2]  # passes it
HARD = [0.2, -2.5, 0.5]  # knocks it far off
STEPS, EVALUATIONS = 40, 112
HEADER = head("throw", "velocity [m/s]", "cube at the end: y [m]", "z [m]", "off")


@cache
def prepared():
    """Experiment, and bounds of the throw."""
    study = load_study(STUDIES / "knock_off.toml")
    throw = study.parameters[THROW]
    extremes = [{THROW: velocity} for velocity in (throw.low, throw.high, WEAK, WIDE, HARD)]
    made = experiment(study.to_scene(), alone=True, extremes=extremes)
    return made, {THROW: Bounds(throw.low, throw.high)}


def scores_of(outcome, approach=0.3):
    """`approach` is the weight of the nearest pass."""
    return objective_of("knock_off.py:objective", {"approach": approach}, STUDIES)(outcome)


def loss(values, shared):
    made, approach = shared
    scores = scores_of(made.with_parameters(values).simulate(), approach)
    return scores["loss"], scores


def start_of(velocity):
    return {THROW: jnp.asarray(velocity, jnp.float32)}


@jax.jit
def ending(values, made):
    outcome = made.with_parameters(values).simulate()
    return scores_of(outcome), outcome.experiment.video(outcome.trajectory)


def print_row(name, values):
    """Print a line of the table; gives the frames."""
    where, frames = ending(values, prepared()[0])
    y, z = float(where["y"]), float(where["z"])
    velocity = ", ".join(f"{v:.2f}" for v in np.asarray(values[THROW]))
    print(row(name, velocity, f"{y:.3f}", f"{z:.3f}", "yes" if y < OFF else "no"))
    return np.asarray(frames)


def descend(velocity):
    """Adam until the cube is off."""
    made, bounds = prepared()
    return fit(
        loss, start_of(velocity), 0.15, steps=STEPS, bounds=bounds, shared=(made, jnp.asarray(0.3)), has_aux=True,
        callback=lambda step: step.scores["y"] < OFF,
    )  # fmt: skip


def throw(options) -> str:
    start = start_of(WEAK)
    best, history = descend(WEAK)
    print(f"The table's edge is at y = {EDGE} m. Descent stops at the first throw that pushes the cube past it.\n")
    print(HEADER)
    rows = [print_row("start", start), print_row("found", best)]
    print(f"\nLoss {history.loss[0]:.3g} to {history.least:.2g} m² in {len(history)} gradients.")
    frames = [frame for frames in rows for frame in frames[1::2]]
    io.write_image(options.media / "control_throw.png", io.contact_sheet(frames, columns=len(frames) // 2))
    return "\n" + picture("control_throw.png", "Above the start, below the throw found, every second frame")


def miss(_) -> None:
    made, _ = prepared()
    slope = jax.jit(lambda values, shared: jax.grad(loss, has_aux=True)(values, shared)[0])
    for name, velocity in (("touches the cube", WEAK), ("misses it", WIDE)):
        steep = [float(jnp.linalg.norm(slope(start_of(velocity), (made, jnp.asarray(a)))[THROW])) for a in (0.0, 0.3)]
        print(f"Slope [m²/(m/s)] at a throw that {name}: {steep[0]:.1e} alone, {steep[1]:.1e} with the nearest pass.\n")
    best, history = descend(WIDE)
    print(HEADER)
    print_row("start", start_of(WIDE))
    print_row("found, with the pass", best)
    print(f"\n{len(history)} gradients.")


def cost(_) -> None:
    made, bounds = prepared()
    shared = made, jnp.asarray(0.3)
    once = measure(loss, start_of(WEAK), shared, windows=3).seconds
    print(f"One loss takes {once:.2f} s. Until the cube is off, compilation apart:\n")
    print(head("start", "method", "losses", "gradients", "s", "off"))
    for name, velocity in (("touches the cube", WEAK), ("misses it", WIDE)):
        _, history = descend(velocity)
        off = "yes" if history.scores["y"][-1] < OFF else "no"
        each = float(np.median(np.diff(history.seconds)))
        print(row(name, "Adam", 0, len(history), f"{len(history) * each:.0f}", off))
        _, history = search(
            lambda values, shared: loss(values, shared)[0], start_of(velocity), evaluations=EVALUATIONS, bounds=bounds,
            shared=shared, callback=lambda step: step.loss < (OFF - WANTED) ** 2,
        )  # fmt: skip
        off = "yes" if history.least < (OFF - WANTED) ** 2 else "no"
        print(row(name, "CMA-ES", len(history), 0, f"{len(history) * once:.0f}", off))


PARTS = {
    "throw": ("A throw that knocks the cube off", throw),
    "miss": ("From a throw that misses", miss),
    "cost": ("Cost beside a search without gradients", cost),
}
DEVICES = None
