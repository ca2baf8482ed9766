"""Drawing: `render` and `surface_depth` (Kerbl et al. 2023).

`render` projects the splats (`splatting.projection`), shades them (`splatting.sh`), bins them into tiles
(`splatting.binning`) and composites each tile front to back (`splatting.compositor`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.core.arguments import checked
from pigjax.core.arrays import in_precision
from pigjax.core.camera import Camera, require_one, stack_cameras
from pigjax.core.errors import InputError
from pigjax.core.linalg import safe_normalize
from pigjax.splatting.binning import bands_of, blend_config, count_pairs, tile_boxes
from pigjax.splatting.compositor import blend
from pigjax.splatting.projection import normals, project_splats
from pigjax.splatting.sh import colours
from pigjax.splatting.sharding import collect, spread
from pigjax.splatting.types import OUTPUTS, Frame, Gaussians, RenderConfig, Splats, as_splats

__all__ = ["Frame", "Gaussians", "RenderConfig", "Splats", "render", "required_capacity", "surface_depth"]


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
        gaussians_or_splats: what is drawn.
        camera: a single camera.
        config: thresholds and capacities.
        background: colour behind the splats, one number, three, or an image.
        outputs: any of "rgb", "alpha", "depth", "surface_depth", "object_weights", "normals", "features"; only these
            are traced. A normal is the shortest axis of a splat.
        object_weights: membership of each splat in each object, needed for the output of that name.
        features: any channels of each splat, needed for the output of that name.
        tau_T: transmittance that marks the surface (paper 3.2); not differentiated through.

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
    return _render(gaussians_or_splats, camera, config, background, tuple(outputs), given, tau_T)


@eqx.filter_jit
def _render(gaussians_or_splats, camera, config, background, outputs, given, tau_T) -> Frame:
    bands = bands_of(camera, config)
    splats = as_splats(spread(gaussians_or_splats, bands))
    if len(splats) == 0:
        # gathers need a row: one splat of opacity 0 draws nothing
        splats, given = jax.tree.map(lambda v: jnp.zeros((1, *v.shape[1:]), v.dtype), (splats, given))
    blending = blend_config(camera, config, len(splats), surface="surface_depth" in outputs)
    projected = project_splats(splats, camera, config)
    channels = {}
    if "rgb" in outputs:
        channels["rgb"] = colours(splats, camera, config.sh_degree)
    if "depth" in outputs:
        channels["depth"] = projected.depths[:, None]
    if "normals" in outputs:
        channels["normals"] = normals(splats, camera)
    channels |= given
    none = jnp.zeros((len(splats), 0), projected.depths.dtype)
    projected, table = collect((projected, jnp.concatenate([none, *channels.values()], 1)), bands)
    reverse = config.differentiation == "reverse"
    alpha, image, surface, overflow = blend(projected, table, blending, tau_T, reverse=reverse)

    ends = np.cumsum([values.shape[1] for values in channels.values()])
    planes: dict[str, Any] = dict(zip(channels, jnp.split(image, ends[:-1], axis=-1)))
    if "rgb" in outputs:
        planes["rgb"] += (1 - alpha)[..., None] * background
    if "depth" in outputs:
        planes["depth"] = jnp.where(alpha > 0, planes["depth"][..., 0] / jnp.where(alpha > 0, alpha, 1.0), 0.0)
    if "normals" in outputs:
        planes["normals"] = safe_normalize(planes["normals"])
    if surface is not None:
        planes["surface_depth"] = jnp.where(surface > 0, surface, jnp.nan)
    return Frame(alpha=alpha if "alpha" in outputs else None, overflow=overflow, **planes)


@checked
def surface_depth(
    gaussians: Gaussians | Splats,
    camera: Camera,
    config: RenderConfig = RenderConfig(),
    *,
    tau_T: Float[Array, ""] | float = 0.5,
) -> Float[Array, "h w"]:
    """Camera z [m] of the Gaussian whose blend takes the transmittance below tau_T (paper 3.2); NaN where none does."""
    depth = render(gaussians, camera, config, outputs=("surface_depth",), tau_T=tau_T).surface_depth
    assert depth is not None
    return depth


@checked
def required_capacity(gaussians: Gaussians | Splats, cameras: Camera, config: RenderConfig = RenderConfig()) -> int:
    """Box/tile pairs that the fullest of these cameras has, host. A capacity at least this large never overflows."""
    splats = as_splats(gaussians)
    batch = cameras if cameras.world_to_cam.ndim == 3 else stack_cameras([cameras])
    return int(_most_pairs(splats, batch, config))


@eqx.filter_jit
def _most_pairs(splats: Splats, cameras: Camera, config: RenderConfig) -> Int[Array, ""]:
    return jnp.max(lax.map(lambda camera: pairs_of(splats, camera, config), cameras))


def pairs_of(splats: Splats, camera: Camera, config: RenderConfig) -> Int[Array, ""]:
    """Box/tile pairs of all splats in one view."""
    blending = blend_config(camera, config, len(splats), surface=False)
    _, box = tile_boxes(project_splats(splats, camera, config), blending)
    return count_pairs(box[:, 0] * box[:, 1])
