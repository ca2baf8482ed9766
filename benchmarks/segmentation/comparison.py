"""Votes and rivals' methods on the same Gaussians, views and scores; `study` gives the tables and a picture."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.baselines.box_selection import select_by_box
from benchmarks.baselines.feature_distillation import image_similarities, select_by_similarity, train_features
from benchmarks.baselines.identity_encoding import encoded_ids, image_ids, train_encoding
from benchmarks.baselines.training import Fitted
from benchmarks.common.pages import TABLETOP, head, picture, row
from benchmarks.common.timing import timed
from benchmarks.segmentation.tabletop import TABLE, Tabletop, mean_scores, scores_by_object
from pigjax.core.metrics import score_masks
from pigjax.io import Views, load_ply
from pigjax.segmentation import fill_unseen, lift_masks
from pigjax.splat import Gaussians, render

PICTURE = "segmentation_baselines.png"
OURS = {
    "pigjax, vote": {},
    "pigjax, alpha·T credits": {"weighting": "alpha"},
    "pigjax, alpha·T, fringes cut": {"weighting": "alpha", "background": "vote", "purity": 0.6, "min_seen": 0.05},
}
CHOICE_EVERY = 4  # thresholds and boxes are chosen on every fourth training view
RIGHT, TOO_MUCH, MISSED = (0.35, 0.70, 0.40), (0.85, 0.20, 0.15), (0.20, 0.40, 0.85)


class Answer(NamedTuple):
    """One answer: Gaussians of each object, and its cost."""

    name: str
    members: np.ndarray  # [n m] bool; a Gaussian may be in several objects, or in none
    seconds: float | None = None  # of training, or of voting; compilation apart
    steps: int = 0
    loss: float | None = None  # mean over the last round of views
    scores: tuple[float, ...] = ()  # as `_scores` gives them


class Learnt(NamedTuple):
    """A trained baseline."""

    name: str
    fitted: Fitted
    members: Callable[..., np.ndarray]  # of parameters
    masks: Callable[..., np.ndarray]  # of camera: pixels of each id by the images themselves, [h w m] bool


def compare(scene: Tabletop, options) -> str:
    """Ours and rivals' methods re-made on the same renderer, on the trained scene and on the cloud with known ids."""
    bundled = load_ply(TABLETOP / "tabletop.ply")
    views, steps = (scene.train, scene.test, scene.names), options.steps
    on_trained = study(bundled, *views, options.media, steps=steps)
    on_cloud = study(scene.gaussians, *views, None, truth=scene.truth, steps=steps)
    shown = picture(PICTURE, "truth, ours, rivals")
    return f"Trained scene:\n\n{on_trained}\n\n{shown}\n\nCloud with known ids:\n\n{on_cloud}"


def study(
    gaussians: Gaussians,
    train: Views,
    test: Views,
    names: dict[int, str],
    folder: Path | None,
    *,
    truth: np.ndarray | None = None,
    steps: int,
    pictured: str = "duck",
) -> str:
    """Tables in Markdown, and the picture in the folder, if one is given.

    Args:
        gaussians: the scene, whose geometry stays as it is.
        train: views that methods learn from.
        test: views that they are scored on.
        names: of the ids, 0 to the highest.
        folder: for the picture.
        truth: true id of every Gaussian, where known.
        steps: of training of the learnt baselines.
        pictured: name of the object in the picture.
    """
    num_ids = max(names) + 1
    ids = [number for number in names if number not in (0, TABLE)]

    def one_hot(object_id) -> np.ndarray:
        return np.asarray(object_id)[:, None] == np.arange(num_ids)

    ours = [_vote(name, gaussians, train, num_ids, one_hot, **settings) for name, settings in OURS.items()]
    known = np.argmax(ours[0].members, 1) if truth is None else truth
    chosen_on = train[::CHOICE_EVERY]
    boxes, percentiles = select_by_box(gaussians, known, num_ids, chosen_on)
    learnt, thresholds = _learn(gaussians, train, chosen_on, num_ids, steps, one_hot)

    def measured(answer: Answer) -> Answer:
        return answer._replace(scores=_scores(answer, gaussians, test, ids, truth))

    curves = [[measured(answer) for answer in _curve(method, len(train))] for method in learnt]
    best = [max(curve, key=lambda answer: answer.scores[0]) for curve in curves]
    box = measured(Answer("axis-aligned box (as PhysGaussian)", boxes))
    answers = [*map(measured, ours), *best, box]
    ceiling = [] if truth is None else [measured(Answer("true ids", one_hot(truth)))]

    columns = ["isolated mIoU", "mBIoU", "visible mIoU", "mBIoU"] + ([] if truth is None else ["Gaussians right"])
    lines = [
        head("method", "steps", "time [s]", *columns),
        *map(_line, answers + ceiling),
        "",
        "Learnt baselines are shown at their best checkpoint, chosen for them by the test views' isolated mIoU. Boxes"
        f" are those of {'our' if truth is None else 'the true'} labels, less the percentage at each end that training"
        f" views prefer ({_listed(percentiles, ids, names)}); cosine thresholds are chosen likewise, at the end of"
        f" training {_listed(thresholds, ids, names)}.",
        "",
        head("while training", "steps", "time [s]", "loss", *columns),
        *(_line(answer, loss=True) for curve in curves for answer in curve),
        "",
        head("asked in the image, not of Gaussians", "mIoU", "mBIoU"),
        *(row(method.name, *(f"{score:.1f}" for score in _in_image(method, test, ids))) for method in learnt),
    ]
    if folder is not None:
        number = next(number for number, name in names.items() if name == pictured)
        trained = [*ours, *(curve[-1] for curve in curves), box]
        draw_comparison(gaussians, trained, test, number, pictured, folder / PICTURE)
    return "\n".join(lines)


