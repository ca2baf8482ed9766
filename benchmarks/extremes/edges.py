"""Drawing, votes, clamp, filling, reconstruction and sweeps at their edges: each case is finite or refused."""

import dataclasses
import warnings
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.extremes.judging import BEYOND, COUNTED, FAULT, FINITE, Outcome, not_finite, outcome
from benchmarks.extremes.leaves import QUATS, STRETCHES, WORLD
from pigjax.clamp import ClampParams, clamped_shapes
from pigjax.core.camera import Camera, look_at, stack_cameras
from pigjax.coupling.filling import fill_interior
from pigjax.coupling.seeding import seed_particles
from pigjax.io import Views
from pigjax.mpm.materials import Material
from pigjax.reconstruction.reconstruct import FitConfig, reconstruct
from pigjax.segmentation import lift_masks
from pigjax.splat import Gaussians, render
from pigjax.study.optimize import Bounds, fit, search, sweep

Case = Callable[[], Any]
SIZES = WORLD[1:]
FAR = (1.0, 1e3, 1e4, 1e5, 1e6, 1e7)

# Drawing.

COUNT, WIDTH, HEIGHT = 12, 20, 16
MOST_LOG_SCALE = float(np.log(1e15))  # no number of a scene is larger; squares of larger ones overflow float32
EYE = np.array([1.2, -2.0, 1.0])


def camera_at(size: float = 1.0, offset: float = 0.0, focal: float = 24.0) -> Camera:
    """A camera that looks at the middle of the scene."""
    target = np.full(3, offset)
    return look_at(size * EYE + target, target, focal=focal, width=WIDTH, height=HEIGHT)


def scene(size: float = 1.0, offset: float = 0.0, **changes: Any) -> dict[str, np.ndarray]:
    """Arrays of a dozen Gaussians; changes are of the first three of them."""
    rng = np.random.default_rng(0)
    parts = {
        "means": size * rng.normal(0, 0.4, (COUNT, 3)) + offset,
        "log_scales": rng.normal(np.log(0.1), 0.5, (COUNT, 3)) + np.log(size),
        "quats": rng.normal(size=(COUNT, 4)),
        "logit_opacities": rng.normal(size=COUNT),
        "sh": rng.normal(0, 0.2, (COUNT, 4, 3)),
    }
    for name, value in changes.items():
        parts[name][:3] = value
    return parts


@jax.jit
def _drawn(gaussians: Gaussians, camera: Camera) -> Any:
    def loss(gaussians):
        frame = render(gaussians, camera, outputs=("rgb", "alpha", "depth", "normals"))
        return sum(jnp.sum(v**2) for v in (frame.rgb, frame.alpha, frame.normals)), frame

    (_, frame), slopes = jax.value_and_grad(loss, has_aux=True)(gaussians)
    return (frame.rgb, frame.alpha, frame.depth, frame.normals), slopes


def draw(camera: Camera, parts: dict[str, np.ndarray]) -> Any:
    """A picture, and the gradient of a loss of it; where an input is not finite, the picture alone."""
    gaussians = Gaussians(**{name: jnp.asarray(part, jnp.float32) for name, part in parts.items()})
    picture, slopes = _drawn(gaussians, jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), camera))
    if float(np.max(gaussians.log_scales)) > MOST_LOG_SCALE and not not_finite(gaussians):
        return picture if not_finite(picture) or not not_finite(slopes) else Outcome(BEYOND, "no gradient")
    return picture if not_finite(gaussians) else (picture, slopes)


