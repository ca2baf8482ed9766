"""Every cell of docs/DIFFERENTIABILITY.md by its derivative in forward mode, central differences and a large change."""

import dataclasses
import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pigjax as pj
from pigjax.splatting.types import as_splats

PAGE = Path(__file__).parents[1] / "docs" / "DIFFERENTIABILITY.md"
H = 1e-5  # of a large change
TOLERANCE = 1e-5
NOISE = 1e-9  # of central differences of numbers near 1, where additions come in any order

# Each number, and what a unit of it stands for: a change that every output must feel that depends on it.
DRAWN = {
    "means, at rest": 0.05, "means, moving": 0.05, "scales": 1.0, "quaternions": 1.0, "opacity": 3.0, "sh": 0.3,
    "camera pose": 0.1, "focal length": 4.0,
}  # fmt: skip
VOTES = {"tau_T": 0.2, "tau_d": 0.1, "temperature": 0.02}
SMOOTH = {
    "Young's modulus": 5e3, "Poisson's ratio": 0.1, "density": 300.0, "viscosity": 5.0,
    "positions": 0.005, "velocities": 0.3, "gravity": 3.0, "friction between bodies": 0.2,
    **{f"{kind} collider: {what}": scale for kind in ("hard", "soft") for what, scale in (
        ("place", 0.1), ("turn", 0.3), ("velocity", 0.3), ("friction", 0.2))},
}  # fmt: skip
PLASTIC = {"yield stress": 100.0, "friction angle": 0.3}
CLAMP = {"tau_min": 0.01, "tau_max": 0.01, "lambda_R": 0.3, "lambda_S": 0.3}
SCALES = DRAWN | VOTES | SMOOTH | PLASTIC | CLAMP
SHAPES = {
    "means, at rest": (14, 3), "means, moving": (6, 3), "scales": (20, 3), "quaternions": (20, 4), "opacity": (20,),
    "sh": (20, 4, 3), "camera pose": (6,), "focal length": (2,), "positions": (54, 3), "velocities": (2, 3),
    "gravity": (3,),
    **{f"{kind} collider: {what}": (3,) for kind in ("hard", "soft") for what in ("place", "turn", "velocity")},
}  # fmt: skip
START = {name: np.zeros(SHAPES.get(name, ())) for name in SCALES}
LAWS = {
    "smooth": lambda: [
        pj.Material(model="neo_hookean", density=1000.0, young=2e4, poisson=0.3),
        pj.Material(model="fluid", density=1000.0, bulk_modulus=2e4, viscosity=10.0),
    ],
    "plastic": lambda: [
        pj.Material(model="von_mises", density=1000.0, young=2e4, poisson=0.3, yield_stress=300.0),
        pj.Material(model="drucker_prager", density=1000.0, young=2e4, poisson=0.3, friction_angle=0.5, cohesion=10.0),
    ],
}


def block(corner):
    return np.stack(np.meshgrid(*[np.arange(3) * 0.05] * 3, indexing="ij"), -1).reshape(-1, 3) + corner


