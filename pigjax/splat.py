"""Gaussians, posed splats and `render`: the drawing half of pigjax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from pigjax.arguments import checked
from pigjax.arrays import einsum, in_precision, real_field, static_field
from pigjax.bands import collect, spread
from pigjax.camera import Camera, require_one, stack_cameras, to_camera
from pigjax.checks import LARGEST_WHOLE, Limits, check_axes, check_fields
from pigjax.errors import InputError
from pigjax.extent import Extent, scene_extent, typical_distance
from pigjax.linalg import quat_to_matrix, safe_normalize, svd
from pigjax.lists import BlendConfig, Projected, count_pairs, slots_of, tile_boxes
from pigjax.tiles import blend


class Gaussians(eqx.Module):
    """Trainable 3D Gaussians, parametrised as in 3DGS.

    Raises:
        InputError: an array has not its axes, or is not as long as the others.
    """

    means: Float[Array, "n 3"] = real_field()  # [m]
    log_scales: Float[Array, "n 3"] = real_field()  # log of standard deviations in m
    quats: Float[Array, "n 4"] = real_field()  # wxyz, any length; zero means no rotation
    logit_opacities: Float[Array, "n"] = real_field()
    sh: Float[Array, "n k 3"] = real_field()  # spherical harmonics, k = (degree + 1)²

    def __check_init__(self):
        check_axes(self)

    def __len__(self) -> int:
        return self.means.shape[0]


class Splats(eqx.Module):
    """Posed Gaussians, ready to draw: covariance = factors @ factorsᵀ.

    Raises:
        InputError: an array has not its axes, or is not as long as the others.
    """

    means: Float[Array, "n 3"] = real_field()  # [m]
    factors: Float[Array, "n 3 3"] = real_field()  # [m]
    opacities: Float[Array, "n"] = real_field()  # in [0, 1]
    sh: Float[Array, "n k 3"] = real_field()
    sh_rotations: Float[Array, "n 3 3"] | None = real_field(default=None)  # turns view-dependent colour with the matter

    def __check_init__(self):
        check_axes(self)

    def __len__(self) -> int:
        return self.means.shape[0]


class Frame(eqx.Module):
    """One drawn image; outputs that were not asked for are None."""

    rgb: Float[Array, "*b h w 3"] | None = None
    alpha: Float[Array, "*b h w"] | None = None
    depth: Float[Array, "*b h w"] | None = None  # mean camera z of what is seen [m], 0 where nothing is
    surface_depth: Float[Array, "*b h w"] | None = None  # camera z [m], NaN where transmittance stays above tau_T
    object_weights: Float[Array, "*b h w m"] | None = None  # share of each object in the pixel
    normals: Float[Array, "*b h w 3"] | None = None  # unit, in the world, towards the camera; 0 where nothing is
    features: Float[Array, "*b h w f"] | None = None  # sums of each splat's features weighted by alpha·T
    overflow: Int[Array, "*b"] | None = None  # box/tile pairs dropped for want of capacity


class RenderConfig(eqx.Module):
    """Every approximation of the renderer, static.

    Raises:
        InputError: a number is not finite or out of range, or a choice does not exist.
    """

    tile_size: int = static_field(default=16, limits=Limits(1, 1024, unit="px"))
    # box/tile pairs listed per image; None: all, or see below
    capacity: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # of them sorted at once; None: 2¹⁷ on a CPU, 2²¹ elsewhere, / bands
    slots: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    sh_degree: int | None = static_field(default=None, limits=Limits(0, 3))  # None: all bands that the splats have
    # fainter contributions are skipped
    alpha_min: float = static_field(default=1 / 255, limits=Limits(0, 1, below=True))
    alpha_max: float = static_field(default=0.99, limits=Limits(0, 1, above=True))
    # a pixel is closed before it falls below
    transmittance_min: float = static_field(default=1e-4, limits=Limits(0, 1, below=True))
    dilation: float = static_field(default=0.3, limits=Limits(0, 1e6, unit="px²"))  # added to the 2D covariance
    antialias: bool = static_field(default=False)  # lower the opacity by what the dilation added
    # None: a hundredth of the splats' typical distance
    near: float | None = static_field(default=None, limits=Limits(0.0, 1e9, unit="m"))
    # splats blended between two looks at a tile; None: 64, or 16 if few
    chunk: int | None = static_field(default=None, limits=Limits(1, 1_000_000))
    # walked together; None: 1 on a CPU, 2048 elsewhere
    tiles_at_once: int | None = static_field(default=None, limits=Limits(1, LARGEST_WHOLE))
    # local devices that share the image, each a band of rows
    bands: int = static_field(default=1, limits=Limits(1, 4096))
    # "forward" goes through any mode and order (jvp, hessian), but is slower, and its lists have a static capacity: 16
    # pairs per splat unless given (`required_capacity` finds it); what does not fit is counted in Frame.overflow
    differentiation: str = static_field(default="reverse", choices=("reverse", "forward"))

    def __check_init__(self):
        check_fields(self)
        if self.alpha_min >= self.alpha_max:
            raise InputError(
                f"RenderConfig.alpha_min = {self.alpha_min}: must be < alpha_max = {self.alpha_max}, or none is drawn."
            )


OUTPUTS = ("rgb", "alpha", "depth", "surface_depth", "object_weights", "normals", "features")
_SH_CONSTANT = 0.28209479177387814
_NEAR = 0.01  # of the splats' typical distance from the camera: 1 cm at 1 m
_FOV_MARGIN = 0.3  # the projection's linearisation is held at this share of half the image beyond its edge


def gaussian_factors(gaussians: Gaussians) -> Float[Array, "n 3 3"]:
    """Factors M = R S of the covariances M Mᵀ [m]."""
    return quat_to_matrix(gaussians.quats) * jnp.exp(gaussians.log_scales)[:, None, :]


def as_splats(gaussians: Gaussians | Splats) -> Splats:
    """Gaussians as they stand, undeformed."""
    if isinstance(gaussians, Splats):
        return gaussians
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    return Splats(gaussians.means, gaussian_factors(gaussians), opacities, gaussians.sh)


def extent_of(gaussians: Gaussians) -> Extent:
    """Middle and size of the dense core of Gaussians, host; see `scene_extent`.

    Raises:
        InputError: there is no Gaussian with a finite centre.
    """
    opacities = np.asarray(jax.nn.sigmoid(gaussians.logit_opacities))
    return scene_extent(np.asarray(gaussians.means), opacities, np.exp(np.asarray(gaussians.log_scales).max(1)))


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


def bands_of(camera: Camera, config: RenderConfig) -> int:
    """Devices that share an image: no more than it has rows of tiles."""
    return min(config.bands, -(-camera.height // config.tile_size))


def blend_config(camera: Camera, config: RenderConfig, count: int, *, surface: bool) -> BlendConfig:
    """What listing and blending need of the camera, the number of splats and the settings."""
    on_cpu = jax.default_backend() == "cpu"
    tiles = -(-camera.width // config.tile_size) * -(-camera.height // config.tile_size)
    chunk = 64 if 6 * count > 32 * tiles else 16
    limit = config.slots or 2 ** (17 if on_cpu else 21) // config.bands
    return BlendConfig(
        width=camera.width,
        height=camera.height,
        tile=config.tile_size,
        chunk=config.chunk or chunk,
        slots=slots_of(count, tiles, config.capacity, limit),
        capacity=config.capacity,
        tiles_at_once=config.tiles_at_once or (1 if on_cpu else 2048),
        by_products=not on_cpu,
        bands=bands_of(camera, config),
        alpha_min=config.alpha_min,
        alpha_max=config.alpha_max,
        transmittance_min=config.transmittance_min,
        near=config.near or 0.0,  # 0 orders every depth that occurs
        surface=surface,
    )


def near_plane(splats: Splats, camera: Camera, config: RenderConfig) -> Float[Array, ""] | float:
    """Camera z [m] up to which nothing is drawn and nothing votes; it scales with the scene unless set."""
    if config.near is not None:
        return config.near
    return _NEAR * typical_distance(splats.means, lax.stop_gradient(camera.position))


def colours(splats: Splats, camera: Camera, sh_degree: int | None = None) -> Float[Array, "n 3"]:
    """Colour of each splat as the camera sees it, at least 0; colour turns with the splat's `sh_rotations`."""
    degree = sh_degree_of(splats) if sh_degree is None else min(sh_degree, sh_degree_of(splats))
    if degree == 0:
        return jnp.maximum(_SH_CONSTANT * splats.sh[:, 0] + 0.5, 0.0)
    directions = safe_normalize(splats.means - camera.position)
    if splats.sh_rotations is not None:
        directions = einsum("nij,ni->nj", splats.sh_rotations, directions)
    basis = sh_basis(directions, degree)
    return jnp.maximum(einsum("nk,nkc->nc", basis, splats.sh[:, : basis.shape[1]]) + 0.5, 0.0)