def drawing() -> dict[str, Case]:
    """Scenes of all sizes and places, and splats of all shapes."""
    cases: dict[str, Case] = {}

    def case(name, camera=None, **changes):
        cases[name] = lambda: draw(camera_at() if camera is None else camera, scene(**changes))

    for size in SIZES:
        case(f"scene x {size:g}", camera_at(size), size=size)
    for offset in FAR:
        case(f"{offset:g} m from the origin", camera_at(offset=offset), offset=offset)
    for value in (-np.inf, -1e30, -100.0, -60.0, -20.0, 5.0, 20.0, 44.0, 60.0, 88.0, 100.0, 1e30, np.inf, np.nan):
        case(f"log scale {value:g}", log_scales=value)
        case(f"needle of log scale {value:g}", log_scales=[value, -3.0, -3.0])
        case(f"logit of the opacity {value:g}", logit_opacities=value)
    for value in (0.0, 1e-38, 1e-20, 1e20, 1e38):
        case(f"quaternion x {value:g}", quats=value * QUATS[:3])
        case(f"harmonics x {value:g}", sh=min(value, 1e15) * np.ones((3, 4, 3)))
    back = np.asarray(camera_at().world_to_cam)[2, :3]
    for distance in (-1e9, -1.0, -1e-6, 0.0, 1e-12, 1e-6, 0.02, 1e6, 1e15, 1e30):
        case(f"splats {distance:g} m ahead of the camera", means=EYE + distance * back)
    for value in (np.nan, np.inf, -np.inf, 1e15, 1e30, 1e38):
        case(f"means {value:g}", means=value)
    for focal in (1e-3, 1.0, 1e3, 1e6):
        case(f"focal length {focal:g} px", camera_at(focal=focal))
    cases["all in one place"] = lambda: draw(camera_at(), scene() | {"means": np.zeros((COUNT, 3))})
    cases["all opaque"] = lambda: draw(camera_at(), scene() | {"logit_opacities": np.full(COUNT, 1e3)})
    cases["all transparent"] = lambda: draw(camera_at(), scene() | {"logit_opacities": np.full(COUNT, -1e3)})
    return cases


def large() -> dict[str, Case]:
    """Few and many Gaussians, small and large pictures."""

    def picture(count, width, height):
        rng = np.random.default_rng(0)
        gaussians = Gaussians(
            rng.normal(0, 0.4, (count, 3)).astype(np.float32), np.full((count, 3), -7.0, np.float32),
            np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.zeros(count, np.float32),
            np.zeros((count, 1, 3), np.float32),
        )  # fmt: skip
        camera = look_at(EYE, np.zeros(3), focal=1.2 * width, width=width, height=height)
        frame = render(gaussians, camera, outputs=("rgb", "depth"))
        return frame.rgb, frame.depth

    return {
        "1 Gaussian, 1 x 1 px": partial(picture, 1, 1, 1),
        "1 Gaussian, 1 x 4096 px": partial(picture, 1, 4096, 1),
        "20,000 Gaussians, 4096 x 4096 px": partial(picture, 20_000, 4096, 4096),
        "3 million Gaussians, 512 x 512 px": partial(picture, 3_000_000, 512, 512),
    }


# Clamp.

LAMBDAS = np.arange(-1, 3.01, 0.5)
TAUS = ((0.5, 2.0), (1.0, 1.0), (0.0, 1e9), (0.5, 0.5), (3.0, 3.0), (1e-6, 1e6), (0.0, 1e-30), (1e9, 1e9))


