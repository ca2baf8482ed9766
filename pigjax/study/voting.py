"""The vote of the views as an experiment: its thresholds vary, and masks of held-out views are the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.core.camera import Camera
from pigjax.core.checks import suggest
from pigjax.core.errors import SceneError
from pigjax.scene.plan import check_ids_occur, read_inputs
from pigjax.scene.schema import Scene
from pigjax.segmentation import enough_capacity, lift_masks
from pigjax.splat import Gaussians, RenderConfig, render

_THRESHOLDS = ("tau_T", "tau_d")


class Voting(eqx.Module):
    """Votes of the training views, scored in others."""

    gaussians: Gaussians
    cameras: Camera
    masks: Int[Array, "t h w"]
    held_cameras: Camera
    held_masks: Int[Array, "s h w"]
    tau_T: Float[Array, ""]
    tau_d: Float[Array, ""]
    temperature: Float[Array, ""] | None  # None: hard votes, which have no gradient
    num_ids: int = eqx.field(static=True)
    config: RenderConfig = eqx.field(static=True)

    def names(self) -> tuple[str, ...]:
        """Every parameter that `with_parameters` takes."""
        return tuple(f"segmentation.{field}" for field in _THRESHOLDS)

    def value(self, name: str) -> Float[Array, ""]:
        """Present value of a parameter."""
        return getattr(self, self._field(name))

    def with_parameters(self, values: Mapping[str, Any]) -> Voting:
        """The same with other thresholds.

        Raises:
            SceneError: a name that is none of them.
        """
        changes: dict[str, Any] = {self._field(name): jnp.asarray(value) for name, value in values.items()}
        return replace(self, **changes)

    def scores(self) -> dict[str, Float[Array, ""]]:
        """Loss and agreement of the objects with the held-out masks.

        A Gaussian belongs to each object by its share of the votes, or of one where it has less (all to the winner
        where votes are hard), a pixel by the splats blended in it. `iou` is the mean over objects of
        Σ min(share, mask) / Σ max(share, mask); the loss is 1 - iou.
        """
        labels = lift_masks(
            self.gaussians,
            self.cameras,
            self.masks,
            num_ids=self.num_ids,
            tau_T=self.tau_T,
            tau_d=self.tau_d,
            temperature=self.temperature,
            config=self.config,
        )
        if self.temperature is None:
            member = jax.nn.one_hot(labels.object_id, self.num_ids)
        else:
            objects = labels.votes[:, 1:]
            share = objects / jnp.maximum(objects.sum(1, keepdims=True), 1.0)
            member = jnp.concatenate([jnp.zeros_like(share[:, :1]), share], 1)

        @jax.checkpoint
        def overlap(view):
            world_to_cam, focal, centre, mask = view
            held = self.held_cameras
            camera = Camera(world_to_cam, focal, centre, held.width, held.height)
            frame = render(self.gaussians, camera, outputs=("object_weights",), object_weights=member)
            assert frame.object_weights is not None
            seen = frame.object_weights[..., 1:]
            truth = jax.nn.one_hot(mask, self.num_ids)[..., 1:]
            return jnp.minimum(seen, truth).sum((0, 1)), jnp.maximum(seen, truth).sum((0, 1))

        held = self.held_cameras
        both, either = lax.map(overlap, (held.world_to_cam, held.focal, held.centre, self.held_masks))
        iou = jnp.mean(both.sum(0) / jnp.maximum(either.sum(0), 1.0))
        return {"loss": 1 - iou, "iou": iou, "seen": jnp.mean(labels.object_id >= 0)}

    def _field(self, name: str) -> str:
        if name not in self.names():
            raise SceneError(f"parameter {name}: the vote has none of that name; {suggest(name, self.names())}.")
        return name.partition(".")[2]


def voting(scene: Scene, *, temperature: float | None = None) -> Voting:
    """Read a scene and make an experiment of its vote. Host.

    Args:
        scene: with views and masks; its test split, or every fourth view where there is none, is held out.
        temperature: of soft votes, see `lift_masks`; None: hard votes.

    Raises:
        InputError: a file is missing or damaged.
        SceneError: the scene has no views.
    """
    inputs = read_inputs(scene)
    if inputs.views is None or inputs.views.masks is None:
        raise SceneError("input.views is missing: a study of segmentation needs posed photos with masks.")
    check_ids_occur(inputs.ids, inputs.views.masks)
    views = inputs.views.masked
    assert views.masks is not None
    masks, number = _compact(views.masks, inputs.ids.values())
    views = eqx.tree_at(lambda v: v.masks, views, masks)
    train, held = views.training, views.held_out
    if held is not None and "train" in views.splits:
        shown, hidden = (train.cameras, train.masks), (held.cameras, held.masks)
    else:
        every = np.arange(len(views.cameras)) % 4 == 3
        shown, hidden = ((views.cameras[pick], masks[pick]) for pick in (~every, every))
    config = RenderConfig() if temperature is None else enough_capacity(inputs.gaussians, shown[0], RenderConfig())
    return Voting(
        gaussians=inputs.gaussians,
        cameras=shown[0],
        masks=jnp.asarray(shown[1]),
        held_cameras=hidden[0],
        held_masks=jnp.asarray(hidden[1]),
        tau_T=jnp.asarray(scene.segmentation.tau_T),
        tau_d=jnp.asarray(scene.segmentation.tau_d),
        temperature=None if temperature is None else jnp.asarray(temperature),
        num_ids=number,
        config=config,
    )


def _compact(masks: Int[np.ndarray | Array, "t h w"], ids: Iterable[int]) -> tuple[Int[np.ndarray, "t h w"], int]:
    """Masks whose ids, and those of the scene, are numbered from 0, and how many there are."""
    masks = np.asarray(masks)
    known = np.union1d(np.unique(masks), [0, *ids])
    return np.searchsorted(known, masks).astype(np.int32), max(len(known), 2)
