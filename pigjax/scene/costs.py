"""The cost model of a run: time by stage, memory, room on disk and error from what a scene requires.

Everything is a sum of parts, an amount times a price: so many particles of a law and substeps, so many pixels. The
prices are measured on one machine (`costs.json`, written by `python -m benchmarks plan fit --write`); on another one
those of each stage are multiplied by the ratio of a small task of the same kind, see `probe`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pigjax import io

STAGES = ("read", "segment", "seed", "splats", "simulate", "draw")
PROBE_OF = {
    "read": "host", "segment": "picture", "seed": "host", "splats": "picture", "simulate": "step", "draw": "picture",
}  # fmt: skip
IMPLICIT = 400  # explicit steps in the time of an implicit one, by benchmarks/implicit.py
ESTIMATE = "estimated error: "  # prefix of the parts of the run that estimates the error
_STATE_BYTES, _HALF_STATE_BYTES = 60, 36  # x, v and F_visual of a particle; the latter two in half precision
_ALPHA = 1 / 255  # thresholds of the measured standard
_FLUID_CFL = 0.6  # above which longer steps of a fluid gain no accuracy
_COARSER = 1.5  # dx of the run that estimates the error, over that of the run itself


class Body(NamedTuple):
    """Matter of one object."""

    name: str
    law: str
    particles: int
    cells: float  # of the grid along the cube root of its volume


@dataclass(frozen=True)
class Required:
    """Work of a run, in numbers."""

    bodies: tuple[Body, ...]
    dx: float  # grid spacing [m]
    nodes: int  # of the active grid, in the mean over frames
    frames: int
    substeps: int  # of the first frame
    gaussians: int
    moving: int  # Gaussians that matter carries
    still: int  # Gaussians of fixed objects, whose colliders are made from them
    still_objects: int
    sh_coefficients: int  # of each Gaussian, as they are drawn
    colliders: int  # in closed form or sampled
    pixels: int  # of a picture of the video
    photos: int = 0
    photo_pixels: int = 0  # of all photos
    most_nodes: int = 0  # of the largest active grid
    windows: int = 1  # sizes of the active grid, for each of which the simulation is compiled
    redrawn: float = 1.0  # share of the picture that each frame draws anew: less where camera and light are still
    own: int = 0  # splats that objects get of their own, about
    refitted: int = 0  # of these, fitted to pictures
    refits: int = 0  # objects whose own splats are fitted
    smooth: int = 0  # particles of fluids with a smooth surface
    light: int = 0  # directions from which moving matter casts shadows
    voted: bool = False  # whether masks of photos vote
    filled: int = 0  # Gaussians of objects whose hidden surface is closed
    contact: bool = False  # between bodies
    forces: int = 0
    integrator: str = "explicit"
    kernel: str = "quadratic"
    cfl: float = 0.4
    particles_per_cell: float = 8.0
    alpha_min: float = _ALPHA
    scale: float = 1.0  # of the pictures' width and height
    fewer_bands: bool = False  # whether bands of colour that the file has are left out
    states: int = 0  # kept on disk
    half_states: bool = False
    error_frames: int = 0  # simulated again for the estimated error
    guessed: bool = False  # whether the particles are estimated instead of seeded

    @property
    def particles(self) -> int:
        """Of all bodies."""
        return sum(body.particles for body in self.bodies)

    @property
    def particles_of_law(self) -> dict[str, int]:
        """Of each law that the scene needs."""
        of: dict[str, int] = {}
        for body in self.bodies:
            of[body.law] = of.get(body.law, 0) + body.particles
        return of


class Part(NamedTuple):
    """One part of the time: a stage's name, what it is, and how much of it there is."""

    stage: str
    name: str
    amount: float


class Priced(NamedTuple):
    """A part with its price."""

    stage: str
    name: str
    seconds: float


@dataclass(frozen=True)
class Prices:
    """Prices of all parts on the machine where they were measured."""

    run: dict[str, dict[str, float]]  # [s] of one of a part, by stage and name; without compilation
    compile: dict[str, dict[str, float]]  # the same of compiling, of programs that are not kept
    memory: dict[str, float]  # [bytes] of one of a part
    error: dict[str, float]  # of a body of eight cells, by law, as a share of the distance travelled
    probe: dict[str, float]  # [s] of the small tasks of `probe`
    spread: float = 1.3  # predictions hold within this factor
    source: str = ""  # machine, load and date of the measurement