@cache
def _clamped(mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Whether the shapes and their gradients are finite, by weights and bounds [λ_R, λ_S, τ]."""
    grid = np.stack([np.stack([r, s, *t]) for r in LAMBDAS for s in LAMBDAS for t in np.array(TAUS)])
    F = jnp.asarray(np.stack([f(s) for f in STRETCHES for s in (0.0, 1e-6, 0.01, 1.0, 3.0, 1e6)]), jnp.float32)
    quats = jnp.broadcast_to(jnp.asarray(QUATS[0], jnp.float32), (len(F), 4))
    log_scales = jnp.broadcast_to(jnp.asarray([-5.0, -3.0, -12.0], jnp.float32), (len(F), 3))

    def one(numbers):
        def shapes(F, quats, log_scales, numbers):
            low, high = numbers[2], numbers[3]
            params = ClampParams(tau_min=low, tau_max=high, lambda_R=numbers[0], lambda_S=numbers[1])
            return clamped_shapes(quats, log_scales, F, params, mode=mode, coloured=False)[0]

        value, pull = jax.vjp(shapes, F, quats, log_scales, numbers)
        fine = [jnp.isfinite(leaf).all() for leaf in (value, *pull(jnp.ones_like(value)))]
        return fine[0], jnp.stack(fine).all()

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jnp.asarray(grid, jnp.float32)))


def clamp() -> dict[str, Case]:
    """λ from −1 to 3 by halves, bounds that meet, and stretches from 0 to 1e6."""

    def judged(mode, index):
        value, slope = _clamped(mode)
        if value[index] and slope[index]:
            return Outcome(FINITE)
        return Outcome(FAULT, f"{'gradients' if value[index] else 'shapes'} are not finite")

    names = [
        f"lambda_R {r:g}, lambda_S {s:g}, tau {low:g} to {high:g}"
        for r in LAMBDAS for s in LAMBDAS for low, high in TAUS
    ]  # fmt: skip
    return {
        f"{mode}: {name}": partial(judged, mode, index)
        for mode in ("aligned", "literal")
        for index, name in enumerate(names)
    }


# Votes.


def _wall(size: float, offset: float) -> tuple[Gaussians, Camera]:
    """A wall of 64 splats at one unit from two cameras."""
    x, y = (a.ravel() / 4 - 0.875 for a in np.meshgrid(np.arange(8), np.arange(8)))
    means = size * np.stack([0.4 * x, 0.4 * y, np.ones(64)], 1)
    parts = means + offset, np.full((64, 3), np.log(0.03 * size)), np.tile([1.0, 0, 0, 0], (64, 1))
    gaussians = Gaussians(*(np.float32(v) for v in (*parts, np.full(64, 5.0), np.zeros((64, 1, 3)))))
    eyes = [look_at(
        np.array([x * size, 0, 0]) + offset, np.array([0, 0, size]) + offset, focal=16.0, width=16, height=16,
        up=(0, -1.0, 0),
    ) for x in (-0.2, 0.2)]  # fmt: skip
    return gaussians, stack_cameras(eyes)


def votes() -> dict[str, Case]:
    """A scene of any size has the votes of one of a metre; thresholds at their ends; splats that are no numbers."""
    masks = np.repeat(np.where(np.arange(16) < 8, 1, 2)[None, None], 2, 0).repeat(16, 1).astype(np.int32)

    def lifted(size=1.0, offset=0.0, masks=masks, change=lambda g: g, num_ids=3, **options):
        gaussians, cameras = _wall(size, offset)
        return lift_masks(change(gaussians), cameras, masks, num_ids=num_ids, ties="lowest", **options)

    def same(size):
        found, usual = lifted(size), lifted()
        equal = np.array_equal(found.object_id, usual.object_id)
        return Outcome(FINITE) if equal else Outcome(FAULT, "other votes than at 1 m")

    def at(**options):
        return lambda: (lambda labels: (labels.votes, labels.confidence))(lifted(**options))

    def broken(name, value):
        def change(g):
            return dataclasses.replace(g, **{name: jnp.asarray(getattr(g, name)).at[:5].set(value)})

        return at(change=change)

    cases: dict[str, Case] = {f"scene x {size:g}": partial(same, size) for size in SIZES}
    cases |= {f"{offset:g} m from the origin": at(offset=offset) for offset in FAR}
    cases |= {f"tau_T {t:g}, tau_d {d:g}": at(tau_T=t, tau_d=d) for t in (0, 0.5, 1) for d in (0, 1)}
    cases |= {
        f"{name} {value:g}": broken(name, value)
        for name in ("means", "log_scales", "logit_opacities", "quats")
        for value in (np.nan, np.inf, -np.inf, 1e30)
    }
    wrong = {"tau_T": (-0.1, 1.1, np.nan), "tau_d": (-0.1, 1.1, np.nan), "num_ids": (0, 1, 2, 2**40)}
    cases |= {f"{name} {value:g}": at(**{name: value}) for name, values in wrong.items() for value in values}
    cases["no view"] = at(masks=masks[:0])
    cases["masks of another size"] = at(masks=masks[:, :8])
    return cases


# Filling and seeding.


def _shell(size: float = 1.0, offset: float = 0.0, count: int = 300, flat: Any = 1.0) -> Gaussians:
    """Gaussians on a sphere, squeezed to a disc, a line or a point by `flat`."""
    x = np.random.default_rng(0).normal(size=(count, 3))
    x = size * x / np.linalg.norm(x, axis=1, keepdims=True) * flat + offset
    parts = x, np.full((count, 3), np.log(0.05 * size)), np.tile([1.0, 0, 0, 0], (count, 1))
    return Gaussians(*(np.float32(v) for v in (*parts, np.full(count, 5.0), np.zeros((count, 1, 3)))))


def filling() -> dict[str, Case]:
    """Shells of all sizes, flat ones, and spacings at which nothing or too much would fit."""

    def filled(gaussians, spacing=0.3, **options):
        found = fill_interior(gaussians, spacing=spacing, max_cells=16, **options)
        if not (found.volumes > 0).all():
            return Outcome(FAULT, "a volume that is not > 0")
        return found

    def seeded(gaussians, spacing=0.3, **options):
        matter = {1: Material("neo_hookean", density=1e3, young=1e4, poisson=0.3)}
        ids = np.ones(len(gaussians), int)
        particles, _ = seed_particles(gaussians, ids, matter, spacing=spacing, max_cells=16, **options)
        return particles.x, particles.volume0, particles.mass, 1 / particles.volume0

    cases: dict[str, Case] = {}
    for name, act in (("fill", filled), ("seed", seeded)):
        cases |= {f"{name}, x {s:g}": partial(act, _shell(s), 0.3 * s) for s in SIZES}
        cases |= {f"{name}, {o:g} m from the origin": partial(act, _shell(offset=o)) for o in FAR}
        shapes = {"disc": [1, 1, 0], "line": [1, 0, 0], "point": [0, 0, 0], "plate": [1, 1, 1e-9]}
        cases |= {f"{name}, a {shape}": partial(act, _shell(flat=np.array(flat))) for shape, flat in shapes.items()}
        cases |= {f"{name}, {n} Gaussians": partial(act, _shell(count=n)) for n in (1, 2, 3, 5)}
        cases |= {
            f"{name}, spacing {s:g}": partial(act, _shell(), s) for s in (-1.0, 0.0, 1e-30, 1e-4, 10, 1e30, np.nan)
        }
        cases |= {
            f"{name}, {n:g} particles in a cell": partial(act, _shell(), particles_per_cell=n)
            for n in (0, 1e-9, 1, 1e9, np.inf)
        }
        for value in (np.nan, np.inf, 1e30):
            shell = _shell()
            lost = dataclasses.replace(shell, means=jnp.asarray(shell.means).at[:5].set(value))
            cases[f"{name}, means {value:g}"] = partial(act, lost)
    return cases


# Reconstruction.


def reconstruction() -> dict[str, Case]:
    """Two photos of 12 x 10 px and eight splats: scenes of all sizes, photos of one colour, points in one place."""

    def fitted(size=1.0, offset=0.0, photo=None, points=None, **options):
        eyes = [look_at(
            size * np.array([np.sin(a), np.cos(a), 0.4]) + offset, np.full(3, offset), focal=10.0, width=12, height=10
        ) for a in (0.0, 0.4)]  # fmt: skip
        rng = np.random.default_rng(0)
        photos = rng.random((2, 10, 12, 3)) if photo is None else np.full((2, 10, 12, 3), photo)
        views = Views(stack_cameras(eyes), ("a", "b"), photos.astype(np.float32), None, ("train", "train"))
        points = size * rng.normal(0, 0.2, (20, 3)) if points is None else points
        config = FitConfig(**{"steps": 3, "splats": 8, "sh_degree": 0, "relocate_every": 2} | options)
        made = reconstruct(views, config, points=(points + offset, np.full((len(points), 3), 0.5)))
        return made.gaussians, made.history[-1].loss

    cases: dict[str, Case] = {f"scene x {size:g}": partial(fitted, size) for size in SIZES}
    cases |= {f"{o:g} m from the origin": partial(fitted, offset=o) for o in FAR}
    cases |= {f"photos of the value {v:g}": partial(fitted, photo=v) for v in (0.0, 0.5, 1.0, 1e3)}
    cases |= {f"photos of the value {v:g}": partial(fitted, photo=v) for v in (np.nan, np.inf)}
    places = {"one place": np.zeros((20, 3)), "a line": np.linspace(0, 1, 20)[:, None] * [[1.0, 0, 0]]}
    places |= {"NaN": np.full((20, 3), np.nan), "no points": np.zeros((0, 3)), "one point": np.zeros((1, 3))}
    cases |= {f"points: {name}": partial(fitted, points=points) for name, points in places.items()}
    return cases


# Sweeps and searches.


def sweeps() -> dict[str, Case]:
    """Functions that are not finite here and there, and rows of one and of none."""

    def swept(fn, grid, **options):
        table = sweep(fn, grid, **options)
        lost = not_finite(list(table["score"][np.asarray(table.ok)]))
        if lost:
            return Outcome(FAULT, f"{lost} rows are not finite and not marked")
        return Outcome(FINITE if table.ok.all() else COUNTED, f"{int((~table.ok).sum())} rows marked")

    functions = {
        "root": lambda row: {"score": jnp.sqrt(row["a"])},
        "inverse": lambda row: {"score": 1 / row["a"]},
        "logarithm": lambda row: {"score": jnp.log(row["a"])},
        "exponential": lambda row: {"score": jnp.exp(row["a"])},
        "NaN": lambda row: {"score": row["a"] * jnp.nan},
    }
    values = {"ordinary": [1.0, 2.0], "signs": [-1.0, 0.0, 1.0], "huge": [1e38, -1e38, 1e3], "one": [0.0], "none": []}
    return {
        f"sweep of the {name} over {what}": partial(swept, fn, {"a": grid})
        for name, fn in functions.items()
        for what, grid in values.items()
    }


def searches() -> dict[str, Case]:
    """Losses that are not finite or that say nothing, and starts on a bound."""

    def found(method, fn, start, bounds, *rate, **options):
        best, history = method(fn, {"a": jnp.asarray(start)}, *rate, bounds={"a": bounds}, **options)
        return best, history.least

    losses = {
        "bowl": lambda p: (p["a"] - 1) ** 2,
        "constant": lambda p: 0 * p["a"],
        "NaN": lambda p: p["a"] * jnp.nan,
        "NaN below 1": lambda p: jnp.where(p["a"] < 1, jnp.nan, (p["a"] - 1) ** 2),
        "steep": lambda p: 1e30 * (p["a"] - 1) ** 2,
        "root at its end": lambda p: jnp.sqrt(jnp.abs(p["a"] - 1)),
    }
    cases: dict[str, Case] = {}
    for name, loss in losses.items():
        for start in (0.0, 1.0, 1.5, 3.0):
            bounds = Bounds(0.0, 3.0)
            cases[f"fit of the {name} from {start:g}"] = partial(found, fit, loss, start, bounds, 0.1, steps=5)
            cases[f"search of the {name} from {start:g}"] = partial(found, search, loss, start, bounds, evaluations=8)
    return cases


SUBJECTS: dict[str, tuple[Callable[[], dict[str, Case]], str]] = {
    "drawing": (drawing, "splats that are no numbers are not drawn; gradients up to scales of 1e15 m"),
    "large pictures": (large, "memory: about 0.4 kB for each Gaussian, 60 B for each pixel"),
    "clamp": (clamp, "weights from -1e3 to 1e3, bounds from 0 to 1e9 with tau_min <= tau_max"),
    "votes": (votes, "thresholds in [0, 1]; ids up to the memory of [n ids] counts"),
    "filling and seeding": (filling, "one particle at the least, 4 million at most by default"),
    "reconstruction": (reconstruction, "photos are finite"),
    "sweeps": (sweeps, "one row or more; rows that are not finite are marked"),
    "searches": (searches, "starts lie within their bounds, and not on them"),
}


def outcomes_of(subject: str, names: Any = None) -> dict[str, Outcome]:
    """The outcome of each case of a subject, or of those named."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cases = SUBJECTS[subject][0]()
        return {name: outcome(case) for name, case in cases.items() if names is None or name in names}
