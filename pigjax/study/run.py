"""Running a study file: sweep or tune, saved as it goes; leaves a table, plots, and a scene file of the best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from msgspec.structs import asdict, replace

from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.checks import shown, suggest
from pigjax.core.errors import SceneError
from pigjax.study.experiment import Experiment, Outcome, experiment
from pigjax.study.objectives import Objective, Scores, check_aim, objective_of
from pigjax.study.optimize import Bounds, History, Table, fit, search, sweep
from pigjax.study.schema import MOST_ROWS, Study, Value
from pigjax.study.voting import Voting, voting

Row = Mapping[str, Any]
_FILES = ("gaussians", "names", "masks")  # of a scene; its photos and cameras enter by the results computed from them
_SOFT_VOTES = 0.002  # temperature of a tuned vote that states none: a wider one tells no small tau_d from a larger


@checked
def sweep_study(
    study: Study,
    out_dir: str | Path,
    *,
    progress: Callable[[int, int], Any] | None = None,
    overwrite: bool = False,
) -> Table:
    """Score every set of parameters of a study. Host.

    Into `out_dir` go `table.csv`, `table.npz`, `sweep.png` (a curve of one parameter, a heat map of two), `best.json`
    and `best.toml`, the scene with the best values. Finished rows are kept, so that a killed sweep resumes. Where
    all parameters are of the clamp, one simulation serves all.

    Args:
        study: as `load_study` gives it.
        out_dir: folder for the results, made if it is missing.
        progress: called with rows done and rows to do.
        overwrite: replace rows that were made from something else, instead of refusing them.

    Raises:
        StaleError: `out_dir` holds rows of another study, scene, objective or other files; it names the changes.
        InputError: a file is missing, a parameter or an objective is unknown, or nothing could be scored.
    """
    out = io.output_folder(
        out_dir, files=("table.csv", "table.npz", "sweep.png", "best.json", "best.toml"), folders=("rows",)
    )
    rows = _rows(study)
    trial, shared = _trial(study, rows, soft=False)
    _check_shown(study.sweep.of, jax.eval_shape(trial, rows[0], shared))
    table = sweep(
        trial,
        rows,
        shared=shared,
        batch=study.sweep.batch,
        check=partial(_check, shared[0]),
        resume=out / "rows",
        callback=progress,
        mark=_parts(study, "tune"),
        overwrite=overwrite,
    )
    if jax.process_index() == 0:
        table.save(out / "table.csv")
        table.save(out / "table.npz")
        best = table.best(study.sweep.of, mode=study.sweep.best)  # tells why, where no row is good
        _draw(study, table, out / "sweep.png")
        _leave_best(study, best, out)
    return table


@checked
def tune_study(
    study: Study,
    out_dir: str | Path,
    *,
    progress: Callable[[int, int, str], Any] | None = None,
    overwrite: bool = False,
) -> tuple[Row, History]:
    """Find the parameters of least loss. Host.

    Into `out_dir` go `history.npz`, `history.png`, `best.json` and `best.toml`, the scene with the best values. A
    killed search resumes from its checkpoint.

    Args:
        study: as `load_study` gives it.
        out_dir: folder for the results, made if it is missing.
        progress: called with steps done, steps to do, and the loss in words.
        overwrite: start over where the checkpoint belongs to something else, instead of refusing it.

    Raises:
        StaleError: `out_dir` holds the search of another study, scene, objective or other files; it names the changes.
        InputError: a file is missing, a parameter or an objective is unknown, a start lies out of bounds.
        SimulationError: nothing that was tried could be simulated.
    """
    files = ("history.npz", "history.png", "best.json", "best.toml")
    out, spec = io.output_folder(out_dir, files=files), study.tune
    bounds = {name: _bounds(name, study) for name in study.parameters}
    ends = [{name: end} for name, own in study.parameters.items() for end in (own.low, own.high) if end is not None]
    trial, shared = _trial(study, ends, soft=spec.method == "adam")
    start = {name: _start(name, study, shared[0]) for name in study.parameters}

    function = study.objective.function

    def loss(values: Row, shared: Any) -> tuple[jax.Array, Scores]:
        scores = trial(values, shared)
        if "loss" not in scores:
            raise SceneError(f"objective.function = {function!r} gives no 'loss' to make small.")
        return scores["loss"], scores

    common: dict[str, Any] = {"bounds": bounds, "shared": shared, "overwrite": overwrite}
    common["mark"] = _parts(study, "sweep")
    if progress is not None:
        total = spec.steps
        common["callback"] = lambda step: progress(step.step, total, f"loss {step.loss:.4g}")
    if spec.method == "adam":
        best, history = fit(
            loss, start, spec.rate, steps=spec.steps, clip=spec.clip, patience=spec.patience,
            restarts=spec.restarts, has_aux=True, checkpoint=out / "fit.ckpt", **common,
        )  # fmt: skip
    else:
        best, history = search(
            lambda values, shared: loss(values, shared)[0], start, evaluations=spec.steps,
            seed=spec.seed, checkpoint=out / "search.ckpt", **common,
        )  # fmt: skip
    history.save(out / "history.npz")
    history.plot(out / "history.png")
    _leave_best(study, best, out)
    return best, history


def _parts(study: Study, unused: str) -> dict[str, Any]:
    """Settings and files that a study depends on, by the names that a message can tell; how it is shared out is not."""
    settings = asdict(study)
    for name in ("scene", "folder", unused):
        settings.pop(name)
    settings |= {} if unused == "sweep" else {"sweep": replace(study.sweep, batch=None)}
    scene, home = study.to_scene(), Path(study.folder)
    own = asdict(scene)
    for name in ("folder", "accuracy"):
        own.pop(name)
    files = {name: scene.path(path) for name in _FILES if (path := getattr(scene.input, name)) is not None}
    options = study.objective.options
    if study.objective.is_code():
        files["objective"] = home / study.objective.function.rpartition(":")[0]
    if isinstance(target := options.get("target"), str):
        files["target"] = home / target
    return {**settings, "scene": own, "content of": {name: io.file_digest(path) for name, path in files.items()}}


def _trial(study: Study, rows: Sequence[Row], *, soft: bool) -> tuple[Callable[..., Scores], tuple[Any, ...]]:
    """Scores of parameters as a pure function of them and of the shared inputs."""
    scene = study.to_scene()
    of_votes = [name.startswith("segmentation.") for name in study.parameters]
    if all(of_votes):
        temperature = study.objective.options.get("temperature", _SOFT_VOTES if soft else None)
        if study.objective.function != "votes":
            raise SceneError("objective.function: thresholds of the vote are scored by 'votes'.")
        study.objective.check()
        return _score_votes, (voting(scene, temperature=temperature),)
    if any(of_votes):
        raise SceneError("parameters: thresholds of the vote decide what is simulated: study them apart from the rest.")
    options = study.objective.options
    if study.objective.function == "aim":
        moving = [name for name, spec in scene.objects.items() if spec.moves]
        check_aim(options["object"], options.get("frame", -1), moving, scene.simulation.frames)
    objective = objective_of(study.objective.function, options, Path(study.folder))
    start = {name: own.start for name, own in study.parameters.items() if own.start is not None}
    extremes = [*_ends(study, rows), *([start] if start else [])]
    made = experiment(scene, extremes=extremes, regions=study.regions, alone=study.only is not None)
    for name in study.parameters:
        made.value(name)  # unknown names are told before anything is compiled
    only_drawn = all(name.startswith("clamp.") for name in study.parameters)
    outcome = jax.jit(Experiment.simulate)(made) if only_drawn else None
    return partial(_score, objective), (made, outcome)


def _score_votes(values: Row, shared: tuple[Voting]) -> Scores:
    return shared[0].with_parameters(values).scores()


def _score(objective: Objective, values: Row, shared: tuple[Experiment, Outcome | None]) -> Scores:
    made, outcome = shared
    changed = made.with_parameters(values)
    return objective(changed.simulate() if outcome is None else outcome._replace(experiment=changed))


def _rows(study: Study) -> list[Row]:
    columns = {name: spec.swept(name) for name, spec in study.parameters.items()}
    if study.sweep.join == "rows":
        lengths = {name: len(values) for name, values in columns.items()}
        if len(set(lengths.values())) > 1:
            raise SceneError(f"parameters: rows are joined one by one, but there are {lengths} values.")
        return [dict(zip(columns, row)) for row in zip(*columns.values())]
    count = math.prod(len(values) for values in columns.values())
    if count > MOST_ROWS:
        sizes = ", ".join(f"{len(values)} of {name}" for name, values in columns.items())
        raise SceneError(f"parameters: {count} rows ({sizes}) are more than {MOST_ROWS}; lower their count.")
    return [dict(zip(columns, row)) for row in itertools.product(*columns.values())]


def _ends(study: Study, rows: Sequence[Row]) -> list[Row]:
    """For each parameter the least and the greatest that it gets, all others as in the scene."""
    ends: list[Row] = []
    for name in study.parameters:
        values = [row[name] for row in rows if name in row]
        if values and not name.startswith("clamp."):
            ordered = sorted(values, key=lambda value: float(np.linalg.norm(value)))
            ends += [{name: ordered[0]}, {name: ordered[-1]}]
    return ends


def _check(made: Experiment | Voting, row: Row) -> None:
    if isinstance(made, Experiment):
        made.with_parameters(row).check()


def _check_shown(of: str, scores: Iterable[str]) -> None:
    """Whether there is a result of that name, before anything is compiled."""
    if of not in scores:
        raise SceneError(f"sweep.of = {shown(of)}: the objective gives no such result: {suggest(of, scores)}.")


def _bounds(name: str, study: Study) -> Bounds | None:
    spec = study.parameters[name]
    if spec.low is None and spec.high is None and spec.scale == "linear":
        return None
    return Bounds(spec.low, spec.high, scale=spec.scale)


def _start(name: str, study: Study, made: Experiment | Voting) -> jax.Array:
    own: Value | None = study.parameters[name].start
    present = made.value(name)
    spec = study.parameters[name]
    for field, value in (("low", spec.low), ("high", spec.high), ("start", own)):
        if value is not None and np.ndim(value) and np.shape(value) != present.shape:
            raise SceneError(
                f"parameters.{name}.{field} = {np.asarray(value).tolist()}: give one number, or {present.size} of them."
            )
    return present if own is None else jnp.broadcast_to(jnp.asarray(own, present.dtype), present.shape)


def _leave_best(study: Study, best: Row, out: Path) -> None:
    # as many digits as the numbers have
    plain = {
        name: jax.tree.map(lambda v: float(f"{v:.7g}"), np.asarray(value).tolist()) for name, value in best.items()
    }
    io.write_json(out / "best.json", plain)
    io.write_toml(out / "best.toml", study.scene_values(plain, out))


def _draw(study: Study, table: Table, path: Path) -> None:
    scalars = [name for name in study.parameters if np.ndim(study.parameters[name].swept(name)[0]) == 0]
    if len(scalars) == 2 and study.sweep.join == "grid":
        table.heat_map(path, scalars[0], scalars[1], study.sweep.of, mode=study.sweep.best)
    elif len(scalars) == 1:
        table.curve(path, scalars[0], study.sweep.of)
