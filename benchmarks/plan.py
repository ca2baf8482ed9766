"""Predictions of `pigjax plan` beside measurements, and the fit of their prices.

`fit` runs small scenes, each in a process of its own without kept programs, and fits the prices of
pigjax/scene/costs.json, which `--write` replaces; prices that no scene needs stay as they are. `check` plans and runs
scenes that were not fitted on. The plant, which the repository does not carry, lies in `--data`; see its scene file.
"""

import json
import os
import tempfile
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import nnls

from benchmarks.common.command import start_worker
from benchmarks.common.pages import EXAMPLES, ROOT, head, row
from benchmarks.common.timing import machine, peak_memory
from pigjax.io.compile_cache import SWITCH
from pigjax.scene import costs, plan_scene, run_scene, scene_from
from pigjax.scene.decode import merged
from pigjax.scene.probe import probe

PRICES = ROOT / "pigjax" / "scene" / "costs.json"
_FRONTS = ("fixed_corotated", "neo_hookean", "stvk_hencky", "fibres", "drucker_prager")  # of `tradeoff`, by dx
_LEAST = 1 / 3  # of a known price
_TRUST = 0.1  # weight of the prices so far against that of one measurement
_COLD = {SWITCH: "off", "JAX_ENABLE_COMPILATION_CACHE": "false"}


class Case(NamedTuple):
    """A scene to run: a law of the cube that `tradeoff` makes, or a file of examples, with fields changed."""

    source: str
    changes: dict[str, dict[str, Any]]


FITTED = {
    "jelly cube": Case("elastic", {}),
    "jelly cube, fine": Case("elastic", {"simulation": {"dx": 0.0125, "frames": 4}}),
    "jelly cube, large pictures": Case("elastic", {"simulation": {"frames": 3}, "camera": {"width": 512}}),
    "sand cube": Case("sand", {}),
    "sand cube, fine": Case("sand", {"simulation": {"dx": 0.0125, "frames": 3}}),
    "tabletop": Case("tabletop/scene.toml", {"simulation": {"dx": 0.02, "frames": 4}}),
    "rubber": Case("materials/rubber.toml", {"simulation": {"frames": 6}}),
    "smooth water": Case(
        "materials/water.toml",
        {
            "simulation": {"frames": 6},
            "objects": {"cube": {"splats": "own", "refit": False, "surface": "smooth"}},
            "output": {"error_frames": 6},
        },
    ),
    "own splats under a lamp": Case(
        "elastic",
        {
            "simulation": {"frames": 4},
            "objects": {"cube": {"splats": "own"}},
            "light": {"direction": [0.3, 0.2, -1.0]},
            "output": {"error_frames": 4},
        },
    ),
    "snow cube": Case(
        "elastic",
        {
            "simulation": {"frames": 8},
            "objects": {"cube": {"model": "snow", "young": 1e5, "velocity": [3.0, 0.0, -3.0]}},
            "output": {"error_frames": 8},
        },
    ),
}
_METAL = {"model": "von_mises", "density": 2000, "young": 2e5, "poisson": 0.3, "yield_stress": 2e3}
_WATER = {"bottom": [0.3, 0.0, 0.1], "top": [0.3, 0.0, 0.3], "radius": 0.05, "material": "water", "bulk_modulus": 2e4}
_SAND = {"lower": [-0.35, -0.06, 0.05], "upper": [-0.23, 0.06, 0.3], "material": "sand", "young": 2e5, "grain": 0.2}
CHECKED = {
    "cup": Case("gallery/cup.toml", {"simulation": {"frames": 6}}),
    "sweep": Case("gallery/sweep.toml", {"simulation": {"frames": 10}}),
    "plant": Case("gallery/plant.toml", {"simulation": {"frames": 8}}),
    "two cubes that collide": Case(
        "elastic",
        {
            "simulation": {"frames": 12, "dx": 0.02, "contact_friction": 0.3},
            "objects": {
                "cube": {"model": "neo_hookean"},
                "other": {"gaussians": "cube.ply", "offset": [0.35, 0.0, 0.0], "velocity": [-1.5, 0.0, -1.0], **_METAL},
            },
            "camera": {"sweep": 60.0, "width": 320, "height": 240},
        },
    ),
    "snow under a lamp": Case(
        "elastic",
        {
            "simulation": {"frames": 12, "dx": 0.02},
            "objects": {"cube": {"model": "snow", "young": 2e5, "velocity": [2.0, 1.0, -2.0]}},
            "light": {"direction": [-0.2, 0.4, -1.0], "softness": 0.0},
            "camera": {"width": 320, "height": 320},
        },
    ),
    "poured water and sand": Case(
        "elastic",
        {
            "simulation": {"frames": 10},
            "volumes": {
                "water": {**_WATER, "colour": [0.2, 0.5, 0.8]},
                "sand": {**_SAND, "colour": [0.8, 0.6, 0.3]},
            },
        },
    ),
}