@functools.cache
def matter(laws):
    """Two blocks, one on the other and both sliding: hard ground under them, a soft wall beside them."""
    x = np.concatenate([block((0.5, 0.5, 0.5)), block((0.53, 0.51, 0.66))])
    x += np.random.default_rng(0).uniform(-0.004, 0.004, x.shape)
    row = np.repeat([0, 1], 27)
    gaussian = np.where(np.arange(54) % 9 == 4, np.arange(54) // 9, -1)  # 0 to 5
    velocity = np.where(row[:, None] == 0, (0.6, 0.4, -0.6), (0.8, -0.5, -1.4))
    with jax.ensure_compile_time_eval():
        table = pj.material_table(LAWS[laws]())
        particles = pj.make_particles(
            x, volume=0.05**3, table=table, material=row, gaussian=gaussian, body=row, velocity=velocity
        )
        return particles, table, pj.fit_grid(x, 0.1, margin=0.1)


def changed(p, name, value):
    return value + SCALES[name] * p[name]


def simulate(laws, p):
    particles, table, grid = matter(laws)
    fields = {
        "young": "Young's modulus", "poisson": "Poisson's ratio", "density": "density",
        "viscosity": "viscosity", "yield_stress": "yield stress", "friction_angle": "friction angle",
    }  # fmt: skip
    table = dataclasses.replace(
        table, **{field: changed(p, name, getattr(table, field)) for field, name in fields.items()}
    )
    particles = eqx.tree_at(
        lambda q: (q.x, q.v, q.mass),
        particles,
        (
            changed(p, "positions", particles.x),
            particles.v + SCALES["velocities"] * p["velocities"][particles.body],
            particles.volume0 * table.density[particles.material],
        ),
    )

    def plane(kind, point, normal, **options):
        numbers = {"place": point, "turn": normal, "velocity": (0.1, 0.05, 0.2), "friction": 0.2}
        place, turn, velocity, friction = (
            changed(p, f"{kind} collider: {what}", jnp.asarray(value)) for what, value in numbers.items()
        )
        return pj.Plane(place, turn, velocity=velocity, friction=friction, **options)

    _, trajectory, _ = pj.rollout(
        particles, grid, table, pj.SimConfig(substeps=4, differentiation="forward", devices=1),
        frames=1, frame_dt=0.03, gravity=changed(p, "gravity", jnp.array([0.5, -1.0, -9.8])),
        colliders=(
            plane("hard", (0.5, 0.5, 0.52), (0.11, 0.04, 1.0)),
            plane("soft", (0.66, 0.5, 0.5), (-1.0, 0.1, 0.2), softness=0.1),
        ),
        contact=pj.BodyContact(2, changed(p, "friction between bodies", jnp.asarray(0.3))),
    )  # fmt: skip
    return {"x": trajectory.x, "v": trajectory.v, "F": trajectory.F_visual}


def scene(p):
    """Six Gaussians that particles carry and fourteen that stand still, and a camera."""
    particles, *_ = matter("smooth")
    rng = np.random.default_rng(2)
    carried = particles.x[np.asarray(particles.gaussian) >= 0]
    still = jnp.asarray(rng.uniform(0.4, 0.9, (14, 3)))
    gaussians = pj.Gaussians(
        means=jnp.concatenate([changed(p, "means, moving", carried), changed(p, "means, at rest", still)]),
        log_scales=changed(p, "scales", rng.uniform(-4.0, -2.0, (20, 3))),
        quats=changed(p, "quaternions", rng.normal(size=(20, 4))),
        logit_opacities=changed(p, "opacity", rng.uniform(0.0, 2.0, 20)),
        sh=changed(p, "sh", rng.uniform(-0.4, 0.6, (20, 4, 3))),
    )
    camera = pj.look_at((1.6, -0.5, 1.3), (0.6, 0.6, 0.6), focal=40.0, width=32, height=32)
    camera = camera.nudged(SCALES["camera pose"] * p["camera pose"])
    return gaussians, eqx.tree_at(lambda c: c.focal, camera, changed(p, "focal length", camera.focal))


def draw(p, moved):
    gaussians, camera = scene(p)
    particles, *_ = matter("smooth")
    now = eqx.tree_at(lambda q: (q.x, q.F_visual), particles, (moved["x"][0], moved["F"][0]))
    bounds = {"tau_min": 0.995, "tau_max": 1.005, "lambda_R": 1.2, "lambda_S": 0.8}
    clamp = pj.ClampParams(**{name: changed(p, name, jnp.asarray(value)) for name, value in bounds.items()})
    posed, rest = pj.deform(gaussians, now, clamp), as_splats(gaussians)
    rest = eqx.tree_at(lambda s: s.sh_rotations, rest, jnp.eye(3) + 0 * posed.factors, is_leaf=lambda v: v is None)
    config = pj.RenderConfig(differentiation="forward")
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), rest, posed)
    frames = jax.lax.map(
        lambda s: pj.render(
            s, camera, config, outputs=("rgb", "alpha", "depth", "surface_depth"), tau_T=changed(p, "tau_T", 0.5)
        ),
        both,
    )
    surface = frames.surface_depth[0]
    return {
        "rgb": frames.rgb[0], "alpha": frames.alpha[0], "depth": frames.depth[0],
        "surface depth": jnp.where(jnp.isnan(surface), 0.0, surface),
        "posed": jnp.concatenate([posed.means[..., None], posed.factors], -1), "video": frames.rgb[1],
    }  # fmt: skip


