"""Three objects and how they deform: `field(positions)` gives where matter goes and F, everywhere in the object."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.common.pages import TABLETOP
from pigjax.core.camera import Camera, look_at
from pigjax.core.gaussians import SH_CONSTANT
from pigjax.mpm import fit_grid
from pigjax.mpm.colliders import Plane
from pigjax.scene import load_scene
from pigjax.scene.plan import read_inputs, segment

Field = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Subject(NamedTuple):
    name: str
    told: str  # its deformation, for the page
    gaussians: pj.Gaussians  # the object alone, without view-dependent colour
    field: Field  # positions [m 3] at rest to positions [m 3] and F [m 3 3]
    size: float  # largest standard deviation of the reference's parts [m]
    eye: tuple[float, float, float]  # of the camera, from the middle of the deformed object [its diagonals]

    def camera(self, x: np.ndarray, pixels: int) -> Camera:
        """Around the deformed object."""
        low, high = np.percentile(x, [1, 99], axis=0)
        middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
        eye = middle + extent * np.array(self.eye)
        return look_at(eye, middle, focal=0.85 * pixels * float(np.linalg.norm(self.eye)), width=pixels, height=pixels)


def subjects(names: tuple[str, ...]) -> list[Subject]:
    """The scenes by name: bent, pressed, drawn."""
    needed = {"bent": "soccerball", "pressed": "duck"}
    objects = cut_out([needed[name] for name in names if name in needed])
    made = {"bent": lambda: bent(objects["soccerball"]), "pressed": lambda: pressed(objects["duck"]), "drawn": drawn}
    return [made[name]() for name in names]


def bent(ball: pj.Gaussians) -> Subject:
    """Small deformation: the reconstructed football, bent and sheared a little."""
    middle, radius = _middle(ball)

    def move(x):
        u = (x - middle) / radius
        angle = 0.35 * u[2]
        shifted = jnp.stack([u[0] + 0.25 * u[2] ** 2, u[1] * (1 + 0.15 * u[0]), u[2] * (1 - 0.15 * u[0])])
        return middle + radius * (turn(angle) @ shifted)

    return Subject("bent", "football, bent and sheared (analytic)", ball, along(move), 0.004, (1.1, -0.9, 0.5))


def drawn() -> Subject:
    """Extreme deformation: a ball of known colours, its middle drawn to a thread and wound."""
    ball = textured_ball()

    def move(x):
        u = x / 0.1
        # stretch 1 + 7·exp(-(z / 0.35)²), so that F changes by much within one Gaussian
        stretch = 1 + 7 * jnp.exp(-((u[2] / 0.35) ** 2))
        z = u[2] + 7 * 0.35 * 0.5 * jnp.sqrt(jnp.pi) * jax.scipy.special.erf(u[2] / 0.35)
        return 0.1 * (turn(0.5 * z) @ jnp.stack([u[0] / jnp.sqrt(stretch), u[1] / jnp.sqrt(stretch), z]))

    return Subject("drawn", "ball of stripes, drawn to a thread and wound (analytic)", ball, along(move), 0.003,
                   (1.2, 0.0, 0.12))  # fmt: skip


def pressed(duck: pj.Gaussians, *, dx: float = 0.01, share: float = 0.6, seconds: float = 0.15) -> Subject:
    """Large deformation: the reconstructed duck of plasticine under a press, simulated by MLS-MPM."""
    low, high = np.percentile(np.asarray(duck.means), [0.5, 99.5], axis=0)
    material = pj.Material("plasticine", density=1000, young=6e3, poisson=0.35, yield_stress=3e2,
                           residual_stress=2e2, hardening_modulus=-5e2)  # fmt: skip
    matter, table = pj.seed_particles(duck, np.ones(len(duck), int), {1: material}, spacing=dx)
    down = share * (high[2] - low[2]) / seconds
    planes = (
        Plane([0.0, 0.0, float(low[2]) - 0.5 * dx], [0.0, 0.0, 1.0], mode="separate", friction=0.6),
        Plane([0.0, 0.0, float(high[2])], [0.2, 0.0, -1.0], velocity=[0.0, 0.0, -down], mode="separate", friction=0.6),
    )

    def field(positions):
        """Tracers: particles so light that they go with the others and do not act on them."""
        x = np.concatenate([np.asarray(matter.x), positions])
        light = np.full(len(positions), 1e-6 * float(matter.volume0.mean()))
        volume = np.concatenate([np.asarray(matter.volume0), light])
        particles = pj.make_particles(x, volume=volume, table=table)
        # slack for the matter that is pressed out at the sides
        end, _, health = pj.rollout(
            particles, fit_grid(x, dx, margin=0.12), table, pj.SimConfig(), frames=5, frame_dt=seconds / 5,
            gravity=(0.0, 0.0, -9.81), colliders=planes,
        )  # fmt: skip
        health.raise_if_bad()
        moved = slice(len(matter), None)
        return np.asarray(end.x)[moved], np.asarray(end.F_visual)[moved]

    return Subject("pressed", "duck of plasticine under a tilted press (MLS-MPM)", duck, field, 0.006, (0.9, -0.9, 0.5))


def textured_ball(count: int = 700, radius: float = 0.1) -> pj.Gaussians:
    """Flat Gaussians on a sphere [m], coloured in stripes by where they are."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    normal = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)
    # the shortest rotation of z to the normal
    quats = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], 0 * k], 1)
    spread = 0.85 * radius * np.sqrt(4 * np.pi / count)
    log_scales = np.tile(np.log([spread, spread, 0.15 * spread]), (count, 1))
    longitude = np.arctan2(normal[:, 1], normal[:, 0])
    stripes = (np.floor(longitude / (np.pi / 5)) + np.floor(4 * (normal[:, 2] + 1))) % 2
    colour = np.where(stripes[:, None] > 0, [0.85, 0.25, 0.15], [0.1, 0.35, 0.65])
    sh = (colour - 0.5)[:, None] / SH_CONSTANT
    parts = radius * normal, log_scales, quats, np.full(count, 2.5), sh
    return pj.Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def along(move: Callable) -> Field:
    """The field of a map of one point."""
    both = jax.jit(jax.vmap(lambda x: (move(x), jax.jacfwd(move)(x))))
    return lambda positions: tuple(np.asarray(v) for v in both(jnp.asarray(positions, jnp.float32)))