class Measured(NamedTuple):
    """One run."""

    needs: costs.Required
    run: dict[str, float]  # [s] by stage
    compile: dict[str, float]
    memory: float  # [bytes]
    probe: dict[str, float]  # [s]
    error: float | None  # of the motion, by a coarser grid
    planned: dict[str, Any] | None  # the prediction before the run


def fit(options) -> None:
    """Run the scenes of the fit, print their times beside those of the fitted prices, and write these."""
    runs = {}
    for name in options.fitted:
        if (found := _child(name)) is not None:
            runs[name] = found
    before = json.loads(PRICES.read_text())
    if not runs:
        print("no scene ran; the prices stay as they are")
        return
    fitted = fitted_prices(before, list(runs.values()))
    fitted["source"] = f"{machine()}, {date.today().isoformat()}, by `python -m benchmarks plan fit`"
    prices = costs.prices_from(fitted)
    print(head("scene", "particles", *(f"{stage} s" for stage in costs.STAGES), "all s", "compile s", "GB"))
    for name, found in runs.items():
        guess = costs.predict(found.needs, prices)
        stages = [f"{guess.run[stage]:.2f} / {found.run.get(stage, 0):.2f}" for stage in costs.STAGES]
        whole = f"{guess.run_seconds:.1f} / {sum(found.run.values()):.1f}"
        compiled = f"{guess.compile_seconds:.0f} / {sum(found.compile.values()):.0f}"
        memory = f"{guess.memory / 1e9:.2f} / {found.memory / 1e9:.2f}"
        print(row(name, f"{found.needs.particles:,}", *stages, whole, compiled, memory))
    print("\nFitted / measured.")
    if options.write:
        PRICES.write_text(json.dumps(fitted, indent=1) + "\n")
        print(f"\nWritten to `{PRICES.relative_to(ROOT)}`.")


def fitted_prices(before: dict[str, Any], runs: list[Measured]) -> dict[str, Any]:
    """Prices that are >= 0 and make the relative errors of all runs least, near those before where runs say little.

    Args:
        before: values of costs.json.
        runs: measured.
    """
    after = json.loads(json.dumps(before))
    for kind, parts_of in (("run", costs.run_parts), ("compile", costs.compile_parts)):
        for stage in costs.STAGES:
            amounts = [{p.name: p.amount for p in parts_of(r.needs) if p.stage == stage} for r in runs]
            times = [getattr(r, kind).get(stage, 0.0) for r in runs]
            known = before[kind].get(stage, {})
            if known:
                after[kind][stage] = least_squares(known, amounts, times)
    memory = [costs.memory_parts(r.needs) for r in runs]
    after["memory"] = least_squares(before["memory"], memory, [r.memory for r in runs])
    after["error"] |= fitted_errors(costs.prices_from(before), runs)
    after["probe"] = {name: float(np.median([r.probe[name] for r in runs])) for name in runs[0].probe}
    return after


def fitted_errors(before: costs.Prices, runs: list[Measured]) -> dict[str, float]:
    """Errors of the laws of runs that measured their own, of one law each: the median where there are several.

    Laws whose error is a front of `tradeoff` keep that: a run of few frames hardly moves, so that its own estimate says
    less. For the same reason no other error changes by more than a factor 3.

    Args:
        before: prices so far.
        runs: measured.
    """
    found: dict[str, list[float]] = {}
    for run in runs:
        law, *others = run.needs.particles_of_law
        if law in _FRONTS or run.error is None or others:
            continue
        if guess := costs.matter_error(run.needs, before):
            found.setdefault(law, []).append(before.error[law] * float(np.clip(run.error / guess, 1 / 3, 3)))
    return {law: float(f"{np.median(values):.2g}") for law, values in found.items()}


def least_squares(known: dict[str, float], amounts: list[dict[str, float]], values: list[float]) -> dict[str, float]:
    """Prices x with amounts · x near the values, relatively, and x near the known ones, relatively.

    None falls below a third of what was known: where two amounts go together, the fit would give one of them no price.

    Args:
        known: prices so far, by name.
        amounts: of each run, by name; names that have no price are left out.
        values: of each run; runs with 0 say nothing.
    """
    names = list(known)
    scale = np.array([max(abs(known[name]), 1e-12) for name in names])
    rows = [
        (np.array([amount.get(name, 0.0) for name in names]) * scale / value, 1.0)
        for amount, value in zip(amounts, values) if value > 0
    ]  # fmt: skip
    matrix = np.array([*(r for r, _ in rows), *(_TRUST * np.eye(len(names)))])
    target = np.array([*(v for _, v in rows), *([_TRUST] * len(names))])
    above, _ = nnls(matrix, target - _LEAST * matrix.sum(1))
    return {name: float(f"{value:.3g}") for name, value in zip(names, (_LEAST + above) * scale)}


