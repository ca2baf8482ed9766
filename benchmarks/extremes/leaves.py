"""Leaf functions over the whole float range: values and gradients, in float32 and float64.

Every function meets a few shapes of input (ordinary, flat, equal, graded, ...) at each of many scales, all in one
program under `vmap`. Within its limits a value and its gradient, to all inputs at once, must be finite; beyond them
results overflow, as those of any floating-point function of that degree. Where a limit is not the end of the float
range, its reason is stated.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.extremes.judging import BEYOND, FAULT, FINITE, Outcome
from pigjax.clamp import ClampParams, clamped_shapes
from pigjax.core import linalg, metrics
from pigjax.core.camera import Camera, project
from pigjax.core.extent import typical_distance
from pigjax.core.harmonics import rotated_sh
from pigjax.mpm import Grid
from pigjax.mpm.colliders import Box, Capsule, Cylinder, Plane, SampledDistance, Sphere
from pigjax.mpm.contact import BodyContact, faces
from pigjax.mpm.forces import ForceField, Impulse, Matter, Spring, Wind
from pigjax.mpm.materials import LAWS, Material, material_table
from pigjax.mpm.materials.laws import respond
from pigjax.mpm.timestep import stable_dt
from pigjax.splat import RenderConfig
from pigjax.splatting.projection import project_splats
from pigjax.splatting.sh import colours
from pigjax.splatting.types import Gaussians, Splats, gaussian_factors
from pigjax.study.optimize import Bounds

Limit = Callable[[Any], tuple[float, float]]  # of `finfo`
PRECISIONS = (np.float32, np.float64)


class Leaf(NamedTuple):
    """A function of one case, its inputs at a scale, and the scales between which it must be finite."""

    function: Callable[..., Any]
    inputs: Callable[[float], tuple[np.ndarray, ...]]  # each [k ...]: k shapes at a scale
    limit: Limit
    why: str  # reason of the limit
    scales: np.ndarray | None = None  # None: the whole range of the float
    at_zero: bool = True  # whether it must be finite there, too


def float_range(precision: type) -> np.ndarray:
    """Zero, the smallest numbers, powers of ten, and the largest number of a precision."""
    info = np.finfo(precision)
    powers = np.arange(-36, 37, 4) if precision is np.float32 else np.arange(-300, 301, 25)
    return np.array([0.0, float(info.smallest_subnormal), float(info.tiny), *10.0**powers, float(info.max)])


WORLD = np.array([0.0, *10.0 ** np.arange(-6, 7)])  # stretches and sizes of scenes


def whole(info: Any) -> tuple[float, float]:
    """Up to the largest number, with room for the sum of a few."""
    return 0.0, float(info.max) / 16


def normal(info: Any) -> tuple[float, float]:
    """From where a gradient in inverse proportion to the scale does not overflow."""
    return 256 * float(info.tiny), float(info.max) / 16


def degree(power: int) -> Limit:
    """Up to where a product of so many factors does not overflow."""
    return lambda info: (0.0, float(info.max) ** (1 / power) / 16)


def between(low: float, high: float) -> Limit:
    """The same limits in both precisions."""
    return lambda _: (low, high)


def judged(leaf: Leaf, precision: type) -> list[Outcome]:
    """The outcome of every case."""
    scales = float_range(precision) if leaf.scales is None else leaf.scales
    with jax.enable_x64(precision is np.float64):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            columns = zip(*(leaf.inputs(float(scale)) for scale in scales))
            inputs = [jnp.asarray(np.concatenate(column), precision) for column in columns]
        flags = jax.jit(jax.vmap(partial(_finite, leaf.function)))(*inputs)
    value, gradient = (np.asarray(flag).reshape(len(scales), -1) for flag in flags)
    low, high = leaf.limit(np.finfo(precision))
    found = []
    for scale, values, gradients in zip(scales, value, gradient):
        inside = low <= scale <= high or (scale == 0 and leaf.at_zero)
        for shape, (fine, sloped) in enumerate(zip(values, gradients)):
            if fine and sloped:
                found.append(Outcome(FINITE))
            else:
                what = "gradient" if fine else "value"
                told = f"the {what} at scale {scale:.3g}, shape {shape}, is not finite"
                found.append(Outcome(FAULT if inside else BEYOND, told))
    return found


def _finite(function: Callable[..., Any], *inputs: Any) -> tuple[Any, Any]:
    """Whether the value and its gradient are finite; zeros of another sign are the same number."""
    value, pull = jax.vjp(lambda *inputs: _real(function(*inputs)), *inputs)
    gradients = pull([jnp.cos(jnp.arange(leaf.size, dtype=leaf.dtype)).reshape(leaf.shape) for leaf in value])
    return _all_finite(value), _all_finite(gradients)


def _real(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _all_finite(tree: Any) -> Any:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in _real(tree)]).all()


# Shapes of inputs.

RNG = np.random.default_rng(0)
VECTORS = np.array([[0.3, -0.7, 0.5], [1, 0, 0], [1, 1, 1], [-1, 1e-20, 0], [1e-10, -1, 1e-10], [0, 0, -1]], float)
QUATS = np.array([[0.5, -0.7, 0.3, 0.1], [1, 0, 0, 0], [0, 0, 0, 1], [1, 1, 1, 1], [1e-12, 1, -1e-12, 0]], float)
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURN *= np.sign(np.linalg.det(TURN))
INVERTIBLE = np.stack([
    np.random.default_rng(2).normal(size=(3, 3)), np.eye(3), TURN, np.diag([1.0, 1, -1]), np.diag([2.0, 1, 1]),
    TURN @ np.diag([1.0, 0.1, 0.01]), np.array([[1, 3, 0], [0, 1, 0], [0, 0, 1.0]]),
])  # fmt: skip
SINGULAR = np.stack([np.diag([1.0, 1, 0]), np.outer(TURN[0], TURN[1]), np.diag([0.0, 0, 1]), np.ones((3, 3))])
MATRICES = np.concatenate([INVERTIBLE, SINGULAR])
# stretches: `s` in all, in one, in two directions, and shear by it
STRETCHES = (
    lambda s: s * np.eye(3),
    lambda s: TURN @ np.diag([s, 1.0, 1.0]) @ TURN.T,
    lambda s: TURN @ np.diag([s, s, 1.0]),
    lambda s: np.diag([1.0, 1.0, -s]),
    lambda s: np.array([[1.0, s, 0], [0, 1, 0], [0, 0, 1]]),
    lambda s: s * TURN,
    lambda s: s * MATRICES[0],
    lambda s: -s * np.eye(3),
)


def scaled(shapes: np.ndarray, *others: np.ndarray) -> Callable[[float], tuple[np.ndarray, ...]]:
    """The shapes times the scale; other inputs stay."""
    return lambda s: (s * shapes, *others)


def stretched(*others: np.ndarray) -> Callable[[float], tuple[np.ndarray, ...]]:
    """Deformation gradients; the same other inputs for each."""
    return lambda s: (np.stack([stretch(s) for stretch in STRETCHES]), *(_repeated(v) for v in others))


def _repeated(value: np.ndarray, count: int = len(STRETCHES)) -> np.ndarray:
    return np.repeat(np.asarray(value)[None], count, 0)


def turned(angle: float) -> tuple[np.ndarray]:
    """Rotations by an angle about axes of all kinds."""
    axes = VECTORS / np.linalg.norm(VECTORS, axis=1, keepdims=True)
    skew = np.cross(axes[:, None], np.eye(3)).swapaxes(1, 2)
    return (np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew,)


ANGLES = np.array([0.0, 1e-300, 1e-30, 1e-12, 1e-6, 1e-3, 1, np.pi / 2, np.pi - 1e-3, np.pi - 1e-7, np.pi, 6.0, 1e6])
LINALG = {
    "norm": Leaf(linalg.safe_norm, scaled(VECTORS), whole, "overflow"),
    "normalize": Leaf(linalg.safe_normalize, scaled(VECTORS), normal, "gradient 1/s overflows"),
    "quaternion to matrix": Leaf(linalg.quat_to_matrix, scaled(QUATS), normal, "gradient 1/s overflows"),
    "matrix to quaternion": Leaf(linalg.matrix_to_quat, turned, between(0, 1e9), "all angles", ANGLES),
    "product of quaternions": Leaf(
        linalg.quat_multiply, lambda s: (s * QUATS, s * QUATS[::-1]), degree(2), "s² overflows"
    ),
    "singular values": Leaf(linalg.svd, scaled(MATRICES), normal, "gradient 1/s overflows"),
    "polar": Leaf(linalg.polar, scaled(MATRICES), normal, "gradient 1/s overflows"),
    "aligned singular values": Leaf(linalg.aligned_svd, scaled(MATRICES), normal, "gradient 1/s overflows"),
    "eigenvalues": Leaf(linalg.eigh, scaled(MATRICES + MATRICES.swapaxes(1, 2)), normal, "gradient 1/s overflows"),
    "inverse": Leaf(
        linalg.inv3, scaled(INVERTIBLE), lambda i: (256 / float(i.max) ** 0.5, float(i.max) / 16), "gradient 1/s²",
        at_zero=False,
    ),
    "determinant": Leaf(linalg.det3, scaled(MATRICES), degree(3), "s³ overflows"),
    "cofactors": Leaf(linalg.cofactor, scaled(MATRICES), degree(2), "s² overflows"),
    "product": Leaf(lambda a: linalg.matmul3(a, a), scaled(MATRICES), degree(2), "s² overflows"),
}  # fmt: skip


# Colour and projection.

SIZE = 64
CAMERA = Camera(np.eye(4), np.full(2, 50.0), np.full(2, SIZE / 2), SIZE, SIZE)
SH = np.random.default_rng(3).normal(size=(16, 3))
AHEAD = np.array([[0.1, -0.2, 1], [0, 0, 1], [0.6, 0.6, 1], [5, 0, 1], [0.1, 0.1, -1], [1, 1, 0]], float)


def one_splat(mean: Any, factor: Any, opacity: Any, sh: Any) -> Splats:
    """A scene of one splat."""
    return Splats(mean[None], factor[None], jnp.reshape(opacity, 1), sh[None])


def shade(mean: Any, sh: Any) -> Any:
    """Colour of a splat seen from the origin."""
    return colours(one_splat(mean, jnp.eye(3, dtype=mean.dtype), jnp.ones((), mean.dtype), sh), CAMERA)


def drawn(antialias: bool, mean: Any, factor: Any, opacity: Any) -> Any:
    """What the rasterizer reads of a splat, where it is visible."""
    splats = one_splat(mean, factor, opacity, jnp.zeros((1, 3), mean.dtype))
    found = project_splats(splats, CAMERA, RenderConfig(antialias=antialias))
    numbers = found.centres, found.conics, found.opacities, found.depths
    return jax.tree.map(lambda v: jnp.where(found.visible.reshape(-1, *[1] * (v.ndim - 1)), v, 0.0), numbers)


def splats_at(s: float) -> tuple[np.ndarray, ...]:
    """Splats of all shapes at a distance of `s` and of that size."""
    count = len(AHEAD)
    shapes = 0.1 * s * np.resize(MATRICES[[0, 2, 5, 7, 8]], (count, 3, 3))
    return s * AHEAD, shapes, np.resize([0.5, 1.0, 1e-3], count)


def shaped(log_scale: float) -> tuple[np.ndarray, ...]:
    """Gaussians of that log of scales."""
    return (log_scale * np.array([[1, 1, 1], [1, 0, -1], [-1, -1, -1], [0, 0, 1.0]]), QUATS[:4])


COLOUR = {
    "spherical harmonics": Leaf(
        lambda sh: shade(jnp.asarray([0.3, 0.4, -0.5], sh.dtype), sh),
        lambda s: (s * np.stack([SH, -SH, 0 * SH]),), whole, "overflow",
    ),
    "direction of view": Leaf(
        lambda mean: shade(mean, jnp.asarray(SH, mean.dtype)), scaled(VECTORS), normal, "gradient 1/s overflows"
    ),
    "turned harmonics": Leaf(
        lambda sh, turn: rotated_sh(sh[None], turn[None]), lambda s: (s * SH[None], TURN[None]),
        lambda i: (0.0, float(i.max) / 1e3), "overflow",
    ),
    "projection of points": Leaf(
        lambda x: project(x, CAMERA), scaled(AHEAD[:5]), between(1e-15, 1e15), "numbers of scenes are at most 1e15"
    ),
    **{
        f"projection of splats{', antialiased' * anti}": Leaf(
            partial(drawn, anti), splats_at, between(1e-6, 1e6), "scenes of 1e-6 to 1e6 m", WORLD
        )
        for anti in (False, True)
    },
    "factors of Gaussians": Leaf(
        lambda log_scales, quats: gaussian_factors(
            Gaussians(jnp.zeros((1, 3), quats.dtype), log_scales[None], quats[None], jnp.zeros(1), jnp.zeros((1, 1, 3)))
        ),
        shaped, between(0, 80), "exp overflows float32 at 88", np.array([0.0, 1, 10, 40, 80, 88, 100, 1e4]),
    ),
    "typical distance": Leaf(
        lambda x: typical_distance(x, jnp.zeros(3, x.dtype)), lambda s: (s * np.stack([VECTORS, 0 * VECTORS]),),
        whole, "overflow",
    ),
}  # fmt: skip
CLAMP = {
    f"clamp, {mode}": Leaf(
        lambda F, quats, log_scales, mode=mode: clamped_shapes(
            quats[None], log_scales[None], F[None], ClampParams(), mode=mode, coloured=True
        ),
        stretched(QUATS[0], np.array([-5.0, -3.0, -9.0])), between(0, 1e6), "stretches of 1e-6 to 1e6", WORLD,
    )
    for mode in ("aligned", "literal", "covariance", "fixed")
}  # fmt: skip


# Matter.

NUMBERS = {
    "fibres": {"fibre_stiffness": 4e4},
    "von_mises": {"yield_stress": 500.0},
    "plasticine": {"yield_stress": 500.0, "hardening_modulus": -1e3, "residual_stress": 100.0},
    "drucker_prager": {"friction_angle": 0.6, "cohesion": 10.0},
    "foam": {"yield_stress": 50.0, "viscosity": 5.0, "flow_exponent": 0.6},
    "fluid": {"bulk_modulus": 2e4, "viscosity": 0.1},
}


def material(law: str) -> Material:
    """Jelly of 20 kPa with the further numbers of a law."""
    elastic = {} if law == "fluid" else {"young": 2e4, "poisson": 0.3}
    return Material(law, density=1000.0, **elastic, **NUMBERS.get(law, {}))


def response(law: str, F: Any, rate: Any) -> Any:
    """State and stress after a step of 1e-4 s."""
    answer = respond(law, F, rate, 1e-4, jnp.zeros((), F.dtype) if LAWS[law].hardens else None, material(law))
    return answer.F, answer.stress, answer.hardening


SPIN = np.array([[0.1, -2, 0], [2, 0.3, 0.5], [0, -0.5, -0.2]])
# J² of an isotropic stretch by s times λ, in float32: 1e36 · 1e4 overflows at 1e6
MOST_STRETCH = {"fixed_corotated": 1e5}
MATTER = {
    f"stress, {law}": Leaf(
        partial(response, law), stretched(SPIN), between(0, MOST_STRETCH.get(law, 1e6)),
        "λ J² overflows float32" if law in MOST_STRETCH else "stretches of 1e-6 to 1e6", WORLD,
    )
    for law, kind in LAWS.items() if kind.respond is not None
}  # fmt: skip
# below, the slope of a normal, the inverse of a distance from an axis, overflows
ONE, FAR = np.ones(3), between(1e-15, 1e15)
NO_LARGER = "numbers of scenes are at most 1e15"
SOLIDS = {
    "plane": Plane(point=(0, 0, 0.1), normal=(0, 0, 2.0)),
    "sphere": Sphere(centre=(0, 0, 0.1), radius=1.0),
    "box": Box(lower=-ONE, upper=ONE),
    "capsule": Capsule(start=-ONE, end=ONE, radius=0.5),
    "cylinder": Cylinder(start=-ONE, end=ONE, radius=0.5),
    "turning box": Box(
        lower=-ONE, upper=ONE, angular_velocity=(0, 0, 3.0), velocity=ONE, rotation=(1, 1, 0, 0.0), softness=0.1
    ),
    "samples": SampledDistance(
        samples=np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * 3), -1), axis=-1) - 0.5,
        origin=-ONE, dx=2 / 3,
    ),
}  # fmt: skip


def met(solid: Any, x: Any, v: Any) -> Any:
    """Distance of a point, and its velocity after contact."""
    solid = jax.tree.map(lambda leaf: jnp.asarray(leaf, x.dtype), solid)
    return solid.distance(x, 0.1), solid.apply(solid.contact(x, 0.1), v)


def friction(mode: str, v: Any) -> Any:
    """Velocity after contact with a plane."""
    solid = Plane(point=(0, 0, 0.0), normal=(0, 0, 1.0), friction=0.3, mode=mode)
    solid = jax.tree.map(lambda leaf: jnp.asarray(leaf, v.dtype), solid)
    return solid.apply(solid.contact(jnp.asarray([0.0, 0.0, -0.1], v.dtype)), v)


FORCES = {
    "wind": Wind(velocity=(3.0, 0, 0), drag=2.0, quadratic_drag=1.0, gusts=1.0),
    "field": ForceField(acceleration=(0, 0, 9.0), gradient=-np.eye(3)),
    "impulse": Impulse(momentum=(0, 1.0, 0)),
    "spring": Spring(target=(0, 0, 1.0), stiffness=1e3, damping=1.0),
}


def pushed(force: Any, x: Any, v: Any, mass: Any) -> Any:
    """Change of the velocities of three particles in a step of 1 ms."""
    force = jax.tree.map(lambda leaf: jnp.asarray(leaf, x.dtype), force)
    matter = Matter(x, v, mass[:, None], jnp.ones((3, 1), x.dtype))
    return force.change(matter, force.totals(matter), 1e-3, jnp.zeros((), x.dtype))


def particles_at(*powers: int) -> Callable[[float], tuple[np.ndarray, ...]]:
    """Three particles whose places, velocities and masses are those powers of the scale."""
    x, v, mass = VECTORS[:3] + 0.1, VECTORS[3:] + 0.2, np.array([1.0, 2.0, 3.0])
    return lambda s: tuple((value * s**power)[None] for value, power in zip((x, v, mass), powers))


def step_of(dx: Any, speed: Any, young: Any, viscosity: Any) -> Any:
    """The stable step of an elastic solid and a fluid."""
    dtype = dx.dtype
    table = material_table([
        Material("neo_hookean", density=jnp.asarray(1e3, dtype), young=young, poisson=jnp.asarray(0.3, dtype)),
        Material("fluid", density=jnp.asarray(1e3, dtype), bulk_modulus=young, viscosity=viscosity),
    ])  # fmt: skip
    grid = Grid(jnp.zeros(3, dtype), dx, (8, 8, 8))
    return stable_dt(table, grid, max_speed=speed)


def steps_by(which: int) -> Callable[[float], tuple[np.ndarray, ...]]:
    """Grid spacing, speed, Young's modulus and viscosity, one of them at the scale."""
    usual = [0.05, 1.0, 1e4, 0.1]
    return lambda s: tuple(np.array([s if k == which else value]) for k, value in enumerate(usual))


