"""Splats of its own in a scene: which objects get them, how they join the scene's Gaussians; surfaces, grains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pigjax import io
from pigjax.core.gaussians import SH_CONSTANT, some_gaussians
from pigjax.coupling.binding import bind
from pigjax.coupling.liquid import Kernels, LiquidRest, liquid_kernels, liquid_rest, sheen, smoothed, with_kernels
from pigjax.coupling.own_splats import OwnSplats, make_own_splats
from pigjax.mpm import Particles
from pigjax.scene.arrangement import appended, with_bands
from pigjax.scene.plan import Inputs, Plan
from pigjax.scene.schema import ObjectSpec, Scene, VolumeSpec
from pigjax.scene.world import axis_of
from pigjax.splat import Gaussians

FLOWING = ("drucker_prager", "snow", "fluid", "foam", "plasticine")  # laws whose matter "auto" draws by own splats
GRAINS = 6  # splats that each particle of grains has
_GRAIN_SIZE = 0.6  # of these to that of one splat: their volumes add up to 1.3 of it, so that a heap hides its inside
_TORN = 3.0  # stretch of a particle that its neighbours no longer share [-]
_TORN_SHARE = 0.01  # of an object's particles, from which it counts as torn
MADE = "own_splats"  # prefix of the arrays in the file of the rest state that a later run may use again


@dataclass
class Liquid:
    """A fluid whose splats are shaped by their neighbours."""

    rows: Int[np.ndarray, "p"]  # its particles
    rest: LiquidRest
    sheen: float  # 0 to 1
    splats: Int[np.ndarray, "m"]  # its Gaussians
    at: Int[np.ndarray, "m"]  # place of the carrier of each in `rows`


@dataclass
class Surfaces:
    """What poses matter otherwise than its deformation: smooth surfaces of fluids, and grains, which never deform."""

    parts: list[Liquid]
    grains: Int[np.ndarray, "g"]  # particles that are drawn as grains
    dx: float  # [m]

    def __call__(self, gaussians: Gaussians, particles: Particles) -> tuple[Gaussians, Particles]:
        """Gaussians with their sheen, and particles whose positions and deformations pose them. Host."""
        x, F = np.array(particles.x), np.array(particles.F_visual)
        F[self.grains] = np.eye(3, dtype=F.dtype)
        sh = np.array(gaussians.sh) if any(part.sheen for part in self.parts) else None
        for part in self.parts:
            here, now = x[part.rows], liquid_kernels(x[part.rows].astype(np.float64), dx=self.dx)
            x[part.rows], F[part.rows] = smoothed(here, F[part.rows], part.rest, dx=self.dx, now=now)
            if sh is not None and part.sheen:
                sh[part.splats] = _shining(sh[part.splats], F[part.rows], now, part)
        particles = eqx.tree_at(lambda p: (p.x, p.F_visual), particles, (jnp.asarray(x), jnp.asarray(F)))
        return gaussians if sh is None else replace(gaussians, sh=jnp.asarray(sh)), particles


def _shining(
    sh: Float[np.ndarray, "m k 3"], F: Float[np.ndarray, "p 3 3"], now: Kernels, part: Liquid
) -> Float[np.ndarray, "m k 3"]:
    """Colours with a sheen about the surface as it is now, in the rest frame of each splat, which F turns."""
    u, _, vt = np.linalg.svd(np.where(np.isfinite(F).all((1, 2))[:, None, None], F, np.eye(3)).astype(np.float64))
    normals = np.einsum("pij,pjk,pk->pi", vt.swapaxes(1, 2), u.swapaxes(1, 2), now.normals)
    colour = np.clip(sh[:, 0] * SH_CONSTANT + 0.5, 0, 1)
    added = sheen(normals, part.sheen * now.sided)[part.at]
    shining = sh.copy()
    shining[:, :9] += (added[..., None] * (1 - colour)[:, None]).astype(sh.dtype)
    return shining


def chosen(scene: Scene, laws: Mapping[str, str], torn: Callable[[str], bool]) -> list[str]:
    """Names of the objects that are drawn by splats of their own.

    Args:
        scene: with `splats` of its objects.
        laws: law of each moving object.
        torn: whether an object that neither flows nor breaks by its law was torn.
    """
    wanted = {name: scene.objects[name].splats for name in laws}
    return [
        name for name, kind in wanted.items()
        if kind == "own" or (kind == "auto" and (laws[name] in FLOWING or torn(name)))
    ]  # fmt: skip


def waits_for_motion(scene: Scene, laws: Mapping[str, str]) -> bool:
    """Whether the motion decides which objects `chosen` names: "auto" asks whether elastic matter was torn."""
    return any(scene.objects[name].splats == "auto" and law not in FLOWING for name, law in laws.items())


def laws_of(scene: Scene, plan: Plan) -> dict[str, str]:
    """Law of each moving object."""
    return dict(zip([name for name, entry in scene.objects.items() if not entry.fixed], plan.table.laws))


def is_torn(F: Float[np.ndarray, "p 3 3"]) -> bool:
    """Whether matter was torn: more than a hundredth of its particles are stretched threefold. Host."""
    F = np.nan_to_num(np.asarray(F, np.float64), posinf=0, neginf=0)
    squared = np.linalg.eigvalsh(np.einsum("pji,pjk->pik", F, F))
    return bool(np.mean(squared[:, -1] > _TORN**2) > _TORN_SHARE)


def with_own(
    scene: Scene,
    inputs: Inputs,
    plan: Plan,
    names: list[str],
    *,
    stored: Mapping[str, np.ndarray] | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Inputs, Plan, dict[str, np.ndarray]]:
    """Inputs and plan in which some objects are drawn by splats of their own. Host.

    The Gaussians of these objects give way to their own splats, which come last; their particles carry none, and the
    binding knows who carries which.

    Args:
        scene: as it was read.
        inputs: its files.
        plan: of `make_plan`.
        names: objects that get them; none changes nothing.
        stored: arrays of an earlier call, which are used again if they were made from the same.
        say: told a line about each object.

    Returns:
        Inputs, plan, and arrays to store.
    """
    if not names:
        return inputs, plan, {}
    laws = laws_of(scene, plan)
    moving = list(laws)
    object_id, body = np.asarray(plan.labels.object_id), np.asarray(plan.particles.body)
    x = np.asarray(plan.particles.x)
    parts: list[tuple[Gaussians, np.ndarray]] = []
    arrays: dict[str, np.ndarray] = {}
    for number, name in enumerate(names):
        entry = scene.objects[name]
        rows = np.flatnonzero(body == moving.index(name))
        if isinstance(entry, VolumeSpec):
            poured, carriers = _of_volume(inputs.gaussians, plan, rows, entry, laws[name])
            parts.append((_fainter(poured, entry.transparency), carriers))
            continue
        members = np.flatnonzero(object_id == inputs.ids[name])
        mine = some_gaussians(inputs.gaussians, members)
        settings: dict[str, Any] = {} if entry.refit else {"steps": 0}
        axis = axis_of(scene.input.up)  # about which the fit's cameras stand
        mark = io.digest(mine, x[rows], plan.dx, entry.inside, axis, settings, make_own_splats)
        made = _stored(stored or {}, f"{MADE}_{number}", mark)
        if made is None:
            settings |= {"dx": plan.dx, "up": axis, "inside": entry.inside}
            found, before = io.kept("own_splats", (mark,), partial(_made, mine, x[rows], mark, settings))
            made = _stored(found, MADE, mark)
            assert made is not None
            inputs.reused.extend([f"splats of {name}"] * before)
            fit = (
                f"at rest {made.psnr:.1f} dB to them in views not fitted ({made.start:.1f} before the fit)"
                if entry.refit else "as they are cut"
            )  # fmt: skip
            say(
                f"{name}: {len(mine)} Gaussians give way to {len(made.gaussians)} splats of its own; {fit};"
                f" {'kept from an earlier command' if before else f'{made.seconds:.0f} s'}."
            )
        arrays |= _arrays(made, f"{MADE}_{number}", mark)
        parts.append((_fainter(made.gaussians, entry.transparency), rows[made.carrier]))
    kept = np.flatnonzero(~np.isin(object_id, [inputs.ids[name] for name in names]))
    place = np.full(len(object_id) + 1, -1)
    place[kept] = np.arange(len(kept))
    everything = jax.tree.map(
        lambda *columns: jnp.asarray(np.concatenate([np.asarray(column) for column in columns])),
        some_gaussians(inputs.gaussians, kept), *(part for part, _ in parts),
    )  # fmt: skip
    own = {f: jnp.asarray(np.asarray(getattr(plan.labels, f))[kept]) for f in ("object_id", "votes", "confidence")}
    labels = replace(plan.labels, **own)
    labels = appended(labels, [len(part) for part, _ in parts], [inputs.ids[name] for name in names])
    carrier = np.concatenate([np.full(len(kept), -1), *(carriers for _, carriers in parts)])
    particles = replace(plan.particles, gaussian=jnp.asarray(place[np.asarray(plan.particles.gaussian)], jnp.int32))
    binding = bind(everything, labels, particles, carrier=carrier, dx=plan.dx)
    smooth = [n for n in names if scene.objects[n].surface == "smooth" and laws[n] == "fluid"]
    sheens = [scene.objects[name].sheen for name in smooth]
    if any(sheens):
        everything = with_bands(everything, max(9, everything.sh.shape[1]))
    arrays |= {
        "carrier": carrier,
        "smooth": np.asarray([inputs.ids[name] for name in smooth], int),
        "sheen": np.asarray(sheens, float),
        "grains": np.asarray([inputs.ids[name] for name in names if is_grainy(scene.objects[name], laws[name])], int),
    }
    inputs = replace(inputs, gaussians=everything, arranged=True)
    return inputs, replace(plan, particles=particles, labels=labels, binding=binding), arrays


def is_grainy(entry: ObjectSpec, law: str) -> bool:
    """Whether a volume is drawn as grains: its brightness varies, and it is no fluid."""
    return isinstance(entry, VolumeSpec) and entry.grain > 0 and law != "fluid"


def _of_volume(
    gaussians: Gaussians, plan: Plan, rows: Int[np.ndarray, "p"], entry: VolumeSpec, law: str
) -> tuple[Gaussians, Int[np.ndarray, "m"]]:
    """Splats of matter that was poured, and the particle of each.

    They are those that its particles have, on a smooth surface where it is a fluid, and several where it has grains.
    """
    carried = np.asarray(plan.particles.gaussian)[rows]
    mine = some_gaussians(gaussians, carried)
    if is_grainy(entry, law):
        return _grains(mine, entry), np.repeat(rows, GRAINS)
    if entry.surface == "smooth" and law == "fluid":
        mine = with_kernels(mine, liquid_kernels(np.asarray(plan.particles.x, np.float64)[rows], dx=plan.dx))
    return mine, rows


def _grains(gaussians: Gaussians, entry: VolumeSpec) -> Gaussians:
    """Several small splats in the place of each round one, each of its own brightness."""
    random, kind = np.random.default_rng(0), gaussians.means.dtype
    many = jax.tree.map(lambda values: jnp.repeat(values, GRAINS, 0), gaussians)
    # a round splat of a lattice has half its cell as standard deviation: grains are anywhere in the cell
    reach = np.exp(np.asarray(many.log_scales))
    shift = reach * random.uniform(-1, 1, reach.shape)
    bright = np.clip(np.asarray(entry.colour) * (1 + entry.grain * random.normal(size=(len(many), 1))), 0, 1)
    return replace(
        many,
        means=many.means + jnp.asarray(shift, kind),
        log_scales=many.log_scales + np.log(_GRAIN_SIZE),
        sh=many.sh.at[:, 0].set(jnp.asarray((bright - 0.5) / SH_CONSTANT, kind)),
    )


def _fainter(gaussians: Gaussians, transparency: float) -> Gaussians:
    """Splats with their opacities times what is left of them."""
    if transparency == 0:
        return gaussians
    opacity = jax.nn.sigmoid(gaussians.logit_opacities) * (1 - transparency)
    return replace(gaussians, logit_opacities=jax.scipy.special.logit(jnp.maximum(opacity, 1e-6)))


def _made(gaussians: Gaussians, x: Float[np.ndarray, "p 3"], mark: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    return _arrays(make_own_splats(gaussians, x, **settings), MADE, mark)


def _arrays(made: OwnSplats, prefix: str, mark: str) -> dict[str, np.ndarray]:
    arrays: dict[str, Any] = {f.name: getattr(made.gaussians, f.name) for f in fields(Gaussians)}
    arrays |= {"carrier": made.carrier, "scores": np.array([made.psnr, made.start, made.seconds]), "mark": mark}
    return {f"{prefix}_{name}": np.asarray(values) for name, values in arrays.items()}


def _stored(arrays: Mapping[str, np.ndarray], prefix: str, mark: str) -> OwnSplats | None:
    """Splats of an earlier run, where they were made from the same."""
    if f"{prefix}_mark" not in arrays or str(arrays[f"{prefix}_mark"]) != mark:
        return None
    gaussians = Gaussians(**{f.name: jnp.asarray(arrays[f"{prefix}_{f.name}"]) for f in fields(Gaussians)})
    return OwnSplats(gaussians, arrays[f"{prefix}_carrier"], *arrays[f"{prefix}_scores"].tolist())


def surfaces_of(
    stored: Mapping[str, np.ndarray], objects: Int[np.ndarray, "p"], x: Float[Array, "p 3"], dx: float
) -> Surfaces | None:
    """Surfaces at rest of the fluids that are drawn smooth, and what is drawn as grains; None without any. Host.

    Args:
        stored: arrays of `with_own`.
        objects: id of each particle's object.
        x: particles at rest [m].
        dx: grid spacing [m].
    """
    parts, carrier = [], stored.get("carrier", np.zeros(0, int))  # particle of each Gaussian, or -1
    for number, strength in smooth_of(stored).items():
        rows = np.flatnonzero(objects == number)
        splats = np.flatnonzero(np.isin(carrier, rows))
        rest = liquid_rest(np.asarray(x)[rows], dx=dx)
        parts.append(Liquid(rows, rest, strength, splats, np.searchsorted(rows, carrier[splats])))
    grains = np.flatnonzero(np.isin(objects, stored.get("grains", np.zeros(0, int))))
    return Surfaces(parts, grains, dx) if parts or len(grains) else None


def smooth_of(arrays: Mapping[str, np.ndarray]) -> dict[int, float]:
    """Sheen of each fluid that is drawn smooth, by its id, from the arrays of `with_own`."""
    ids = arrays.get("smooth", np.zeros(0, int))
    return dict(zip(np.asarray(ids).tolist(), np.asarray(arrays.get("sheen", np.zeros(len(ids)))).tolist()))