def vote(p):
    gaussians, camera = scene(p)
    views = pj.stack_cameras([camera, camera.nudged(jnp.array([0.0, 0, 0, 0.1, 0, 0])),
                              camera.nudged(jnp.array([0.0, 0, 0, 0, 0.1, 0]))])  # fmt: skip
    masks = np.random.default_rng(3).integers(0, 3, (3, 8, 8)).repeat(4, 1).repeat(4, 2)
    thresholds = {"tau_T": changed(p, "tau_T", 0.5), "tau_d": changed(p, "tau_d", 0.1)}
    temperature = changed(p, "temperature", 0.05)
    config = pj.RenderConfig(differentiation="forward")
    options = {"num_ids": 3, "ties": "lowest", "background": "vote", "config": config, **thresholds}
    hard = pj.lift_masks(gaussians, views, masks, **options)
    soft = pj.lift_masks(gaussians, views, masks, temperature=temperature, **options)
    return {"ids": hard.object_id, "confidence": hard.confidence, "soft votes": soft.votes}


def with_slopes(function):
    # unoptimised code compiles in half the time, and here it runs for milliseconds
    quick = {"xla_backend_optimization_level": 0}
    return jax.jit(lambda at, slope: jax.jvp(function, at, slope), compiler_options=quick)


PROGRAMS = {"draw": with_slopes(draw), "vote": with_slopes(vote)} | {
    laws: with_slopes(functools.partial(simulate, laws)) for laws in LAWS
}


def outputs(laws, name, distance):
    """All outputs where one number is changed by so many units, and their derivatives by it."""
    way = np.random.default_rng(len(name)).normal(size=START[name].shape)
    way = way / np.abs(way).max()
    p, slope = START | {name: distance * way}, {other: 0 * zero for other, zero in START.items()} | {name: way}
    moved, moving = PROGRAMS[laws]((p,), (slope,)) if name in SMOOTH | PLASTIC else at_rest(laws)
    drawn, drawing = PROGRAMS["draw"]((p, moved), (slope, moving))
    voted, voting = PROGRAMS["vote"]((p,), (slope,)) if name in DRAWN | VOTES else at_rest("vote")
    return moved | drawn | voted, moving | drawing | voting


@functools.cache
def at_rest(program):
    """What a program gives that does not take the number: the same whatever it is."""
    return PROGRAMS[program]((START,), (START,))


@functools.cache
def verdicts(name):
    """What the derivatives of all outputs by one number are: exact, zero, undefined, or none at all (a dash)."""
    laws = "plastic" if name in PLASTIC else "smooth"
    here, slopes = outputs(laws, name, 0.0)
    others = [outputs(laws, name, distance)[0] for distance in (H, -H, 1.0, -1.0)]
    return {
        output: verdict(np.asarray(slopes[output]), *(np.asarray(v[output]) for v in (here, *others)))
        for output in here
    }


def verdict(slope, here, plus, minus, *far):
    depends = not all(np.array_equal(here, there) for there in far)
    if slope.dtype == jax.dtypes.float0:
        return "undefined" if depends else "–"
    central = (plus - minus) / (2 * H)
    if not slope.any() and np.abs(central).max(initial=0.0) < NOISE:
        return "zero" if depends else "–"
    error = np.linalg.norm(slope - central) / max(np.linalg.norm(central), 1e-30)
    return "exact" if error < TOLERANCE else f"off by {error:.1e}"


def softened(name, output, word):
    """ "soft" where a derivative is there for a temperature or a softness, and zero without."""
    hard_output = "confidence" if output == "soft votes" else output
    hard = verdicts(name.replace("soft", "hard"))[hard_output]
    return "soft" if word == "exact" and hard in ("zero", "–") else word


def page():
    """Words of the page by number and output."""
    lines = [line.strip("|").split("|") for line in PAGE.read_text("utf-8").splitlines() if line.startswith("|")]
    (_, *columns), _, *rows = [[cell.strip() for cell in line] for line in lines]
    return {name: dict(zip(columns, cells, strict=True)) for name, *cells in rows}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in PLASTIC else n for n in SCALES])
def test_the_page_tells_each_derivative_by_a_number_as_it_is(x64, name):
    assert {output: softened(name, output, word) for output, word in verdicts(name).items()} == page()[name]


def test_the_page_has_all_numbers():
    assert list(page()) == list(SCALES)


@pytest.mark.parametrize("settings", [pj.RenderConfig(), pj.SimConfig(), pj.FitConfig()])
def test_settings_are_static_and_have_no_derivative(settings):
    assert jax.tree.leaves(settings) == []