def parted(mass: Any, velocity: Any) -> Any:
    """Velocities of two bodies that meet in a grid of 4³ nodes."""
    volume = jnp.stack([jnp.arange(4.0), 3 - jnp.arange(4.0)]).astype(mass.dtype)
    volume = jnp.broadcast_to(volume[:, :, None, None, None], (2, 4, 4, 4, 1))
    place = jnp.stack(jnp.meshgrid(*[jnp.arange(4, dtype=mass.dtype)] * 3, indexing="ij"), -1)
    speed = jnp.stack([velocity, -velocity])[:, None, None, None]
    shape = jnp.broadcast_to(speed, (2, 4, 4, 4, 3))
    return BodyContact(bodies=2, friction=0.3).part(shape, volume * mass, faces(volume, volume * place))


STEPS = np.array([1e-12, 1e-9, 1e-6, 1e-3, 1, 1e3, 1e6, 1e9, 1e12, 1e15])
MATTER |= {f"distance, {name}": Leaf(
    partial(met, solid), lambda s: (s * VECTORS, VECTORS[::-1] + 0.1), FAR, NO_LARGER
) for name, solid in SOLIDS.items()}  # fmt: skip
MATTER |= {
    f"contact, {mode}": Leaf(partial(friction, mode), lambda s: (s * np.concatenate([VECTORS, -VECTORS]),), FAR,
                             NO_LARGER)
    for mode in ("sticky", "slip", "separate")
}  # fmt: skip
MATTER |= {
    f"{name}, {what}": Leaf(partial(pushed, force), particles_at(*powers), limit, why)
    for name, force in FORCES.items()
    for what, powers, limit, why in (
        ("places", (1, 0, 0), FAR, NO_LARGER),
        ("speeds", (0, 1, 0), FAR, NO_LARGER),
        ("masses", (0, 0, 1), between(1e-15, 1e15), NO_LARGER),
    )
}
MATTER |= {
    f"stable step, {name}": Leaf(step_of, steps_by(which), between(low, 1e15), NO_LARGER, scales)
    for which, (name, low, scales) in enumerate((
        ("spacing", 1e-12, STEPS), ("speed", 0, np.array([0.0, *STEPS])), ("stiffness", 1e-12, STEPS),
        ("viscosity", 0, np.array([0.0, *STEPS])),
    ))
}  # fmt: skip
MATTER |= {
    "contact of bodies, masses": Leaf(
        lambda m: parted(m, jnp.ones(3, m.dtype)), lambda s: (np.array([s]),), between(1e-12, 1e12), "shares of mass"
    ),
    "contact of bodies, speeds": Leaf(
        lambda v: parted(jnp.ones((), v.dtype), v), scaled(VECTORS), FAR, NO_LARGER
    ),
}  # fmt: skip

