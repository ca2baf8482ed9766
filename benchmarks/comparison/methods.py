"""The methods: each moves the same Gaussians for the same frames, as far as it can be with the same engine."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.baselines import mass_spring
from benchmarks.baselines.feature_distillation import select_by_similarity, similarities, train_features
from benchmarks.baselines.region_boxes import ids_in_boxes
from benchmarks.baselines.rigid_topk import driving_points, follow, nearest_drivers
from benchmarks.baselines.surface_only import ids_by_members
from benchmarks.common.timing import frames_of
from benchmarks.comparison.setting import DENSITY, FRICTION, GRAVITY, TABLE, VELOCITIES, YOUNG, Setting, subset
from pigjax.clamp import ClampParams
from pigjax.coupling.binding import bind, deform
from pigjax.coupling.sdf_collider import collider_from_gaussians
from pigjax.coupling.seeding import seed_particles
from pigjax.mls_mpm import SimConfig, rollout
from pigjax.mpm import fit_grid, make_particles, vast_grid
from pigjax.mpm.materials import material_table
from pigjax.mpm.timestep import choose_substeps
from pigjax.objects.lifting import lift
from pigjax.splat import Splats
from pigjax.splatting.types import as_splats

CHOICE_EVERY = 4  # training views that choose thresholds
TRAINING_STEPS = 100  # of features: most Gaussians are right then, see docs/results/SEGMENTATION.md
DRIVERS = 2000  # particles that drive, of all objects together
ANCHORS = 2048  # as in Spring-Gaus


class Motion(NamedTuple):
    """Motion of the scene by one method."""

    frames: list[Splats]  # rest first
    particles: int
    substeps: int  # per frame
    seconds: float  # of all frames, from the median frame: without compilation
    compile_seconds: float  # of the frames, beyond that


def ours(setting: Setting, ids: np.ndarray) -> Motion:
    """Lifted ids, filled, the table as a collider of its own splats, shapes by the aligned clamp."""
    table = subset(setting.gaussians, np.flatnonzero(ids == TABLE))
    others = np.asarray(setting.gaussians.means)[ids != TABLE]
    collider = collider_from_gaussians(table, spacing=setting.dx / 2, others=others, friction=FRICTION, name="table")
    buried = np.asarray(collider.distance(jnp.asarray(setting.gaussians.means))) < -0.25 * setting.dx
    return _by_particles(setting, np.where(buried, TABLE, ids), collider, mode="aligned")


def as_physgaussian(setting: Setting, ids: np.ndarray, margin: float) -> Motion:
    inside = ids_in_boxes(np.asarray(setting.gaussians.means), ids, setting.moving, margin)
    return _by_particles(setting, inside, setting.plane, mode="covariance")


def as_feature_splatting(setting: Setting, ids: np.ndarray, *, fill: bool) -> Motion:
    return _by_particles(setting, ids, setting.plane, mode="fixed", fill=fill)


def as_physdreamer(setting: Setting, ids: np.ndarray) -> Motion:
    filled, _ = _seeded(setting, ids, setting.plane)
    x, volume, number = _reduced(filled, DRIVERS)
    names = list(setting.materials)
    table = material_table(list(setting.materials.values()))
    velocity = np.array([VELOCITIES.get(names[row], (0.0, 0.0, 0.0)) for row in number])
    particles = make_particles(
        jnp.asarray(x, jnp.float32), volume=volume, table=table, material=number, velocity=velocity, body=number
    )
    states, *cost = _simulate(setting, particles, table, setting.plane)
    near, rest = _near_of_own(setting, ids, x, number), as_splats(setting.gaussians)
    own = np.flatnonzero(near[:, 0] >= 0)

    def posed(state):
        means, turned = follow(rest.means[own], particles.x, state.x, near[own])
        factors = jnp.einsum("nij,njk->nik", turned, rest.factors[own])
        return _with(rest, rest.means.at[own].set(means), rest.factors.at[own].set(factors))

    return Motion([posed(state) for state in states], len(particles), *cost)


def as_spring_gaus(setting: Setting, ids: np.ndarray) -> Motion:
    filled, _ = _seeded(setting, ids, setting.plane)
    x, volume, number = _reduced(filled, ANCHORS)
    volume = (np.bincount(number, volume) / np.bincount(number))[number]  # anchors weigh the same, as in the paper
    names = list(setting.materials)
    parts = [
        mass_spring.make_network(x[number == row], volume[number == row], young=YOUNG, density=DENSITY)
        for row in range(len(names))
    ]
    network = jax.tree.map(lambda leaf: leaf.astype(jnp.float32 if leaf.dtype.kind == "f" else jnp.int32),
                           mass_spring.joined(parts))  # fmt: skip
    steps = int(np.ceil(setting.frame_dt / mass_spring.stable_step(network)))
    advance = jax.jit(partial(mass_spring.advance, network, dt=setting.frame_dt / steps, steps=steps,
                              gravity=jnp.asarray(GRAVITY, jnp.float32), collider=setting.plane))  # fmt: skip
    start = jnp.asarray(x, jnp.float32)
    velocity = jnp.asarray([VELOCITIES.get(names[row], (0.0, 0.0, 0.0)) for row in number], jnp.float32)
    run = frames_of(lambda state: advance(*state), (start, velocity), setting.frames)

    rest = as_splats(setting.gaussians)
    near, weights = np.full((len(ids), 8), -1), np.zeros((len(ids), 8))
    for row, name in enumerate(names):
        mine, anchors = np.flatnonzero(ids == name), np.flatnonzero(number == row)
        index, weights[mine] = mass_spring.interpolation(np.asarray(rest.means)[mine], x[anchors])
        near[mine] = anchors[index]

    def posed(state):
        moved = jnp.einsum("nk,nkj->nj", jnp.asarray(weights, jnp.float32), (state[0] - start)[near])
        return _with(rest, rest.means + moved, rest.factors)

    seconds = run.seconds * setting.frames
    return Motion([posed(state) for state in run.result], len(x), steps, seconds, run.compile_seconds)


def lifted_ids(setting: Setting) -> np.ndarray:
    """Ids [n] of the training masks, as scenes get them."""
    train = setting.scene.train
    labels = lift(setting.gaussians, train.cameras, train.masks)
    return np.asarray(labels.object_id)


def feature_ids(setting: Setting, steps: int = TRAINING_STEPS) -> np.ndarray:
    """Ids [n] by distilled features, thresholds chosen on training views; 0 where no query fits."""
    train = setting.scene.train
    features = train_features(setting.gaussians, train, setting.scene.num_ids, steps=steps).final
    members, _ = select_by_similarity(setting.gaussians, features, train[::CHOICE_EVERY])
    return ids_by_members(members, np.asarray(similarities(features)))


def all_methods(setting: Setting, kept: Callable[..., np.ndarray]) -> dict[str, Callable[[], Motion]]:
    """By name, each to be called when its turn comes; `kept(name, make)` holds ids that several of them use."""

    def by_masks() -> np.ndarray:
        return kept("ids of masks", lambda: lifted_ids(setting))

    def by_features() -> np.ndarray:
        return kept("ids of features", lambda: feature_ids(setting))

    return {
        "pigjax": lambda: ours(setting, by_masks()),
        "as PhysGaussian, tight boxes": lambda: as_physgaussian(setting, by_masks(), 0.0),
        "as PhysGaussian, 1 cm wider": lambda: as_physgaussian(setting, by_masks(), 0.01),
        "as PhysDreamer": lambda: as_physdreamer(setting, by_masks()),
        "as Feature Splatting, unfilled": lambda: as_feature_splatting(setting, by_features(), fill=False),
        "as Feature Splatting, filled": lambda: as_feature_splatting(setting, by_features(), fill=True),
        "as Spring-Gaus": lambda: as_spring_gaus(setting, by_masks()),
    }


def _seeded(setting, ids, collider, fill=True):
    return seed_particles(
        setting.gaussians,
        ids,
        setting.materials,
        fill=fill,
        spacing=setting.dx,
        velocities=VELOCITIES,
        gaussians_per_cell=setting.gaussians_per_cell,
        colliders=(collider,),
    )


def _by_particles(setting, ids, collider, *, mode, fill=True) -> Motion:
    particles, table = _seeded(setting, ids, collider, fill)
    binding = bind(setting.gaussians, ids, particles)
    states, *cost = _simulate(setting, particles, table, collider)
    pose = eqx.filter_jit(partial(deform, params=ClampParams(), mode=mode))
    frames = [pose(setting.gaussians, state, binding=binding) for state in states]
    return Motion(frames, len(particles), *cost)


def _simulate(setting, particles, table, collider):
    """States of all frames, substeps, seconds and seconds of compilation."""
    steps = {"frame_dt": setting.frame_dt, "gravity": GRAVITY, "colliders": (collider,)}
    config = SimConfig(devices=1)
    near = fit_grid(particles.x, setting.dx)
    substeps = choose_substeps(particles, near, table, config, frames=setting.frames, **steps)
    config, domain = replace(config, substeps=substeps), vast_grid(setting.dx)
    run = frames_of(lambda p: rollout(p, domain, table, config, frames=1, **steps)[0], particles, setting.frames)
    return run.result, substeps, run.seconds * setting.frames, run.compile_seconds


def _reduced(particles, count):
    """Cluster centres [k 3] of every body with their volumes and bodies, `count` shared by volume."""
    x, volume, body = (np.asarray(v) for v in (particles.x, particles.volume0, particles.body))
    parts = []
    for row in range(body.max() + 1):
        mine = body == row
        share = max(int(count * volume[mine].sum() / volume.sum()), 16)
        centres, held = driving_points(x[mine].astype(float), volume[mine].astype(float), share)
        parts.append((centres, held, np.full(len(centres), row)))
    return tuple(np.concatenate(column) for column in zip(*parts))


def _near_of_own(setting, ids, x, number):
    """The 8 nearest drivers [n 8] of each Gaussian among those of its object; -1 where it has none."""
    near = np.full((len(ids), 8), -1)
    for row, name in enumerate(setting.materials):
        mine, drivers = np.flatnonzero(ids == name), np.flatnonzero(number == row)
        near[mine] = drivers[nearest_drivers(np.asarray(setting.gaussians.means)[mine], x[drivers])]
    return near


def _with(rest, means, factors) -> Splats:
    return eqx.tree_at(lambda s: (s.means, s.factors), rest, (means, factors))
