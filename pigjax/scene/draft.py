"""A first scene file for files that have none: up, ground, objects and their materials, as a text to edit. Host.

Objects come from masks where there are any, else from the connected parts above the ground. All that is guessed is
said in a comment beside it.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from pigjax import io
from pigjax.core.camera import Camera, orbit
from pigjax.core.errors import InputError
from pigjax.core.placing import placed, up_to
from pigjax.core.upright import find_up, spreads_wider
from pigjax.coupling.solid import large_parts, parts_of
from pigjax.mpm.materials import PRESETS
from pigjax.objects.lifting import lift
from pigjax.scene.world import AXES, axis_of, height_of, metres_of, placed_cameras
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians, RenderConfig, render
from pigjax.splatting.types import extent_of

_Z = np.array([0.0, 0.0, 1.0])
THUMBNAIL = 192  # px
_BINS = 60  # of the heights in which a ground is looked for
_LEAST_GROUND = 0.12  # share of the splats in a layer that counts as a ground
_FEWEST = 50  # Gaussians of a part that is offered as an object
_MOST_PARTS = 16
_SUPPORTS = ("table", "desk", "floor", "ground", "shelf", "plinth", "pot", "wall", "bench", "board")
_CELLS = 16  # of the grid along the smallest moving object


@dataclass
class Part:
    """An object of the draft."""

    name: str
    id: int
    members: Bool[np.ndarray, "n"]
    low: Float[np.ndarray, "3"]  # corners of its box, without strays [m]
    high: Float[np.ndarray, "3"]
    fixed: bool = False
    is_known: bool = False  # whether the file of names has it, so that it needs no id

    @property
    def size(self) -> float:
        """Cube root of the volume of its box [m]; a side counts as at least a twentieth of the longest."""
        sides = self.high - self.low
        return float(np.prod(np.maximum(sides, 0.05 * sides.max())) ** (1 / 3))

    @property
    def height(self) -> float:
        """Of its box [m]."""
        return float(self.high[2] - self.low[2])


@dataclass
class Draft:
    """A scene file, and what belongs beside it."""

    text: str  # of scene.toml
    parts: list[Part]
    labels: Labels | None  # for labels.npz; None: masks or a single object tell
    mark: str  # digest of the file's Gaussians, for the labels
    gaussians: Gaussians  # in the scene's world, with z up
    cameras: Camera | None  # of the photos, in that world
    up: str  # of the files: the name of an axis, or three numbers
    remarks: list[str] = field(default_factory=list)  # guesses and gaps, each with its remedy

    @property
    def tallest(self) -> Part:
        """Of the objects that move, the one whose true height is asked for."""
        return _tallest(self.parts)


def draft_scene(
    gaussians_path: Path,
    folder: Path,
    *,
    views_path: Path | None = None,
    masks_path: Path | None = None,
    names_path: Path | None = None,
    up: str | None = None,
    height: str | None = None,
) -> Draft:
    """Draft a scene for Gaussians, with posed photos and masks where there are any.

    Args:
        gaussians_path: trained splats.
        folder: where scene.toml will lie; its paths are relative to it.
        views_path: posed photos.
        masks_path: instance masks of the photos.
        names_path: JSON of mask ids and names.
        up: direction of the files that points up: x, y, z, -x, -y, -z, or three numbers; None: from the cameras, else
            from the ground.
        height: true height of the tallest object that moves, with its unit, as "30 cm": gives the scale of the scene,
            which photos alone cannot; None: lengths of the files are taken for metres.

    Raises:
        InputError: a file is damaged, the direction or the height is none, or no part of the scene is large
            enough for an object.
    """
    given = None if up is None else axis_of(_direction(up))
    gaussians, dropped = io.read_gaussians(gaussians_path, drop_invalid=True)
    names = {} if names_path is None else io.load_names(names_path)
    views = None
    if views_path is not None:
        views = io.load_views(views_path, masks=masks_path, missing_masks="abstain")
    extent = extent_of(gaussians)
    remarks: list[str] = []
    if dropped:
        remarks.append(f"{dropped} Gaussians hold NaN or infinity and are left out (input.drop_invalid).")
    if given is None:
        cameras = None if views is None else views.cameras
        given, told = find_direction(cameras, np.asarray(gaussians.means, np.float64)[extent.core])
        remarks.append(told)
    given = axis_of(_direction(_name_of(given)))  # as the file will say it
    world = up_to(given, _Z)
    here = placed(gaussians, world)
    labels = ground = None
    if views is not None and views.masks is not None:
        parts = _masked_parts(gaussians, here, views, names)
    else:
        ground = ground_height(np.asarray(here.means, np.float64)[extent.core], _Z)
        parts, labels = _connected_parts(here, extent.core, ground, has_views=views is not None)
        remarks.append(
            "no masks: objects are the connected parts above the ground; for other ones give"
            " objects.<name>.within = { lower = [x, y, z], upper = [x, y, z] }, or masks of posed photos."
        )
    _mark_supports(parts)
    foot = min(float(part.low[2]) for part in parts) if ground is None else ground
    middle = np.dot(world[:3, :3], extent.centre) * [1, 1, 0] + [0, 0, foot]
    origin = np.dot(world[:3, :3].T, middle)
    world[:3, 3] = -middle
    tallest = _tallest(parts)
    scale = (
        1.0 if height is None else metres_of(height, "height") / height_of(here, np.flatnonzero(tallest.members), _Z)
    )
    world[:3] *= scale
    for part in parts:
        part.low, part.high = scale * (part.low - middle), scale * (part.high - middle)
    sources = _Sources(gaussians_path, views_path, masks_path, names_path, folder, drops=dropped > 0)
    heights = scale * (np.asarray(here.means, np.float64)[tallest.members, 2] - middle[2])
    text = _text(
        sources, parts, labels is not None, given, origin, ground is not None, scale * extent.radius, remarks, heights,
        height,
    )  # fmt: skip
    return Draft(
        text=text,
        parts=parts,
        labels=labels,
        mark=io.digest_of_scene(gaussians),
        gaussians=placed(gaussians, world),
        cameras=None if views is None else placed_cameras(views.cameras, world),
        up=_name_of(given),
        remarks=remarks,
    )


def find_direction(cameras: Camera | None, means: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], str]:
    """The direction that points up in a scene's files, and a sentence that tells how it was found.

    Without cameras an axis with a ground at its lower end comes first, then any plane; else it is z.

    Args:
        cameras: of the photos, if there are any.
        means: centres of the dense core.
    """
    if cameras is None:
        name, told, is_sure = up_of_ground(means)
        if is_sure:
            return axis_of(name), told
    try:
        found = find_up(cameras, means)
    except InputError:
        return _Z, "up = z: a guess, since neither cameras nor a ground tell it; give --up if it is another axis."
    roll = "" if found.roll is None else f", which roll by {found.roll:.1f} degrees"
    return found.up, f"up = {_name_of(found.up)}: from the {found.by}{roll}."


def up_of_ground(means: Float[np.ndarray, "n 3"]) -> tuple[str, str, bool]:
    """The axis whose lower end is most like a ground, a sentence that tells it, and whether it stands out.

    Args:
        means: centres of the dense core.
    """
    shares = {name: _ground_layer(means @ axis_of(name))[0] for name in AXES}
    best, second = sorted(shares, key=lambda name: shares[name], reverse=True)[:2]
    is_sure = shares[best] >= _LEAST_GROUND and shares[best] >= 1.3 * shares[second]
    return best, f"up = {best}: {100 * shares[best]:.0f} % of the splats lie in one layer at its lower end.", is_sure


def ground_height(means: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, "3"]) -> float | None:
    """Height of the ground [m] along an axis that points up; None where there is none.

    It is a layer at the lower end that holds an eighth of the splats and spreads wider than what is above it: not the
    flat bottom of an object.
    """
    heights = means @ axis
    share, height, top = _ground_layer(heights)
    if share < _LEAST_GROUND:
        return None
    across = means[:, np.abs(axis) < 0.5]
    layer, above = ((heights <= top) & (heights >= height - (top - height)), heights > top)
    return height if spreads_wider(across[layer], across[above]) else None


def thumbnails(draft: Draft) -> dict[str, Float[np.ndarray, "h w 3"]]:
    """A picture of each object alone, from the side of the nearest camera, else from an orbit around it.

    One program draws all: the other Gaussians are there, and transparent.
    """
    hidden = jnp.full_like(draft.gaussians.logit_opacities, -40.0)
    config = RenderConfig(bands=1)

    @jax.jit
    def draw(gaussians: Gaussians, opacities: jax.Array, camera: Camera) -> jax.Array:
        alone = Gaussians(gaussians.means, gaussians.log_scales, gaussians.quats, opacities, gaussians.sh)
        frame = render(alone, camera, config, background=1.0, outputs=("rgb",))
        return jnp.clip(frame.rgb, 0, 1)

    pictures = {}
    for part in draft.parts:
        opacities = jnp.where(jnp.asarray(part.members), draft.gaussians.logit_opacities, hidden)
        pictures[part.name] = np.asarray(draw(draft.gaussians, opacities, _camera_of(part, draft.cameras)))
    return pictures


def _direction(up: str) -> str | tuple[float, float, float]:
    """The name of an axis, or the three numbers of a text."""
    try:
        numbers = [float(word) for word in up.replace(",", " ").split()]
    except ValueError:
        return up
    if len(numbers) != 3:
        raise InputError(f"up = {up!r}: choose one of {', '.join(AXES)}, or give three numbers.")
    return numbers[0], numbers[1], numbers[2]


def _name_of(direction: Float[np.ndarray, "3"]) -> str:
    """The name of the axis that a direction is within half a degree of; else its three numbers."""
    for name in AXES:
        if float(direction @ axis_of(name)) > np.cos(np.radians(0.5)):
            return name
    return ", ".join(f"{value:.5f}" for value in direction)


def _ground_layer(heights: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Share of the splats in the fullest layer of the lower third, 0 where little is above; its height and end [m]."""
    low, high = np.quantile(heights, [0.005, 0.995])
    if not high > low:
        return 0.0, float(low), float(low)
    counts, edges = np.histogram(heights, _BINS, (low, high))
    layers = counts[:-1] + counts[1:]
    k = int(np.argmax(layers[: _BINS // 3]))
    inside = heights[(heights >= edges[k]) & (heights <= edges[k + 2])]
    above = float((heights > edges[k + 2]).mean())
    share = float(len(inside) / len(heights)) if above > 0.1 else 0.0
    return share, float(np.median(inside)), float(edges[k + 2])


def _masked_parts(gaussians: Gaussians, here: Gaussians, views: io.Views, names: dict[int, str]) -> list[Part]:
    """Objects of the masks: lifted where the files have them, measured in the world."""
    voters = views.voters
    assert voters.masks is not None
    labels = lift(gaussians, voters.cameras, voters.masks, valid=voters.valid)
    object_id = np.asarray(labels.object_id)
    means = np.asarray(here.means, np.float64)
    found = [int(number) for number in np.unique(object_id) if number > 0]
    parts = [_part(_free(names, k), k, object_id == k, means) for k in found]
    for part in parts:
        part.is_known = names.get(part.id) == part.name
    if not parts:
        raise InputError("the masks give no Gaussian an object; check that masks and photos belong together.")
    return parts


def _connected_parts(
    gaussians: Gaussians, core: Bool[np.ndarray, "n"], ground: float | None, *, has_views: bool
) -> tuple[list[Part], Labels | None]:
    """Parts above the ground, the largest first, and the labels that say so.

    A single one without a ground needs none, unless there are photos, of which a scene without labels wants masks.
    """
    means = np.asarray(gaussians.means, np.float64)
    heights = np.where(core, means[:, 2], -np.inf)
    free = core.copy()
    if ground is not None:
        layer = np.abs(heights[core] - ground)
        free &= heights > ground + 3 * float(np.median(layer[layer <= np.quantile(layer, 0.3)])) + 1e-9
    index = np.flatnonzero(free)
    radii = np.exp(np.clip(np.asarray(gaussians.log_scales, np.float64)[index], -60, 60)).max(1)
    component, _ = parts_of(means[index], radii)
    sizes = np.bincount(component)
    kept = [int(k) for k in np.argsort(-sizes) if large_parts(sizes, len(index))[k] and sizes[k] >= _FEWEST]
    if not kept:
        raise InputError(f"no connected part has {_FEWEST} Gaussians or more; give masks, or a finer reconstruction.")
    object_id: Int[np.ndarray, "n"] = np.zeros(len(means), np.int32)
    for number, k in enumerate(kept[:_MOST_PARTS], 1):
        object_id[index[component == k]] = number
    if ground is None and len(kept) == 1:
        object_id[:] = 1
    count = min(len(kept), _MOST_PARTS)
    parts = [_part(f"part_{k}", k, (object_id == k) & core, means) for k in range(1, count + 1)]
    if ground is None and count == 1 and not has_views:
        return parts, None
    votes = np.zeros((len(means), count + 1), np.int32)
    votes[np.arange(len(means)), object_id] = 1
    return parts, Labels(jnp.asarray(object_id), jnp.asarray(votes), jnp.ones(len(means)))


def _part(name: str, number: int, members: Bool[np.ndarray, "n"], means: Float[np.ndarray, "n 3"]) -> Part:
    low, high = np.quantile(means[members], [0.01, 0.99], axis=0)
    return Part(name, number, members, low, high)


def _free(names: dict[int, str], number: int) -> str:
    """The name of an id, where it is one line, no dots part it, and no other id has it."""
    name = names.get(number, "")
    fit = name.isprintable() and name.strip() and "." not in name and list(names.values()).count(name) == 1
    return name if fit else f"object_{number}"


def _mark_supports(parts: list[Part]) -> None:
    """What carries the others is fixed: by its name, or since the feet of most others stand over its top."""
    for part in parts:
        others = [other for other in parts if other is not part]
        over = 0
        for other in others:
            middle = (other.low + other.high)[:2] / 2
            inside = bool(((middle >= part.low[:2]) & (middle <= part.high[:2])).all())
            foot, tall = float(other.low[2]), float(other.high[2] - other.low[2])
            over += inside and abs(foot - part.high[2]) < max(0.5 * tall, 1e-9) and foot > part.low[2]
        named = re.sub(r"[\W_0-9]+", " ", part.name.lower()).split()
        carries = len(others) > 1 and 2 * over >= len(others)
        part.fixed = bool(carries or (others and any(word in _SUPPORTS for word in named)))
    if all(part.fixed for part in parts):
        max(parts, key=lambda part: float(part.high[2])).fixed = False


def _camera_of(part: Part, cameras: Camera | None) -> Camera:
    """A square camera that the object fills."""
    middle, radius = (part.low + part.high) / 2, max(float(np.linalg.norm(part.high - part.low)) / 2, 1e-6)
    start, elevation = 0.0, float(np.radians(25))
    if cameras is not None:
        places = np.asarray(cameras.position, np.float64).reshape(-1, 3)
        x, y, z = places[int(np.argmin(np.linalg.norm(places - middle, axis=1)))] - middle
        start, elevation = float(np.arctan2(y, x)), float(np.clip(np.arctan2(z, np.hypot(x, y)), -1.25, 1.25))
    return orbit(
        middle, radius=2.6 * radius, elevation=elevation, frames=1, focal=1.15 * THUMBNAIL,
        width=THUMBNAIL, height=THUMBNAIL, start=start,
    )[0]  # fmt: skip


@dataclass
class _Sources:
    gaussians: Path
    views: Path | None
    masks: Path | None
    names: Path | None
    folder: Path
    drops: bool = False  # whether invalid Gaussians are left out

    def lines(self, labelled: bool) -> list[str]:
        """The table `input`, without its axis."""
        entries = {"gaussians": self.gaussians, "views": self.views, "masks": self.masks, "names": self.names}
        if labelled:
            entries |= {"masks": None, "names": None}
        lines = [f"{key} = {_quoted(self._relative(path))}" for key, path in entries.items() if path is not None]
        lines += ["drop_invalid = true"] * self.drops
        return [*lines, *(['labels = "labels.npz" # which object each Gaussian belongs to'] if labelled else [])]

    def _relative(self, path: Path) -> str:
        try:
            return Path(os.path.relpath(path, self.folder)).as_posix()
        except ValueError:  # another drive
            return str(path)


def _text(
    sources: _Sources,
    parts: list[Part],
    labelled: bool,
    up: Float[np.ndarray, "3"],
    origin: Float[np.ndarray, "3"],
    is_ground: bool,
    radius: float,
    remarks: list[str],
    heights: Float[np.ndarray, "n"],
    height: str | None,
) -> str:
    dx = _rounded(min(part.size for part in parts if not part.fixed) / _CELLS)
    tallest = _tallest(parts)
    tall = tallest.height
    held, why = _foot(heights, float(tallest.low[2]), tall)
    name = _name_of(up)
    direction = _quoted(name) if name in AXES else f"[{name}]"
    middle = ", ".join(f"{value + 0.0:.6g}" for value in origin)
    lines = [
        "# Written by `pigjax new` to be edited; lines behind # are choices. Run it: pigjax run scene.toml -o out",
        *(f"# {remark}" for remark in remarks),
        "",
        "[input]",
        *sources.lines(labelled),
        "",
        *_scale_lines(tallest.name, tall, height),
        "[world]",
        f"up = {direction} # direction of the files that points up: x, y, z, -x, -y, -z, or three numbers",
        f"origin = [{middle}] # point of the files that is 0 here",
        "",
        "[simulation]",
        f"# dx = {dx:g} # grid spacing [m]; left out, a sixteenth of the smallest moving object; smaller is slower",
        "frames = 48",
        "fps = 24 # frames a second of the video",
        "gravity = 9.81 # m/s², against up",
        "slow_motion = 1 # 4 shows the motion four times slower",
        '# integrator = "auto" # implicit steps where matter is so stiff that explicit ones would be many',
        "# contact_friction = 0.5 # objects never stick to each other, and slide with this friction",
        "",
    ]
    for part in parts:
        needs_id = labelled or (sources.views is not None and not part.is_known)
        lines += _object_lines(part, needs_id=needs_id, height=height if part is tallest else None)
    lines += [
        f"[planes.ground] # {'the layer of splats at the lower end' if is_ground else 'below all objects'}",
        "point = [0, 0, 0] # m",
        "normal = [0, 0, 1]",
        "friction = 0.5 # Coulomb's coefficient",
        "",
        "# [pinned.foot] # matter below this plane does not move, as a plant's pot",
        f"# point = [0, 0, {held:.4g}] # m; {why}",
        "# normal = [0, 0, 1]",
        "",
        "# [forces.breeze] # beside gravity: kind = wind, field, impulse or spring",
        '# kind = "wind"',
        "# velocity = [2, 0, 0] # m/s",
        "# drag = 2 # 1/s: still matter has the wind's speed after about 1/drag",
        "# gusts = 1 # m/s",
        "",
        "[camera] # of the video; without any field here: the training view that shows the moving objects best, else",
        "# an orbit around them",
        '# view = "name of a photo"',
        f"# radius = {3 * radius:.3g} # m: distance of an orbit",
        "# elevation = 20 # degrees above the horizon",
        "# sweep = 60 # degrees around in the whole video",
        "width = 640",
        "height = 480",
        "background = 1.0 # grey level: 0 black, 1 white",
        "",
    ]
    return "\n".join(lines)


def _scale_lines(name: str, tall: float, height: str | None) -> list[str]:
    """Comments on the unit of length."""
    if height is not None:
        return [
            f"# This file is in metres, z up, and 0 on the ground; the height of objects.{_key(name)} gives the scale."
        ]
    return [
        "# This file is in metres, z up, and 0 on the ground. Cameras of COLMAP have no scale: give the true height of",
        f'# one object, as height = "30 cm" in objects.{_key(name)} ({tall:.3g} units tall here); lengths',
        "# below are then to be scaled likewise. `pigjax new --height` does both.",
    ]


def _tallest(parts: list[Part]) -> Part:
    """Of the parts that move."""
    return max((part for part in parts if not part.fixed), key=lambda part: part.height)


def _foot(heights: Float[np.ndarray, "n"], low: float, tall: float) -> tuple[float, str]:
    """Height below which a thing would be held [m], and what tells it: a flat layer in its lower third, as soil has."""
    share, _, top = _ground_layer(heights)
    if share >= _LEAST_GROUND and top > low + 0.05 * tall:  # lower ones are the thing's own bottom
        return top, f"top of a flat layer with {100 * share:.0f} % of its splats, as soil in a pot"
    return low + 0.15 * tall, "a guess: 15 % of its height"


def _object_lines(part: Part, *, needs_id: bool, height: str | None) -> list[str]:
    size = " x ".join(f"{side:.3g}" for side in part.high - part.low)
    picture = io.safe_name(part.name)
    lines = [
        f"[objects.{_key(part.name)}] # {int(part.members.sum())} splats, {size} m; see thumbnails/{picture}.png",
        *([f"id = {part.id}"] if needs_id else []),
        *([] if height is None else [f"height = {_quoted(height)} # true height: gives the scale of the whole scene"]),
    ]
    if part.fixed:
        return [*lines, "fixed = true # carries the others: a collider made from its splats", "friction = 0.5", ""]
    others = ", ".join(name for name in PRESETS if name != "jelly")
    return [
        *lines,
        f'material = "jelly" # or {others}',
        "# density = 1000 # kg/m³",
        "# young = 1e5 # Pa: lower is softer",
        "# velocity = [0, 0, 0] # m/s, at the start",
        "# fixed = true # instead of a material: a collider made from its splats",
        "",
    ]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    """A basic string of TOML."""
    return json.dumps(text, ensure_ascii=False)


def _rounded(value: float) -> float:
    """With two digits."""
    return float(f"{value:.2g}")