def _vote(name, gaussians, train, num_ids, one_hot, **settings) -> Answer:
    """Ours, warm. Gaussians that `min_seen` leaves out stay out."""

    def answer():
        labels = lift_masks(gaussians, train.cameras, train.masks, num_ids=num_ids, **settings)
        return np.asarray((labels if "min_seen" in settings else fill_unseen(gaussians, labels)).object_id)

    found = timed(answer, windows=3)
    return Answer(name, one_hot(found.result), found.seconds)


def _learn(gaussians, train, chosen_on, num_ids, steps, one_hot) -> tuple[list[Learnt], dict[int, float]]:
    """The learnt baselines, and the cosine thresholds at the end of training."""
    encoding = train_encoding(gaussians, train, num_ids, steps=steps)
    distilled = train_features(gaussians, train, num_ids, steps=steps)
    _, thresholds = select_by_similarity(gaussians, distilled.final, chosen_on)
    limits = np.array([thresholds.get(number, np.inf) for number in range(num_ids)])
    methods = [
        Learnt(
            "identity encoding (as Gaussian Grouping)",
            encoding,
            lambda params: one_hot(encoded_ids(params)),
            lambda camera: np.asarray(image_ids(gaussians, encoding.final, camera))[..., None] == np.arange(num_ids),
        ),
        Learnt(
            "distilled features (as LangSplat)",
            distilled,
            lambda params: select_by_similarity(gaussians, params, chosen_on)[0],
            lambda camera: np.asarray(image_similarities(gaussians, distilled.final, camera)) > limits,
        ),
    ]
    return methods, thresholds


def _curve(method: Learnt, views: int) -> list[Answer]:
    fitted = method.fitted
    return [
        Answer(method.name, method.members(params), fitted.seconds * step / len(fitted.losses), step,
            fitted.mean_loss(step, views))
        for step, params in fitted.params.items()
    ]  # fmt: skip


def _scores(answer: Answer, gaussians, test, ids, truth) -> tuple[float, ...]:
    """mIoU and mBIoU isolated and visible [%], and, where the truth is known, the share of Gaussians right [%].

    A Gaussian is right if it was given to the object that it is of, and to no other; table and background are no
    object.
    """
    scores: list[float] = []
    for mode in ("isolated", "visible"):
        by_object = {}
        for number in ids:
            own = np.where(answer.members[:, number], number, 0)
            by_object |= scores_by_object(gaussians, own, test, [number], mode=mode)
        scores += mean_scores(by_object)
    if truth is not None:
        scores.append(100 * np.mean((answer.members[:, ids] == (truth[:, None] == ids)).all(1)))
    return tuple(scores)


def _in_image(method: Learnt, test: Views, ids) -> tuple[float, float]:
    """mIoU and mBIoU [%] of masks read from blended features, the task that these methods were made for."""
    predictions, truths = {}, {}
    for view in range(len(test)):
        masks = method.masks(test.cameras[view])
        for number in ids:
            if (test.masks[view] == number).any():
                truths[view, number] = test.masks[view] == number
                predictions[view, number] = masks[..., number]
    scores = score_masks(predictions, truths)
    return 100 * scores.mean_iou, 100 * scores.mean_boundary_iou


def _line(answer: Answer, *, loss: bool = False) -> str:
    seconds = "-" if answer.seconds is None else f"{answer.seconds:.3g}"
    scores = [f"{score:.1f}" for score in answer.scores[:4]] + [f"{score:.2f} %" for score in answer.scores[4:]]
    return row(answer.name, answer.steps or "none", seconds, *([f"{answer.loss:.4f}"] if loss else []), *scores)


def _listed(values: dict[int, float], ids, names) -> str:
    return ", ".join(f"{names[number]} {values[number]:g}" for number in ids)


def draw_comparison(
    gaussians: Gaussians, answers: list[Answer], test: Views, number: int, name: str, path: Path
) -> None:
    """The object's Gaussians alone by each method in the test view that shows it largest, and where its mask errs."""
    import matplotlib.pyplot as plt

    view = int(np.argmax(np.sum(test.masks == number, (1, 2))))
    truth, camera = test.masks[view] == number, test.cameras[view]
    figure, axes = plt.subplots(2, len(answers) + 1, figsize=(2.1 * (len(answers) + 1), 4.7), layout="constrained")
    axes[0, 0].imshow(np.where(truth[..., None], test.images[view], 1.0))
    axes[1, 0].imshow(np.where(truth[..., None], RIGHT, 1.0))
    axes[0, 0].set_title(f"truth: {name}", fontsize=8)
    for (above, below), answer in zip(axes[:, 1:].T, answers):
        chosen = jnp.asarray(answer.members[:, number])
        alone = jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], gaussians)
        frame = render(alone, camera, background=1.0, outputs=("rgb", "alpha"))
        above.imshow(np.clip(frame.rgb, 0, 1))
        found = np.asarray(frame.alpha) > 0.5
        below.imshow(np.select([(found & truth)[..., None], found[..., None], truth[..., None]],
                               [RIGHT, TOO_MUCH, MISSED], 1.0))  # fmt: skip
        above.set_title(answer.name.replace(" (as ", "\n(as "), fontsize=8)
    axes[0, 0].set_ylabel("its Gaussians alone", fontsize=8)
    axes[1, 0].set_ylabel("mask: right, too much (red),\nmissed or hidden (blue)", fontsize=8)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=110)
    plt.close(figure)