@dataclass(frozen=True)
class Prediction:
    """Time, memory and error of a run before it."""

    run: dict[str, float]  # [s] by stage, without compilation
    compile: dict[str, float]  # [s] by stage; less where the programs are kept from an earlier run
    parts: tuple[Priced, ...]  # of all stages, compilation as the stage "compile"
    memory: float  # largest of the process [bytes]
    disk: float  # room of the states [bytes]
    error: float  # of the matter's motion, as a share of the distance that it travels
    picture_error: float  # root mean square of the colours' error by drawing alone, of the same matter
    probed: bool = False  # whether this machine's speed is known

    @property
    def seconds(self) -> float:
        """Of the whole run, compilation included [s]."""
        return self.run_seconds + self.compile_seconds

    @property
    def run_seconds(self) -> float:
        """Without compilation [s]."""
        return math.fsum(self.run.values())

    @property
    def compile_seconds(self) -> float:
        """Of compilation [s]."""
        return math.fsum(self.compile.values())

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "run_s": {name: round(value, 3) for name, value in self.run.items()},
            "compile_s": {name: round(value, 3) for name, value in self.compile.items()},
            "total_s": round(self.seconds, 3),
            "memory_GB": round(self.memory / 1e9, 3),
            "disk_GB": round(self.disk / 1e9, 4),
            "error_of_distance": float(f"{self.error:.3g}"),
            "error_of_colour": float(f"{self.picture_error:.3g}"),
            "probed": self.probed,
        }


@cache
def shipped_prices() -> Prices:
    """The prices of `costs.json`, by part."""
    return prices_from(io.read_json(Path(__file__).with_name("costs.json")))


def prices_from(values: Mapping[str, Any]) -> Prices:
    """Prices from plain values, as `costs.json` has them.

    Args:
        values: by field of `Prices`.
    """
    return Prices(**{name: _floats(values[name]) for name in Prices.__dataclass_fields__ if name in values})


def _floats(value: Any) -> Any:
    """Numbers as floats, which JSON writes as whole ones where they are."""
    if isinstance(value, dict):
        return {name: _floats(entry) for name, entry in value.items()}
    return value if isinstance(value, str) else float(value)


def run_parts(needs: Required) -> list[Part]:
    """Parts of the time without compilation.

    Args:
        needs: of the scene.
    """
    pictures, steps = needs.frames + 1, needs.frames * needs.substeps
    bodies, shown = len(needs.bodies), needs.gaussians + needs.own
    parts = [
        Part("read", "start", 1),
        Part("read", "Gaussians", needs.gaussians),
        Part("read", "pixels of photos", needs.photo_pixels),
        Part("seed", "objects that move", bodies),
        Part("seed", "Gaussians that move", needs.moving),
        Part("seed", "Gaussians of still objects", needs.still),
        Part("seed", "particles", needs.particles),
    ]
    if needs.voted:
        parts.append(Part("segment", "pixels that vote", needs.photo_pixels))
        parts.append(Part("segment", "Gaussians in photos", needs.gaussians * needs.photos))
    parts.append(Part("segment", "Gaussians of filled objects", needs.filled))
    parts += _steps(needs, steps)
    parts += [
        Part("splats", "objects", needs.refits),
        Part("splats", "splats that are fitted", needs.refitted),
        Part("simulate", "frames", needs.frames),
        Part("simulate", "states on disk", needs.states * needs.particles),
        Part("draw", "pictures", pictures),
        Part("draw", "Gaussians", pictures * shown * (needs.alpha_min / _ALPHA) ** -0.08),
        Part("draw", "colour bands", pictures * shown * needs.sh_coefficients),
        Part("draw", "Gaussians that move", pictures * (needs.moving + needs.own)),
        Part("draw", "pixels", (1 + needs.frames * needs.redrawn) * needs.pixels),
        Part("draw", "Gaussians in pixels", (1 + needs.frames * needs.redrawn) * shown),
        Part("draw", "smooth surfaces", pictures * needs.smooth),
        Part("draw", "shadows", pictures * shown * needs.light),
    ]
    if needs.error_frames:
        coarse = needs.error_frames * needs.substeps / _COARSER
        parts += [Part("simulate", ESTIMATE + part.name, part.amount / _COARSER**3) for part in _steps(needs, coarse)]
        parts.append(Part("seed", ESTIMATE + "Gaussians that move", needs.moving))
        parts.append(Part("seed", ESTIMATE + "objects that move", bodies))
    return [part for part in parts if part.amount]


def _steps(needs: Required, steps: float | int) -> list[Part]:
    """Parts of so many substeps."""
    if needs.integrator == "implicit":
        steps = steps * IMPLICIT
    wider = (4 / 3) ** 3 if needs.kernel == "cubic" else 1.0  # nodes that a particle reaches
    parts = [Part("simulate", f"law {law}", steps * n * wider) for law, n in needs.particles_of_law.items()]
    parts += [Part("simulate", "substeps", steps), Part("simulate", "nodes of the grid", steps * needs.nodes)]
    parts += [
        Part("simulate", "colliders", steps * needs.nodes * (needs.colliders + needs.still_objects)),
        Part("simulate", "contact of bodies", steps * needs.nodes * len(needs.bodies) * needs.contact),
        Part("simulate", "forces", steps * needs.particles * needs.forces),
    ]
    return [part for part in parts if part.amount]


