"""Drawing: `render` and `surface_depth` (Kerbl et al. 2023).

`render` rasterizes splats; it reads project → shade → bin → composite:

1. project (`splatting.projection`): each Gaussian becomes an ellipse on the image plane (EWA splatting);
2. shade (`splatting.sh`): its colour in the direction of the camera, and whatever else is to be composited;
3. bin (`splatting.binning`): the splats in order of depth, and the tiles of 16 x 16 pixels that each may touch; the
   list of each tile is built while compositing, so that tiles which are opaque already take no more splats;
4. composite (`splatting.compositor`): each tile sums its list front to back with weights alpha·T.

`splatting.reference` is the same in sixty plain lines, every splat at every pixel: read it first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import in_precision
from pigjax.core.camera import Camera, require_one, stack_cameras
from pigjax.core.errors import InputError
from pigjax.core.linalg import safe_normalize
from pigjax.splatting.binning import (
    bin_splats,
    blend_config,
    count_pairs,
    pixels_of,
    shards_of,
    tile_boxes,
    touched_tiles,
    within_tiles,
)
from pigjax.splatting.compositor import Blended, composite
from pigjax.splatting.projection import normals, project_splats
from pigjax.splatting.sh import colours
from pigjax.splatting.sharding import all_gather, shard_splats
from pigjax.splatting.types import OUTPUTS, Frame, Gaussians, Projected, RenderConfig, Splats, as_splats

__all__ = [
    "Frame",
    "Gaussians",
    "RenderConfig",
    "Splats",
    "render",
    "render_over",
    "required_capacity",
    "surface_depth",
]

Channels = dict[str, Float[Array, "n _"]]  # channels of each splat by output, in the order of the table's columns


@checked
def render(
    gaussians_or_splats: Gaussians | Splats,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    *,
    background: Float[Array, "*c"] | float = 0.0,
    outputs: Sequence[str] = ("rgb", "alpha"),
    object_weights: Float[Array, "n m"] | None = None,
    features: Float[Array, "n f"] | None = None,
    tau_T: Float[Array, ""] | float = 0.5,
) -> Frame:
    """Draw splats through one camera (Kerbl et al. 2023); `vmap` over cameras for a batch.

    Args:
        gaussians_or_splats: the scene; lengths in m, in the world.
        camera: a single camera.
        config: thresholds and capacities; the defaults are those of 3DGS.
        background: colour behind the splats: one number, three, or an image [h w 3]; black by default.
        outputs: any of "rgb", "alpha", "depth", "surface_depth", "object_weights", "normals", "features"; only these
            are traced. A normal is the shortest axis of a splat.
        object_weights: membership of each splat in each object, needed for the output of that name.
        features: any channels of each splat, needed for the output of that name.
        tau_T: transmittance below which the surface lies, in [0, 1] (PIG, section 3.2); half by default, which gives
            the median depth; not differentiated.

    Returns:
        The outputs asked for, and the splat/tile pairs dropped for want of capacity (see `RenderConfig.capacity`).

    Raises:
        InputError: unknown output, object weights or features asked for but not given, or a batch of cameras.
    """
    unknown = [name for name in outputs if name not in OUTPUTS]
    if unknown or not outputs:
        raise InputError(f"outputs = {tuple(outputs)}: choose from {', '.join(OUTPUTS)}.")
    if "object_weights" in outputs and object_weights is None:
        raise InputError("outputs has 'object_weights': pass object_weights, the membership [n m] of each splat.")
    if "features" in outputs and features is None:
        raise InputError("outputs has 'features': pass features, the channels [n f] of each splat.")
    given = {"object_weights": object_weights, "features": features}
    given = {name: values for name, values in given.items() if name in outputs}
    require_one(camera, "camera")
    dtype = gaussians_or_splats.means.dtype
    tau_T, background = jnp.asarray(tau_T, dtype), jnp.asarray(background, dtype)
    camera, given = in_precision((camera, given), dtype)
    return _render(gaussians_or_splats, camera, config, background, tuple(outputs), given, tau_T)[0]


@checked
def render_over(
    still: Float[Array, "h w 3"],
    splats: Gaussians | Splats,
    moving: Bool[Array, "n"],
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    *,
    background: Float[Array, "*c"] | float = 0.0,
    everywhere: Bool[Array, ""] | bool = False,
) -> Float[Array, "h w 3"]:
    """The picture of `render` where some splats moved and the camera did not: other tiles are those of a still picture.

    A tile that no moving splat may touch shows the others alone, as `still` does: its pixels are taken from there, and
    only splats that reach into another tile are listed. `still` is the picture of the splats that do not move.

        still = render(hidden, camera, background=1.0).rgb  # the moving ones with a logit of opacity of -40
        rgb = render_over(still, posed, moving, camera, background=1.0)

    Args:
        still: picture of the splats that do not move, from the same camera, over the same background.
        splats: all of them, in the world [m].
        moving: which of them may differ from those of `still`.
        camera: a single camera.
        config: thresholds and capacities.
        background: colour behind the splats, as of `render`.
        everywhere: draw all tiles, which gives `render`'s picture without a second program; False by default.

    Returns:
        RGB, equal to that of `render` up to rounding: shorter lists are cut into passes at other places.

    Raises:
        InputError: a batch of cameras.
    """
    require_one(camera, "camera")
    dtype = splats.means.dtype
    camera, still = in_precision((camera, still), dtype)
    tau_T, over = jnp.asarray(0.5, dtype), jnp.asarray(background, dtype)
    frame, changed = _render(splats, camera, config, over, ("rgb",), {}, tau_T, (moving, jnp.asarray(everywhere)))
    assert frame.rgb is not None
    return jnp.where(changed[..., None], frame.rgb, still)


@eqx.filter_jit
def _render(
    gaussians_or_splats: Gaussians | Splats,
    camera: Camera,
    config: RenderConfig,
    background: Float[Array, "*c"],
    outputs: tuple[str, ...],
    given: Any,
    tau_T: Float[Array, ""],
    changed: tuple[Bool[Array, "n"], Bool[Array, ""]] | None = None,
) -> tuple[Frame, Any]:
    """The outputs, and the pixels of tiles that a change may touch: of some splats, or of all if the flag is set."""
    shards = shards_of(camera, config)
    splats = as_splats(shard_splats(gaussians_or_splats, shards))
    if len(splats) == 0:
        # gathers need a row: one splat of opacity 0 draws nothing
        splats, given = jax.tree.map(lambda v: jnp.zeros((1, *v.shape[1:]), v.dtype), (splats, given))
        changed = None if changed is None else (jnp.zeros(1, bool), changed[1])
    blending = blend_config(camera, config, len(splats), surface="surface_depth" in outputs)

    with jax.named_scope("project"):
        projected = project_splats(splats, camera, config)
    with jax.named_scope("shade"):
        channels = shade_splats(splats, projected, camera, config, outputs) | given
    projected, table = all_gather((projected, _columns(channels, projected)), shards)
    with jax.named_scope("bin"):
        boxes, pixels = bin_splats(projected, blending), None
        if changed is not None:
            tiles = touched_tiles(projected, changed[0], blending) | changed[1]
            boxes, pixels = within_tiles(boxes, tiles, blending), pixels_of(tiles, blending)
    with jax.named_scope("composite"):
        reverse = config.differentiation == "reverse"
        blended = composite(projected, table, boxes, blending, tau_T, reverse=reverse)
    return _frame(blended, channels, outputs, background), pixels


def shade_splats(
    splats: Splats, projected: Projected, camera: Camera, config: RenderConfig, outputs: Sequence[str]
) -> Channels:
    """Channels that the outputs composite and that follow from splats and camera: colour, depth [m], normal."""
    channels = {}
    if "rgb" in outputs:
        channels["rgb"] = colours(splats, camera, config.sh_degree)
    if "depth" in outputs:
        channels["depth"] = projected.depths[:, None]
    if "normals" in outputs:
        channels["normals"] = normals(splats, camera)
    return channels


def _columns(channels: Channels, projected: Projected) -> Float[Array, "n c"]:
    none = jnp.zeros((len(projected.depths), 0), projected.depths.dtype)
    return jnp.concatenate([none, *channels.values()], 1)


def _frame(blended: Blended, channels: Channels, outputs: Sequence[str], background: Float[Array, "*c"]) -> Frame:
    """The outputs from sums of channels: background added, depth divided by alpha, normals made unit."""
    alpha, surface = blended.alpha, blended.surface
    ends = np.cumsum([values.shape[1] for values in channels.values()])
    planes: dict[str, Any] = dict(zip(channels, jnp.split(blended.features, ends[:-1], axis=-1)))
    if "rgb" in outputs:
        planes["rgb"] += (1 - alpha)[..., None] * background
    if "depth" in outputs:
        planes["depth"] = jnp.where(alpha > 0, planes["depth"][..., 0] / jnp.where(alpha > 0, alpha, 1.0), 0.0)
    if "normals" in outputs:
        planes["normals"] = safe_normalize(planes["normals"])
    if surface is not None:
        planes["surface_depth"] = jnp.where(surface > 0, surface, jnp.nan)
    return Frame(alpha=alpha if "alpha" in outputs else None, overflow=blended.overflow, **planes)


@checked
def surface_depth(
    gaussians: Gaussians | Splats,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    *,
    tau_T: Float[Array, ""] | float = 0.5,
) -> Float[Array, "h w"]:
    """Depth of the visible surface: camera z of the splat that takes the transmittance below tau_T (PIG, section 3.2).

    Args:
        gaussians: the scene.
        camera: a single camera.
        config: thresholds and capacities.
        tau_T: transmittance below which the surface lies, in [0, 1]; not differentiated.

    Returns:
        Camera z [m], NaN where the transmittance stays above tau_T.

    Raises:
        InputError: a batch of cameras.
    """
    depth = render(gaussians, camera, config, outputs=("surface_depth",), tau_T=tau_T).surface_depth
    assert depth is not None
    return depth


def backproject(
    splats: Gaussians | Splats,
    camera: Camera,
    pixels: Float[Array, "h w c"],
    config: RenderConfig = RenderConfig(),
) -> tuple[Float[Array, "n c"], Int[Array, ""]]:
    """Sum over all pixels of each splat's alpha·T times the value of the pixel: the transpose of compositing.

    Compositing is linear in the features of the splats, so its reverse-mode derivative by them, with the pixels as
    cotangent, is this sum (as in FlashSplat, Shen et al. 2024). It costs one render and its backward pass.

    Args:
        splats: the scene.
        camera: a single camera.
        pixels: values of each pixel, any number of channels.
        config: thresholds and capacities; the fast compositor is used whatever `differentiation` says.

    Returns:
        The sums, and the splat/tile pairs dropped for want of capacity.
    """
    config = dataclasses.replace(config, differentiation="reverse")

    def blend(weights):
        frame = render(splats, camera, config, outputs=("object_weights",), object_weights=weights)
        return frame.object_weights, frame.overflow

    weights = jnp.zeros((len(splats), pixels.shape[-1]), splats.means.dtype)
    _, transpose, overflow = jax.vjp(blend, weights, has_aux=True)
    return transpose(pixels)[0], overflow


@checked
def required_capacity(gaussians: Gaussians | Splats, cameras: Camera, config: RenderConfig = RenderConfig()) -> int:
    """Number of splat/tile pairs in the fullest view; with a capacity at least this large nothing is dropped. Host.

    Args:
        gaussians: the scene.
        cameras: one camera or a batch.
        config: tile size and thresholds.
    """
    splats = as_splats(gaussians)
    batch = cameras if cameras.world_to_cam.ndim == 3 else stack_cameras([cameras])
    return int(_most_pairs(splats, batch, config))


@eqx.filter_jit
def _most_pairs(splats: Splats, cameras: Camera, config: RenderConfig) -> Int[Array, ""]:
    return jnp.max(lax.map(lambda camera: pairs_of(splats, camera, config), cameras))


def pairs_of(splats: Splats, camera: Camera, config: RenderConfig) -> Int[Array, ""]:
    """Number of splat/tile pairs of all splats in one view."""
    blending = blend_config(camera, config, len(splats), surface=False)
    _, box = tile_boxes(project_splats(splats, camera, config), blending)
    return count_pairs(box[:, 0] * box[:, 1])
