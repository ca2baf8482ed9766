"""What a study may score: pure functions of an `Outcome`, each a dictionary of scalars.

One of them named "loss" is what tuning makes small. Where the simulation broke down or left its grid, all are NaN.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax import io
from pigjax.arrays import matmul
from pigjax.errors import InputError, MissingFileError, SceneError
from pigjax.linalg import svd
from pigjax.metrics import psnr
from pigjax.scene.schema import suggest
from pigjax.study.experiment import Outcome

Scores = dict[str, Float[Array, ""]]
Objective = Callable[[Outcome], Scores]


def motion(outcome: Outcome) -> Scores:
    """Where each object is at the end [m], how fast [m/s], and the health of the simulation."""
    scores: Scores = {}
    particles, health = outcome.particles, outcome.health
    for name, rows in outcome.experiment.rows:
        share = _share(outcome, rows)
        middle, velocity = matmul(share, particles.x), matmul(share, particles.v)
        scores |= {f"{name}.{axis}": middle[k] for k, axis in enumerate("xyz")}
        scores[f"{name}.speed"] = jnp.linalg.norm(velocity)
    return scores | {"min_J": health.min_J, "max_courant": health.max_courant, "escaped": health.escaped * 1.0}


def aim(outcome: Outcome, *, object: str, target: Any, frame: int = -1) -> Scores:
    """How far an object's middle is from a target [m] after a frame; the loss is the square of it.

    Axes of the target that are NaN do not count.
    """
    rows = dict(outcome.experiment.rows)
    if object not in rows:
        raise SceneError(f"objective.options.object = {object!r}: {suggest(object, rows)}.")
    middle = matmul(_share(outcome, rows[object]), outcome.trajectory.x[frame])
    wanted = np.asarray(target, float)
    off = jnp.where(np.isnan(wanted), 0.0, middle - np.nan_to_num(wanted))
    squared = jnp.sum(off**2)
    return {"loss": squared, "distance": jnp.sqrt(squared)} | {f"{axis}": middle[k] for k, axis in enumerate("xyz")}


def shape(outcome: Outcome, *, aspect: float = 10.0, stretch: float = 3.0) -> Scores:
    """Needles among the moving splats over all frames.

    Gives the share of splats longer than `aspect` times their middle axis, the share longer than `stretch` times their
    longest axis at rest, and the largest such ratio; the loss is the mean of log(length / length at rest) squared,
    which is smooth.
    """
    made = outcome.experiment
    index = made.particles.gaussian
    carried, index = index >= 0, jnp.maximum(index, 0)
    rest = jnp.exp(made.gaussians.log_scales[index]).max(-1)

    def of_frame(frame):
        lengths = jnp.sort(jnp.abs(svd(made.splats(outcome.trajectory, frame).factors[index])[1]), -1)
        return lengths[:, 2] / lengths[:, 1], lengths[:, 2] / rest

    aspects, ratios = jax.lax.map(of_frame, jnp.arange(made.frames))
    weight = carried / (carried.sum() * made.frames)
    return {
        "loss": jnp.sum(weight * jnp.log(ratios) ** 2),
        "needles": jnp.sum(weight * (aspects > aspect)),
        "stretched": jnp.sum(weight * (ratios > stretch)),
        "largest": jnp.max(jnp.where(carried, ratios, 0.0)),
    }


def video(outcome: Outcome, *, target: Float[Array, "t h w 3"], levels: int = 1) -> Scores:
    """Mean squared difference from a video of the same frames, and PSNR [dB]; a first picture at rest is left out.

    With more `levels` the loss also counts the pictures at a half, a quarter, ... of their size (`pyramid_error`).
    """
    seen = outcome.experiment.video(outcome.trajectory)
    target = target[1:] if len(target) == len(seen) + 1 else target
    if seen.shape != target.shape:
        raise SceneError(
            f"objective.options.target holds frames of shape {target.shape}, the scene draws {seen.shape}: give it"
            " simulation.frames pictures (or one more, at rest) of the camera's width and height."
        )
    if levels not in range(1, (most := min(seen.shape[1:3]).bit_length()) + 1):
        raise SceneError(f"objective.options.levels = {levels}: pictures of this size have 1 to {most} levels.")
    return {"loss": pyramid_error(seen, target, levels), "psnr": jnp.mean(jax.vmap(psnr)(seen, target))}


def pyramid_error(seen: Float[Array, "t h w 3"], target: Float[Array, "t h w 3"], levels: int) -> Float[Array, ""]:
    """Sum of the mean squared differences of two videos at full size, half of it, and so on, `levels` sizes in all.

    What is drawn beside where it should be, without touching it, has a slope in the small pictures only.
    """
    difference, total = seen - target, jnp.zeros((), seen.dtype)
    for _ in range(levels):
        total += jnp.mean(difference**2)
        h, w = (side // 2 * 2 for side in difference.shape[1:3])
        difference = difference[:, :h, :w].reshape(len(seen), h // 2, 2, w // 2, 2, 3).mean((2, 4))
    return total


OBJECTIVES: dict[str, Callable[..., Scores]] = {"motion": motion, "aim": aim, "shape": shape, "video": video}


def objective_of(function: str, options: dict[str, Any], folder: Path) -> Objective:
    """The objective that a study file names, with its options. Host.

    Raises:
        MissingFileError: there is no such file.
        SceneError: there is no such objective or function.
    """
    options = dict(options)
    if function == "video":
        options["target"] = _read_target(folder, options.pop("target", None))
    if function in OBJECTIVES:
        found = OBJECTIVES[function]
    elif ".py:" in function:
        file, _, name = function.rpartition(":")
        found = _from_file(folder / file, name)
    else:
        names = (*OBJECTIVES, "file.py:function")
        raise SceneError(f"objective.function = {function!r}: {suggest(function, names)}.")
    return partial(_healthy, partial(found, **options))


def _healthy(objective: Objective, outcome: Outcome) -> Scores:
    health = outcome.health
    broken = health.is_broken() | (health.wall_hits > 0)  # no scene of a study asks for the walls of its grid
    return {name: jnp.where(broken, jnp.nan, score) for name, score in objective(outcome).items()}


def _share(outcome: Outcome, rows: tuple[int, ...]) -> Float[Array, "p"]:
    """Weight of each particle in the mean over an object."""
    particles = outcome.particles
    mass = jnp.where(jnp.isin(particles.material, np.array(rows)), particles.mass, 0.0)
    return mass / mass.sum()


def _from_file(path: Path, name: str) -> Callable[..., Scores]:
    if not path.is_file():
        raise MissingFileError(f"{path}: file of objective.function does not exist; check the path.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, name, None)):
        raise SceneError(f"objective.function: {path} defines no function {name!r}.")
    return getattr(module, name)


def _read_target(folder: Path, target: Any) -> Float[Array, "t h w 3"]:
    """Frames of a folder of pictures, of a video, or of an `.npy` file."""
    if not isinstance(target, str):
        raise SceneError("objective.options.target is missing: name a folder of .png frames, a video, or an .npy file.")
    path = folder / target
    if path.is_dir():
        pictures = [io.read_image(picture) for picture in sorted(path.glob("*.png"))]
        if len({picture.shape for picture in pictures}) != 1:
            raise InputError(f"{path}: objective.options.target needs .png frames, all of one size.")
        return jnp.asarray(np.stack(pictures))
    if not path.is_file():
        raise MissingFileError(f"{path}: objective.options.target does not exist; check the path.")
    return jnp.asarray(np.load(path) if path.suffix == ".npy" else io.read_video(path))