def turn(angle):
    """The rotation about z by an angle [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s, 0 * c]), jnp.stack([s, c, 0 * c]), jnp.array([0.0, 0.0, 1.0])])


def _middle(gaussians):
    low, high = np.percentile(np.asarray(gaussians.means), [1, 99], axis=0)
    return (low + high) / 2, float(np.max(high - low)) / 2


def cut_out(names: list[str]) -> dict[str, pj.Gaussians]:
    """Objects of the bundled tabletop, cut out by their masks, without floaters and nearly transparent Gaussians."""
    if not names:
        return {}
    scene = load_scene(TABLETOP / "scene.toml")
    inputs = read_inputs(scene)
    object_id = np.asarray(segment(scene, inputs).object_id)
    found = {}
    for name in names:
        own = object_id == inputs.ids[name]
        low, high = np.percentile(np.asarray(inputs.gaussians.means)[own], [1, 99], axis=0)
        margin = 0.1 * (high - low)
        means = np.asarray(inputs.gaussians.means)
        near = ((means > low - margin) & (means < high + margin)).all(1)
        rows = np.flatnonzero(own & near & (np.asarray(inputs.gaussians.logit_opacities) > -3))
        one = jax.tree.map(lambda values, rows=rows: jnp.asarray(values)[rows], inputs.gaussians)
        found[name] = eqx.tree_at(lambda g: g.sh, one, one.sh[:, :1])
    return found
