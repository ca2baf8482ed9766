"""Matter: displacement error of the Gaussians' particles against the finest grid, over the simulation's knobs."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np

from benchmarks.common.timing import in_turn
from benchmarks.tradeoff.errors import displacement_error, distance_travelled
from benchmarks.tradeoff.points import Point, by_scene, said_windows
from benchmarks.tradeoff.scenes import as_float64, simulate, source, tracers

PLOT = "tradeoff_matter.png"
KNOBS = {
    "elastic": {
        "draft, dx × 2": ("accuracy", {"dx": 0.05, "cfl": 0.8}),
        "draft": ("accuracy", {"dx": 0.0375, "cfl": 0.8}),
        "dx × 2": ("dx", {"dx": 0.05}),
        "dx × 1.5": ("dx", {"dx": 0.0375}),
        "dx / 1.4": ("dx", {"dx": 0.0175}),
        "reference": ("dx", {"dx": 0.0125}),
        "cfl 0.8": ("cfl", {"cfl": 0.8}),
        "cfl 0.4": ("cfl", {"cfl": 0.4}),
        "cfl 0.2": ("cfl", {"cfl": 0.2}),
        "cubic": ("kernel", {"kernel": "cubic"}),
        "4 a cell": ("particles per cell", {"particles_per_cell": 4}),
        "20 a cell": ("particles per cell", {"particles_per_cell": 20}),
    },
    "tabletop": {
        "draft, dx × 2": ("accuracy", {"dx": 0.024, "cfl": 0.8}),
        "draft": ("accuracy", {"dx": 0.018, "cfl": 0.8}),
        "dx × 1.5": ("dx", {"dx": 0.018}),
        "reference": ("dx", {"dx": 0.009}),
        "cfl 0.8": ("cfl", {"cfl": 0.8}),
        "cfl 0.4": ("cfl", {"cfl": 0.4}),
        "cubic": ("kernel", {"kernel": "cubic"}),
        "4 a cell": ("particles per cell", {"particles_per_cell": 4}),
    },
}
KNOBS["sand"] = KNOBS["elastic"]
COARSER = {"elastic": "dx / 1.4", "sand": "dx / 1.4", "tabletop": "standard"}


def study(options) -> str:
    """Tables of all scenes and one plot."""
    return by_scene(options, _study, PLOT, error="error of displacement (share of the distance travelled)")


def _study(name):
    of = source(name)
    settings = {"standard": ("standard", {}), **KNOBS[name]}
    plans = {key: of.plan(of.scene(simulation=fields)) for key, (_, fields) in settings.items()}
    scenes = {key: of.scene(simulation=fields) for key, (_, fields) in settings.items()}
    runs = {key: (lambda key=key: simulate(scenes[key], plans[key])[1].x) for key in settings}
    if name != "tabletop":
        settings["float64"] = ("precision", {})
        runs["float64"] = lambda: _in_float64(scenes["standard"], plans["standard"])
    windows = 3 if name != "tabletop" else 1
    timed = in_turn(runs, windows=windows)
    count = len(of.inputs.gaussians)
    ends = {key: _of_gaussians(plans.get(key, plans["standard"]), timed[key].result[-1], count) for key in settings}
    finest, path = plans["reference"], np.asarray(timed["reference"].result)
    rows, _ = tracers(finest, count)
    travelled = distance_travelled(np.concatenate([np.asarray(finest.particles.x)[None, rows], path[:, rows]]))
    body = np.asarray(of.labels.object_id)

    def error(x, reference):
        both = np.isfinite(x[:, 0]) & np.isfinite(reference[:, 0])
        return displacement_error(x[both], reference[both], travelled, body[both])

    points = []
    for key, (knob, _) in settings.items():
        if key != "reference":
            wrong = error(ends[key], ends["reference"])
            count_of = len(plans.get(key, plans["standard"]).particles)
            note = f"centre {wrong.centre:.1e}, shape {wrong.shape:.1e}; {count_of} particles"
            points.append(Point(key, knob, timed[key].seconds, wrong.total, timed[key].compile_seconds, note))
    nudged, reseeded = _floors(of, scenes["standard"], plans["standard"], count)
    floor = error(reseeded, ends["standard"]).total
    said = (
        f"{said_windows(windows)} "
        f"Reference: dx = {scenes['reference'].simulation.dx:g} m, {timed['reference'].seconds:.3g} s; it differs from"
        f" one step coarser ({COARSER[name]}) by {error(ends[COARSER[name]], ends['reference']).total:.1e}. Floors:"
        f" another seed of the filling moves the standard by {floor:.1e},"
        f" a nudge by 1 ulp by {error(nudged, ends['standard']).total:.1e}; smaller differences are noise."
    )
    return points, floor, said


def _of_gaussians(plan, x, count):
    """Positions by Gaussian [n 3], NaN where it has no particle."""
    rows, carried = tracers(plan, count)
    by_gaussian = np.full((count, 3), np.nan)
    by_gaussian[carried] = np.asarray(x)[rows]
    return by_gaussian


def _in_float64(scene, plan):
    with jax.enable_x64(True):
        parts = {name: as_float64(getattr(plan, name)) for name in ("particles", "table", "colliders")}
        return simulate(scene, replace(plan, **parts))[1].x


def _floors(of, scene, plan, count):
    """Ends of the standard after a nudge of every position by 1 ulp, and with another seed of the filling."""
    up = eqx.tree_at(lambda p: p.x, plan.particles, np.nextafter(np.asarray(plan.particles.x), np.float32(np.inf)))
    nudged = simulate(scene, replace(plan, particles=jax.tree.map(jax.numpy.asarray, up)))[0]
    other = of.plan(of.scene(simulation={"seed": 1}))
    reseeded = simulate(scene, other)[0]
    return _of_gaussians(plan, nudged.x, count), _of_gaussians(other, reseeded.x, count)