def normals(splats: Splats, camera: Camera) -> Float[Array, "n 3"]:
    """Shortest axis of each splat, in the world, on the side of the camera."""
    axis = svd(splats.factors)[0][..., 2]
    away = jnp.sum(axis * (splats.means - camera.position), 1, keepdims=True) > 0
    return jnp.where(away, -axis, axis)


def sh_degree_of(gaussians: Gaussians | Splats) -> int:
    """Highest band of spherical harmonics that is stored.

    Raises:
        InputError: the number of coefficients is not 1, 4, 9 or 16.
    """
    bands = {1: 0, 4: 1, 9: 2, 16: 3}
    count = gaussians.sh.shape[1]
    if count not in bands:
        raise InputError(f"sh has {count} coefficients per channel: 1, 4, 9 or 16 are needed (degree 0 to 3).")
    return bands[count]


def sh_basis(directions: Float[Array, "n 3"], degree: int) -> Float[Array, "n k"]:
    """Real spherical harmonics up to a degree at unit directions, in the order and signs of 3DGS."""
    x, y, z = directions.T
    basis = [jnp.full_like(x, _SH_CONSTANT)]
    if degree > 0:
        basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    if degree > 1:
        c = 1.0925484305920792
        basis += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)]
        basis += [-c * x * z, 0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        round_, axis = 4 * z * z - x * x - y * y, 0.4570457994644658
        basis += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z, -axis * y * round_]
        basis += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y), -axis * x * round_]
        basis += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return jnp.stack(basis, 1)


