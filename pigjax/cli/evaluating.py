"""`pigjax evaluate`: a data set and a scene in, scores and a sheet of masks out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pigjax import io
from pigjax.core.errors import InputError
from pigjax.core.metrics import mean_iou
from pigjax.objects.evaluation import Evaluation, evaluate_labels, ground_prompts, reference_view
from pigjax.objects.lifting import lift
from pigjax.objects.overlay import comparison_sheet
from pigjax.segmentation import Labels, fill_unseen, pixel_ids
from pigjax.splat import Gaussians

_MOST_ROWS = 24


class Report(NamedTuple):
    """Scores, and how prompts found their objects."""

    evaluation: Evaluation
    grounding: str
    black: tuple[str, ...]
    views: dict[str, int]  # test views of each prompt


def evaluate_files(
    gaussians: Gaussians,
    dataset: io.Dataset,
    out: Path,
    *,
    labels: Path | None = None,
    prompts: Path | None = None,
    reference: str | None = None,
    fill: bool = True,
    origin: tuple[float, float, float] | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, of: None,
    overwrite: bool = False,
    **settings: Any,
) -> Report:
    """Score labelled Gaussians on a data set; writes `scores.json` and `sheet.png` into `out`. Host.

    Args:
        gaussians: the scene.
        dataset: as `io.load_dataset` reads it.
        out: folder of the results.
        labels: `labels.npz` as `pigjax segment` writes it; if not given, the masks of the data set are lifted.
        prompts: JSON {prompt: id}. Else the data set's names give the ids, and where it has none each prompt takes the
            object that overlaps its truth best in the reference view.
        reference: name of that view, which also overrules the data set's names; if not given, the view with most
            prompts.
        fill: give Gaussians that no view saw the id of their neighbours.
        origin: vector that was subtracted from the scene's positions [m]; None: none was. With one, labels are not
            compared with the Gaussians of their file, which has other positions.
        progress: called with the stage, steps done and of all.
        overwrite: replace scores of something else in `out`, instead of refusing them.
        settings: of `lift_masks`.

    Raises:
        StaleError: `out` holds scores of other Gaussians, another data set or other settings; it names the changes.
        InputError: files that do not fit each other, or cannot be written.
    """
    out = io.output_folder(out, files=("scores.json", "sheet.png"))
    parts = io.parts_of(
        {
            "Gaussians": io.digest(gaussians),
            "data set": io.digest(dataset),
            "labels": "lifted" if labels is None else io.file_digest(labels),
            "prompts": "none" if prompts is None else io.file_digest(prompts),
            "": {**settings, "reference": reference, "fill": fill},
        }
    )
    io.claim(out, parts, results=("scores.json", "sheet.png"), overwrite=overwrite)
    progress("lift", 0, 1)
    if labels is None:
        lifted = _lift(gaussians, dataset, fill=fill, **settings)
    else:
        scene = io.digest_of_scene(gaussians) if origin is None else None
        stored = io.load_labels(labels, len(gaussians), scene=scene)
        lifted = Labels(
            jnp.asarray(stored.object_id),
            jnp.asarray(stored.votes),
            jnp.asarray(stored.confidence),
            ids=None if stored.ids is None else jnp.asarray(stored.ids),
        )
        lifted = fill_unseen(gaussians, lifted) if fill else lifted
    progress("lift", 1, 1)
    cameras = {view: dataset.test.cameras[i] for i, view in enumerate(dataset.test.names)}
    objects, grounding = _grounding(gaussians, lifted, dataset, cameras, prompts, reference)
    evaluation = evaluate_labels(
        gaussians, lifted, cameras, dataset.truths, objects,
        progress=lambda done, of: progress("draw", done, of),
    )  # fmt: skip
    views = {prompt: sum(at == prompt for _, at in dataset.truths) for prompt in objects}
    report = Report(evaluation, grounding, dataset.black, views)
    io.write_json(out / "scores.json", _as_json(report) | settings | {"filled": fill})
    io.write_image(out / "sheet.png", comparison_sheet(_rows(dataset, evaluation)))
    return report


def _lift(gaussians: Gaussians, dataset: io.Dataset, **settings: Any) -> Labels:
    if dataset.masks is None or dataset.cameras is None:
        raise InputError("the data set was read without masks that vote; give labels.npz, or read it with vote=True.")
    return lift(gaussians, dataset.cameras, dataset.masks, valid=dataset.valid, **settings)


def _grounding(
    gaussians: Gaussians,
    labels: Labels,
    dataset: io.Dataset,
    cameras: dict[str, Any],
    prompts: Path | None,
    reference: str | None,
) -> tuple[dict[str, int | None], str]:
    """Id of each prompt, and in words how it was found."""
    wanted = list(dict.fromkeys(prompt for _, prompt in dataset.truths))
    if prompts is not None:
        given = _read_prompts(prompts)
        return {prompt: given.get(prompt) for prompt in wanted}, f"ids given in {prompts.name}"
    if dataset.names and reference is None:
        return {prompt: io.id_named(prompt, dataset.names) for prompt in wanted}, "ids named in names.json"
    view = reference_view(dataset.truths) if reference is None else reference
    if view not in cameras:
        raise InputError(f"reference = {view!r}: no view with truth; choose among {', '.join(cameras)}.")
    ids, _ = pixel_ids(gaussians, labels, cameras[view])
    truths = {prompt: mask for (at, prompt), mask in dataset.truths.items() if at == view}
    found = ground_prompts(ids, truths)
    return {prompt: found.get(prompt) for prompt in wanted}, f"best overlap with the truth in view {view}"


def _read_prompts(path: Path) -> dict[str, int]:
    content = io.read_json(path)
    sound = isinstance(content, dict) and all(type(number) is int and 0 < number < 2**31 for number in content.values())
    if not sound:
        raise InputError(
            f'{path}: is not {{prompt: id}} with ids > 0 and < 2³¹; write for example {{"green apple": 3}}.'
        )
    return content


def _as_json(report: Report) -> dict[str, Any]:
    evaluation = report.evaluation
    levels = {
        level: {
            "mean_iou": scores.mean_iou,
            "mean_boundary_iou": scores.mean_boundary_iou,
            "missing": scores.missing,
            "prompts": {
                prompt: {"iou": iou, "boundary_iou": boundary} for prompt, (iou, boundary) in scores.per_prompt.items()
            },
        }
        for level, scores in evaluation.scores.items()
    }
    return {
        "levels": levels,
        "objects": evaluation.objects,
        "views": report.views,
        "grounding": report.grounding,
        "black": report.black,
    }


def _rows(dataset: io.Dataset, evaluation: Evaluation) -> Iterable[tuple[str, Any, Any, Any]]:
    """Rows of the sheet with the visible part of the object: at most 24, spread over all views and prompts."""
    keys = list(dataset.truths)
    chosen = np.unique(np.linspace(0, len(keys) - 1, _MOST_ROWS).astype(int))
    images = dict(zip(dataset.test.names, dataset.test.images))
    for view, prompt in (keys[i] for i in chosen):
        truth = dataset.truths[view, prompt]
        mask = evaluation.masks["visible"].get((view, prompt))
        title = f"{view}  {prompt}  " + (
            "missing" if mask is None else f"IoU {100 * float(mean_iou(mask, truth)):.1f} %"
        )
        yield title, images[view], truth, np.zeros_like(truth) if mask is None else mask
