"""Objectives of studies: pure functions of an `Outcome`, each a dictionary of scalars.

Tuning minimises the scalar named "loss". Where the simulation broke down or left its grid, all are NaN.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pigjax import io
from pigjax.core.arrays import matmul
from pigjax.core.checks import joined, shown, suggest
from pigjax.core.errors import InputError, MissingFileError, SceneError
from pigjax.core.linalg import svd
from pigjax.core.metrics import psnr
from pigjax.study.experiment import Outcome
from pigjax.study.schema import ObjectiveSpec

Scores = dict[str, Float[Array, ""]]
Objective = Callable[[Outcome], Scores]


def motion(outcome: Outcome) -> Scores:
    """Place [m] and speed [m/s] of each object at the end, and the health of the simulation."""
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

    Raises:
        SceneError: no such moving object or frame, or the target is not 3 numbers.
    """
    rows = dict(outcome.experiment.rows)
    check_aim(object, frame, rows, outcome.experiment.frames)
    middle = matmul(_share(outcome, rows[object]), outcome.trajectory.x[frame])
    wanted = np.asarray(target, float)
    if wanted.shape != (3,):
        raise SceneError(f"objective.options.target = {shown(target)}: it must be 3 numbers.")
    off = jnp.where(np.isnan(wanted), 0.0, middle - np.nan_to_num(wanted))
    squared = jnp.sum(off**2)
    return {"loss": squared, "distance": jnp.sqrt(squared)} | {f"{axis}": middle[k] for k, axis in enumerate("xyz")}


def check_aim(object: str, frame: int, objects: Iterable[str], frames: int) -> None:
    """Whether there are such an object and such a frame.

    JAX would take the last frame in place of one beyond it.

    Raises:
        SceneError: there is none.
    """
    if object not in objects:
        raise SceneError(f"objective.options.object = {shown(object)}: {suggest(object, objects)}.")
    if not -frames <= frame < frames:
        raise SceneError(
            f"objective.options.frame = {frame}: it must be in [0, {frames - 1}], or -1 to -{frames} from the end."
        )


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

    An object drawn beside its true place, without touching it, has a slope in the small pictures only.
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
        SceneError: there is no such objective or function, or an option is unknown, missing or wrong.
        InputError: the file's code fails.
    """
    spec = ObjectiveSpec(function, dict(options))
    spec.check()
    options = dict(options)
    if spec.is_code():
        file, _, name = function.rpartition(":")
        found = _from_file(folder / file, name)
        _check_options(found, options, function)
    elif function not in OBJECTIVES:
        raise SceneError(f"objective.function = {function!r}: it scores thresholds of the vote, segmentation.*, only.")
    else:
        found = OBJECTIVES[function]
    if function == "video":
        options["target"] = _read_target(folder, options["target"])
    return partial(_healthy, partial(found, **options))


def _healthy(objective: Objective, outcome: Outcome) -> Scores:
    health = outcome.health
    broken = health.is_broken() | (health.wall_hits > 0)  # no scene of a study asks for the walls of its grid
    return {name: jnp.where(broken, jnp.nan, score) for name, score in _scores(objective, outcome).items()}


def _scores(objective: Objective, outcome: Outcome) -> Scores:
    """Scores of an objective; exceptions of its own code are reported with file and line."""
    function = objective.func if isinstance(objective, partial) else objective
    file = getattr(getattr(function, "__code__", None), "co_filename", "")
    if function in OBJECTIVES.values():
        return objective(outcome)
    with _running(Path(file)):
        scores = objective(outcome)
    if not isinstance(scores, dict) or not scores or not all(np.ndim(score) == 0 for score in scores.values()):
        raise InputError(
            f"{file}: {getattr(function, '__name__', 'the objective')} must return a dictionary of numbers by name, one"
            " of them 'loss' for tuning."
        )
    return scores


def _share(outcome: Outcome, rows: tuple[int, ...]) -> Float[Array, "p"]:
    """Weight of each particle in the mean over an object."""
    particles = outcome.particles
    mass = jnp.where(jnp.isin(particles.material, np.array(rows)), particles.mass, 0.0)
    return mass / mass.sum()


def _from_file(path: Path, name: str) -> Callable[..., Scores]:
    if not os.path.isfile(path):
        raise MissingFileError(f"{path}: file of objective.function does not exist; check the path.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: objective.function needs a Python file, *.py.")
    module = importlib.util.module_from_spec(spec)
    with _running(path):
        spec.loader.exec_module(module)
    found = getattr(module, name, None)
    if not callable(found):
        own = [key for key, value in vars(module).items() if inspect.isfunction(value)]
        raise SceneError(f"objective.function: {path} defines no function {name!r}; {suggest(name, own)}.")
    return found


@contextmanager
def _running(path: Path) -> Iterator[None]:
    """Turn exceptions of a study's code into one sentence with its file and line.

    Raises:
        InputError: the block raised any exception but an InputError.
    """
    try:
        yield
    except InputError:
        raise
    except SyntaxError as error:
        where = f"{error.filename or path}" + (f", line {error.lineno}" if error.lineno else "")
        raise InputError(f"{where}: {error.msg}; mend the objective.") from error
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        line = next((frame.lineno for frame in reversed(frames) if Path(frame.filename) == path), None)
        where = f"{path}, line {line}" if line is not None else f"{path}"
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{where}: {type(error).__name__}: {said}; mend the objective.") from error


def _check_options(found: Callable[..., Scores], options: dict[str, Any], function: str) -> None:
    """Whether a function of a file takes these options, and is given all that it needs."""
    try:
        parameters = list(inspect.signature(found).parameters.values())[1:]
    except (TypeError, ValueError):  # what has no signature, as some builtins
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = {p.name: p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
    for name in options:
        if name not in known:
            raise SceneError(
                f"{joined('objective.options', name)}: {function} has no such option; {suggest(name, known)}."
            )
    for name, parameter in known.items():
        if parameter.default is parameter.empty and name not in options:
            raise SceneError(f"{joined('objective.options', name)} is missing: {function} needs it.")


def _read_target(folder: Path, target: str) -> Float[Array, "t h w 3"]:
    """Frames of a folder of pictures, of a video, or of an `.npy` file."""
    path = folder / target
    if os.path.isdir(path):
        pictures = [io.read_image(picture) for picture in sorted(path.glob("*.png"))]
        if len({picture.shape for picture in pictures}) != 1:
            raise InputError(f"{path}: objective.options.target needs .png frames, all of one size.")
        return jnp.asarray(np.stack(pictures))
    if not os.path.isfile(path):
        raise MissingFileError(f"{path}: objective.options.target does not exist; check the path.")
    if path.suffix != ".npy":
        return jnp.asarray(io.read_video(path))
    frames = np.asarray(io.load_array(path, "array of video frames"))
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype.kind not in "fiu" or not np.isfinite(frames).all():
        raise InputError(f"{path}: an array of shape {frames.shape}; finite frames of shape [t, h, w, 3] are needed.")
    return jnp.asarray(frames, jnp.float32)