# Scores and searches.

PICTURES = np.random.default_rng(4).random((3, 12, 12, 3))
PICTURES[1], PICTURES[2] = 1.0, np.indices((12, 12))[0][..., None] % 2
LEVELS = np.array([0.0, 1e-12, 1e-6, 1 / 255, 1, 10, 1e4, 1e6, 1e9])
ENDS = {
    "between": Bounds(1e-3, 1e3),
    "above": Bounds(low=0.5),
    "below": Bounds(high=0.5),
    "log": Bounds(1e-3, 1e3, scale="log"),
}
SCORES = {
    "PSNR": Leaf(lambda a: metrics.psnr(a, jnp.full_like(a, 0.25)), lambda s: (s * PICTURES,), between(0, 1e9),
                 "pictures in 0..1; inf where they are equal", LEVELS),
    "SSIM": Leaf(lambda a: metrics.ssim(a, jnp.full_like(a, 0.25)), lambda s: (s * PICTURES,), between(0, 1e6),
                 "pictures in 0..1", LEVELS),
    "SSIM with itself": Leaf(lambda a: metrics.ssim(a, a), lambda s: (s * PICTURES,), between(0, 1e6),
                             "pictures in 0..1", LEVELS),
    **{
        f"bounds, {name}": Leaf(bounds.from_free, lambda s: (s * np.array([1.0, -1.0, 0.3]),), whole, "overflow")
        for name, bounds in ENDS.items()
    },
}  # fmt: skip

GROUPS = {"linear algebra": LINALG, "colour and projection": COLOUR, "clamp": CLAMP, "matter": MATTER, "scores": SCORES}
LEAVES = {name: leaf for group in GROUPS.values() for name, leaf in group.items()}