def check(options) -> None:
    """Plan and run scenes that the prices were not fitted on, each in a process of its own."""
    print(f"Prices: {costs.shipped_prices().source}.\n")
    print(head("scene", "particles", "run s", "compile s", "GB", "error of motion"))
    ratios: dict[str, list[float]] = {"run": [], "compile": [], "memory": [], "error": [], "particles": []}
    for name in options.checked:
        case = CHECKED[name]
        if "plant" in case.source and not _plant_in(options.data).is_file():
            print(row(name, "skipped: no plant.ply in --data", *[""] * 4))
            continue
        found = _child(name, data=options.data)
        if found is None or found.planned is None:
            print(row(name, *["failed"] * 5))
            continue
        plan = found.planned
        pairs = {
            "particles": (plan["particles"], found.needs.particles),
            "run": (sum(plan["run_s"].values()), sum(found.run.values())),
            "compile": (sum(plan["compile_s"].values()), sum(found.compile.values())),
            "memory": (plan["memory_GB"], found.memory / 1e9),
        }
        if found.error is not None:
            pairs["error"] = (plan["error_of_distance"], found.error)
        for key, (guess, true) in pairs.items():
            ratios[key].append(guess / true)
        told = {key: f"{guess:.3g} / {true:.3g} ({guess / true:.2f})" for key, (guess, true) in pairs.items()}
        print(row(name, *(told.get(key, "") for key in ("particles", "run", "compile", "memory", "error"))))
    print("\nPredicted / measured (ratio). Of all scenes, the largest factor between the two:\n")
    for key, found in ratios.items():
        if found:
            print(f"- {key}: {np.exp(np.abs(np.log(found)).max()):.2f}")


def _plant_in(data: Path) -> Path:
    return data.resolve() / "plant.ply"


def _child(name: str, *, data: Path | None = None) -> Measured | None:
    """Run a scene in a process of its own; one of the check, where there is a folder of data."""
    child = start_worker("plan", name, data or "", env={**os.environ, **_COLD})
    said, _ = child.communicate()
    lines = said.strip().splitlines()
    if child.returncode or not lines:
        return None
    values = json.loads(lines[-1])
    needs = values.pop("needs")
    needs["bodies"] = tuple(costs.Body(*body) for body in needs["bodies"])
    return Measured(costs.Required(**needs), **values)


def worker(name: str, data: str = "") -> None:
    """Plan and run one scene, and print what was measured as JSON."""
    from benchmarks.common.timing import use_host_devices

    use_host_devices()
    planned = bool(data)
    case = (CHECKED if planned else FITTED)[name]
    if "plant" in case.source:
        case.changes["input"] = {"gaussians": str(_plant_in(Path(data)))}
    fast = probe()
    with tempfile.TemporaryDirectory() as folder:
        scene = scene_of(case, estimate=planned)
        guess = None
        if planned:
            found = plan_scene(scene)
            guess = found.prediction.as_dict() | {"particles": found.required.particles}
        report = run_scene(scene, Path(folder) / "out")
    stages = {k: t for k, t in report.times.items() if k in costs.STAGES}
    again = report.times.get("estimate")  # frames that are simulated again, which the model counts as simulation
    run, compiled = ({k: getattr(t, kind) for k, t in stages.items()} for kind in ("run", "compile"))
    if again is not None:
        run["simulate"] += again.run
        compiled["simulate"] += again.compile
    values = {
        "needs": report.predicted["required"],
        "run": run,
        "compile": compiled,
        "memory": peak_memory() * 1e9,
        "probe": dict(fast),
        "error": report.estimated_error.get("error_of_distance"),
        "planned": guess,
    }
    print(json.dumps(values))


def scene_of(case: Case, *, estimate: bool = False):
    """The scene of a case.

    Args:
        case: source and changes.
        estimate: whether its frames are simulated again for the estimated error.
    """
    from benchmarks.tradeoff.scenes import SMALL, source
    from pigjax.io import read_toml

    if case.source in SMALL:
        of = source(case.source)
        values, folder = of.values, of.folder
    else:
        path = EXAMPLES / case.source
        values, folder = read_toml(path), path.parent
    values = merged(values, case.changes)
    if estimate:
        values["output"] = {**values.get("output", {}), "error_frames": values["simulation"]["frames"]}
    return scene_from(values, folder=folder)


PARTS = {"fit": ("Fit", fit), "check": ("Check", check)}
OPTIONS = {
    "fitted": {"nargs": "+", "default": list(FITTED), "choices": FITTED, "help": "scenes of the fit"},
    "checked": {"nargs": "+", "default": list(CHECKED), "choices": CHECKED, "help": "scenes of the check"},
    "data": {"type": Path, "default": ROOT / "shared" / "data" / "splats", "help": "folder of plant.ply"},
}
DEVICES = None
