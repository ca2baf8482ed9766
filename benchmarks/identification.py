"""System identification from video: stiffness and throw of the objects of a known simulation.

A known simulation of the tabletop is drawn, then stiffness and throw are recovered from the video alone, through the
gradients of render ∘ clamp ∘ MLS-MPM. Part video writes the frames that examples/studies/duck_from_video.toml fits.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import optax

from benchmarks.common.pages import EXAMPLES, ROOT, head, picture, row
from benchmarks.common.timing import clock, measure
from pigjax import io
from pigjax.study import Experiment, experiment, load_study
from pigjax.study.objectives import pyramid_error
from pigjax.study.optimize import Bounds, fit, search

STUDIES = EXAMPLES / "studies"
STIFF = Bounds(1e3, 4e4, "log")
SPEED = Bounds(-4.0, 4.0)
STEPS = 60
DUCK = {"objects.duck.young": 8e3, "objects.duck.velocity": [0.4, -0.3, -1.5]}
DUCK_START = {"objects.duck.young": 3.2e4, "objects.duck.velocity": [0.38, -0.11, -1.05]}


def made_from(study_name="duck_from_video.toml", *, only=None, overrides=None, **options) -> Experiment:
    study = load_study(STUDIES / study_name)
    study = msgspec.structs.replace(study, only=only or study.only, overrides={**study.overrides, **(overrides or {})})
    return experiment(study.to_scene(), alone=True, **options)


def arrays(values):
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


@jax.jit
def film(values, made):
    outcome = made.with_parameters(values).simulate()
    return outcome.experiment.video(outcome.trajectory)


def loss(values, shared, levels=1):
    made, target = shared
    return 1e3 * pyramid_error(film(values, made), target, levels)


def bounds_of(values):
    return {name: SPEED if name.endswith("velocity") else STIFF for name in values}


def descend(made, target, start, *, bounds=None, steps=STEPS, rate=0.1, levels=1):
    """The fit, with a rate that falls to nothing, by the pictures at so many sizes."""
    adam = optax.adam(optax.cosine_decay_schedule(rate, steps))
    seconds, (best, history) = clock(
        lambda: fit(partial(loss, levels=levels), arrays(start), adam, steps=steps, bounds=bounds or bounds_of(start),
                    shared=(made, target))
    )  # fmt: skip
    return best, history, seconds


def off(value, truth):
    """Error [%]: of vectors, the length of the difference."""
    value, truth = np.asarray(value, float), np.asarray(truth, float)
    return 100 * np.linalg.norm(value - truth) / np.linalg.norm(truth)


def report(truth, start, best, history, seconds):
    print(head("parameter", "truth", "start", "found", "error"))
    for name, value in truth.items():
        shown = (
            np.round(np.asarray(v, float), 4 if np.ndim(v) else 1).tolist() for v in (value, start[name], best[name])
        )
        print(row(name, *shown, f"{off(best[name], value):.2f} %"))
    each = float(np.median(np.diff(history.seconds)[3:]))
    print(
        f"\nLoss {history.loss[0]:.3g} to {history.least:.2g} in {len(history)} gradients of {each:.2f} s,"
        f" {seconds:.0f} s in all with compilation."
    )


def one(options) -> str:
    made = made_from(extremes=[{"objects.duck.young": STIFF.high}])
    target = film(arrays(DUCK), made)
    best, history, seconds = descend(made, target, DUCK_START, steps=80)
    report(DUCK, DUCK_START, best, history, seconds)
    history.plot(options.media / "identification_one.png")
    rows = [np.asarray(film(arrays(values), made))[::2] for values in (DUCK, DUCK_START, best)]
    sheet = io.contact_sheet([frame for row in rows for frame in row], columns=len(rows[0]))
    io.write_image(options.media / "identification_frames.png", sheet)
    return "\n" + picture("identification_frames.png", "Truth, start and result, every second frame")


TWO = {
    "objects.duck.young": 8e3, "objects.duck.velocity": [0.4, -0.3, -1.5],
    "objects.soccerball.young": 1.6e4, "objects.soccerball.velocity": [-0.3, 0.3, -2.0],
}  # fmt: skip
TWO_START = {
    "objects.duck.young": 2.4e4, "objects.duck.velocity": [0.3, -0.2, -1.1],
    "objects.soccerball.young": 5e3, "objects.soccerball.velocity": [-0.2, 0.2, -1.5],
}  # fmt: skip


def two(_) -> None:
    view = {"camera.target": [0.06, 0.10, 0.40], "camera.radius": 0.85, "camera.start": -40, "camera.width": 112}
    made = made_from(
        only=["table", "duck", "soccerball"], overrides=view, extremes=[{"objects.duck.young": STIFF.high}]
    )
    target = film(arrays(TWO), made)
    best, history, seconds = descend(made, target, TWO_START, steps=120, levels=5)
    report(TWO, TWO_START, best, history, seconds)


def field(_) -> None:
    parts = 3
    truth = {
        "objects.duck.young": [6e3, 1.2e4, 2.4e4],
        "objects.duck.density": [800.0, 1000.0, 1400.0],
    }
    start = {"objects.duck.young": [1.2e4] * parts, "objects.duck.density": [1000.0] * parts}
    thrown = {"objects.duck.velocity": DUCK["objects.duck.velocity"]}
    made = made_from(extremes=[{"objects.duck.young": STIFF.high}], regions={"duck": parts})
    made = made.with_parameters(thrown)
    target = film(arrays(truth), made)
    bounds = {"objects.duck.young": STIFF, "objects.duck.density": Bounds(300.0, 3000.0, "log")}
    best, history, seconds = descend(made, target, start, bounds=bounds, steps=70)
    report(truth, start, best, history, seconds)
    # how well the video determines each combination: JᵀJ of the frames by the logarithms of the parameters
    names = list(truth)

    def frames(logs):
        return film({name: jnp.exp(logs[k * parts : (k + 1) * parts]) for k, name in enumerate(names)}, made)

    logs = jnp.log(jnp.concatenate([arrays(truth)[name] for name in names]))
    columns = []
    for k in range(len(logs)):
        nudge = 0.02 * jax.nn.one_hot(k, len(logs))
        columns.append(np.asarray(frames(logs + nudge) - frames(logs - nudge)).ravel() / 0.04)
    weight, axes = np.linalg.eigh(np.array(columns) @ np.array(columns).T)
    print("\nDirections in the logarithms of E and ρ of the parts that the video determines, by eigenvalues of JᵀJ:\n")
    print(head("eigenvalue, of the largest", "direction"))
    for value, axis in zip(weight[::-1], axes.T[::-1]):
        print(row(f"{value / weight[-1]:.1e}", ", ".join(f"{part:.2f}" for part in axis)))
    ratio, wanted = (np.asarray(own[names[0]]) / np.asarray(own[names[1]]) for own in (best, truth))
    print(f"\nE/ρ of the parts is off by {', '.join(f'{100 * abs(r / w - 1):.1f}' for r, w in zip(ratio, wanted))} %.")


def other(_) -> None:
    print(head("the video", "E", "v0"))
    made = made_from(extremes=[{"objects.duck.young": STIFF.high}])
    clean = film(arrays(DUCK), made)
    rng = np.random.default_rng(0)
    fine = {"simulation.dx": 0.0125}
    videos = {
        "same grid": clean,
        "noise of 0.05 on every pixel": clean + jnp.asarray(0.05 * rng.normal(size=clean.shape), jnp.float32),
        "other particles (seed 1)": film(arrays(DUCK), made_from(overrides={"simulation.seed": 1})),
        "finer grid, dx 12.5 mm for 20 mm": film(arrays(DUCK), made_from(overrides=fine)),
    }
    for name, target in videos.items():
        best, _, _ = descend(made, target, DUCK_START)
        print(row(name, *errors_of(best)))


def cost(_) -> None:
    made = made_from(extremes=[{"objects.duck.young": STIFF.high}])
    target = film(arrays(DUCK), made)
    start, shared = arrays(DUCK_START), (made, target)
    forward = jax.jit(loss)
    whole = replace(made, config=replace(made.config, box=None))
    print(head("grid", "nodes", "forward [s]", "forward and backward [s]", "compile [s]"))
    for name, own in (("whole", whole), ("a box that moves", made)):
        once = measure(loss, start, (own, target)).seconds
        run = measure(jax.value_and_grad(loss), start, (own, target))
        nodes = "x".join(map(str, own.config.box or own.grid.shape))
        print(row(name, nodes, f"{once:.3f}", f"{run.seconds:.3f}", f"{run.compile_seconds:.1f}"))
    print()
    limits = bounds_of(start)
    names = sorted(start)

    def of_free(vector):
        free = {names[0]: vector[:3], names[1]: vector[3]} if names[0].endswith("velocity") else None
        assert free is not None
        return forward({name: limits[name].from_free(free[name]) for name in names}, shared)

    at = jnp.concatenate([jnp.ravel(limits[name].to_free(start[name])) for name in names])
    exact = jax.grad(lambda v: of_free(v))(at)
    print(head("gradient", "in forward passes", "angle to the exact gradient"))
    print(row("reverse mode", f"{run.seconds / once:.1f}", 0))
    for h in (1e-1, 1e-2, 1e-3):
        central = jnp.stack([(of_free(at + h * e) - of_free(at - h * e)) / (2 * h) for e in jnp.eye(4)])
        cosine = float(central @ exact / jnp.linalg.norm(central) / jnp.linalg.norm(exact))
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        print(row(f"central differences, h = {h:g}", 2 * len(at), f"{angle:.2f}°"))
    print("\n" + head("method", "losses", "gradients", "s", "E", "v0"))
    best, history, seconds = descend(made, target, DUCK_START)
    print(row("Adam", 0, len(history), f"{seconds:.0f}", *errors_of(best)))
    seconds, (best, history) = clock(lambda: search(loss, start, evaluations=240, bounds=limits, shared=shared))
    print(row("CMA-ES", len(history), 0, f"{seconds:.0f}", *errors_of(best)))


def errors_of(best) -> list[str]:
    return [f"{off(best[name], DUCK[name]):.2f} %" for name in DUCK]


def video(options) -> str:
    """Write the frames that examples/studies/duck_from_video.toml fits."""
    made = made_from(extremes=[{"objects.duck.young": STIFF.high}])
    frames = np.asarray(film(arrays(DUCK), made))
    for number, frame in enumerate(frames):
        io.write_image(options.frames / f"{number:02d}.png", np.clip(frame, 0, 1))
    return f"{len(frames)} frames in {options.frames}"


PARTS = {
    "one": ("One duck: stiffness and throw", one),
    "two": ("Two objects of different stiffness", two),
    "field": ("A field: stiffness and density of three parts", field),
    "other": ("A video that the model did not draw", other),
    "cost": ("Cost of a gradient", cost),
    "video": ("Frames of the study", video),
}
OPTIONS = {"frames": {"type": Path, "default": ROOT / "out" / "duck_video",
                      "help": "folder of part video; the study reads examples/studies/duck_video"}}  # fmt: skip
DEVICES = None