def project_splats(splats: Splats, camera: Camera, config: RenderConfig) -> Projected:
    """EWA projection from the factor: 2D covariance = (J W M)(J W M)ᵀ + dilation (Zwicker et al. 2001)."""
    camera = in_precision(camera, splats.means.dtype)
    fx, fy = camera.focal
    cx, cy = camera.centre
    x, y, depth = to_camera(splats.means, camera).T
    ahead = depth > near_plane(splats, camera, config)
    z = jnp.where(ahead, depth, 1.0)
    u, v = x / z, y / z
    margin_x, margin_y = _FOV_MARGIN * camera.width / (2 * fx), _FOV_MARGIN * camera.height / (2 * fy)
    held_u = jnp.clip(u, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    held_v = jnp.clip(v, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    rotated = einsum("ij,njk->ink", camera.world_to_cam[:3, :3], splats.factors)
    row_x = (rotated[0] - held_u[:, None] * rotated[2]) * (fx / z)[:, None]
    row_y = (rotated[1] - held_v[:, None] * rotated[2]) * (fy / z)[:, None]
    a, b, c = (jnp.sum(p * q, 1) for p, q in ((row_x, row_x), (row_x, row_y), (row_y, row_y)))
    opacities = splats.opacities
    if config.antialias:
        bare = jnp.maximum(a * c - b * b, 0.0)
        a, c = a + config.dilation, c + config.dilation
        flat = bare <= 0  # a needle seen end on: the root's slope is infinite there
        opacities = opacities * jnp.where(flat, 0.0, jnp.sqrt(jnp.where(flat, 1.0, bare) / (a * c - b * b)))
    else:
        a, c = a + config.dilation, c + config.dilation
    # a needle's a·c and b·b cancel in float32; the dilated determinant is at least dilation²
    tiny = float(jnp.finfo(a.dtype).tiny)
    least = max(config.dilation**2, tiny)
    widest = jnp.sqrt(jnp.maximum(a * c - least, tiny))
    b = jnp.clip(b, -widest, widest)
    determinant = jnp.maximum(a * c - b * b, least)
    conics = jnp.stack([c, -b, a], 1) / determinant[:, None]
    centres = jnp.stack([fx * u + cx, fy * v + cy], 1)

    faint = jnp.log(jnp.maximum(opacities / max(config.alpha_min, tiny), 1.0))
    radii = lax.stop_gradient(jnp.sqrt(2 * faint[:, None] * jnp.stack([a, c], 1)))
    size = jnp.array([camera.width, camera.height], centres.dtype)
    on_image = jnp.all((centres + radii > 0) & (centres - radii < size), 1)
    visible = ahead & (opacities >= config.alpha_min) & (opacities > 0) & on_image
    return Projected(centres, conics, opacities, depth, radii, visible)