def compile_parts(needs: Required) -> list[Part]:
    """Parts of the time of compilation.

    Args:
        needs: of the scene.
    """
    parts = [
        Part("read", "start", 1),
        Part("segment", "votes", int(needs.voted)),
        Part("segment", "filling", int(needs.filled > 0)),
        Part("seed", "start", 1),
        Part("seed", "still objects", needs.still_objects),
        Part("splats", "fits", needs.refits),
        Part("simulate", "start", needs.windows),
        Part("simulate", "laws", needs.windows * len(needs.particles_of_law)),
        Part("simulate", "colliders", needs.windows * (needs.colliders + needs.still_objects)),
        Part("simulate", "contact of bodies", needs.windows * needs.contact),
        Part("draw", "start", 1),
        Part("draw", "shadows", int(needs.light > 0)),
    ]
    if needs.error_frames:
        parts += [Part("simulate", ESTIMATE + part.name, part.amount) for part in parts if part.stage == "simulate"]
    return [part for part in parts if part.amount]


def memory_parts(needs: Required) -> dict[str, int]:
    """Amounts that memory goes with, by name.

    Args:
        needs: of the scene.
    """
    return {
        "start": 1,
        "Gaussians": needs.gaussians + needs.own,
        "particles": needs.particles,
        "nodes of the grid": (needs.most_nodes or needs.nodes) * (len(needs.bodies) if needs.contact else 1),
        "windows of the grid": needs.windows - 1,
        "laws": len(needs.particles_of_law),
        "splats that are fitted": needs.refitted,
        "pixels": needs.pixels,
        "pixels of photos": needs.photo_pixels,
    }


def predict(needs: Required, prices: Prices | None = None, *, speed: Mapping[str, float] | None = None) -> Prediction:
    """Time, memory and error of a run.

    A price that the measurement does not have is that of its plain form: "law x" costs what the dearest known law
    does, a part of the estimated error what it costs in the run itself, and anything else nothing.

    Args:
        needs: of the scene.
        prices: by default those of `costs.json`.
        speed: time of the small tasks of `probe` on this machine over that of the prices' machine, by task; without
            it the times are those of that machine.
    """
    prices = prices or shipped_prices()
    factor = {stage: (speed or {}).get(task, 1.0) for stage, task in PROBE_OF.items()}
    run, compiling = dict.fromkeys(STAGES, 0.0), dict.fromkeys(STAGES, 0.0)
    priced = []
    for part in run_parts(needs):
        seconds = part.amount * _price(prices.run.get(part.stage, {}), part.name) * factor[part.stage]
        run[part.stage] += seconds
        priced.append(Priced(part.stage, part.name, seconds))
    host = (speed or {}).get("host", 1.0)
    for part in compile_parts(needs):
        seconds = part.amount * _price(prices.compile.get(part.stage, {}), part.name) * host
        compiling[part.stage] += seconds
        priced.append(Priced("compile", f"{part.stage}: {part.name}", seconds))
    memory = math.fsum(amount * prices.memory.get(name, 0.0) for name, amount in memory_parts(needs).items())
    disk = needs.states * needs.particles * (_HALF_STATE_BYTES if needs.half_states else _STATE_BYTES)
    return Prediction(
        run=run,
        compile=compiling,
        parts=tuple(priced),
        memory=memory,
        disk=float(disk),
        error=matter_error(needs, prices),
        picture_error=picture_error(needs),
        probed=speed is not None,
    )


def _price(known: Mapping[str, float], name: str) -> float:
    name = name.removeprefix(ESTIMATE)
    if name in known or not name.startswith("law "):
        return known.get(name, 0.0)
    return max((value for key, value in known.items() if key.startswith("law ")), default=0.0)


def matter_error(needs: Required, prices: Prices | None = None) -> float:
    """Error of the motion of matter by grid and time step, as a share of the distance that it travels.

    It is of first order in dx: the error of a law on eight cells times eight over the cells of each body, root mean
    square over particles. Fronts of docs/results/TRADEOFF.md gave the numbers, those of `cfl` and `particles_per_cell`
    as powers: longer steps damp a little less. Fluids, which break down at 0.8 where they are compressed, gain nothing
    above the standard's 0.6.

    Args:
        needs: of the scene.
        prices: by default those of `costs.json`.
    """
    known = (prices or shipped_prices()).error
    worst = max(known.values(), default=0.0)

    def of(body: Body) -> float:
        cfl = min(needs.cfl, _FLUID_CFL) if body.law == "fluid" else needs.cfl
        return known.get(body.law, worst) * 8 / max(body.cells, 1e-9) * (cfl / 0.4) ** -0.2

    square = sum(body.particles * of(body) ** 2 for body in needs.bodies)
    error = math.sqrt(square / max(needs.particles, 1)) * (needs.particles_per_cell / 8) ** -0.1
    return error * (1.35 if needs.kernel == "cubic" else 1.0)


def picture_error(needs: Required) -> float:
    """Root mean square of the colours' error by drawing: thresholds, pixels and bands left out, of the same matter.

    Args:
        needs: of the scene.
    """
    faint = 1.3e-3 * needs.alpha_min / _ALPHA
    smaller = 0.0134 * max(1 / needs.scale - 1, 0)
    return math.hypot(faint, smaller, 0.015 * needs.fewer_bands)


def duration(seconds: float | int) -> str:
    """A time in words: "12 s", "3 min", "1.5 h"."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
