"""The report of a run as a page: one file without links to other hosts, with curves drawn as SVG."""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, UInt8

from pigjax import io
from pigjax.scene.arrangement import name_of_copy
from pigjax.scene.forces import WindSpec
from pigjax.scene.report import RunReport
from pigjax.scene.schema import ObjectSpec, Scene

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 460, 200, 64, 12, 10, 34  # of a chart [px]
_COLOURS = ("#1f6fb2", "#c2571a", "#2f8f4e", "#8a4fb0")
_PACKAGES = ("pigjax", "jax", "jaxlib", "numpy", "scipy", "equinox", "plyfile", "imageio-ffmpeg")
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:62rem;padding:0 1rem;color:#1b1f24;background:#fff}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}table{border-collapse:collapse}
td,th{text-align:left;padding:.15rem 1rem .15rem 0;border-bottom:1px solid #e3e6ea;vertical-align:top}
td.n{text-align:right;font-variant-numeric:tabular-nums}img{max-width:100%;height:auto}
pre{background:#f5f6f8;padding:.8rem;overflow:auto;font-size:13px}.charts{display:flex;flex-wrap:wrap;gap:1rem}
figure{margin:0}figcaption{font-size:13px}.bad{color:#b3261e}.note{background:#fff6e0;padding:.3rem .8rem}
svg text{font:11px system-ui,sans-serif;fill:#444}
"""


def report_page(
    scene: Scene,
    report: RunReport,
    *,
    settings: str,
    sheet: UInt8[np.ndarray, "h w 3"] | None = None,
    error: str | None = None,
) -> str:
    """The page's text; all that comes from files is escaped.

    Args:
        scene: that was run.
        report: of the run, as far as it came.
        settings: a scene file that reproduces it.
        sheet: contact sheet of the video.
        error: message of the error that ended the run.
    """
    name = scene.path(scene.input.gaussians).stem
    parts = [f"<h1>{escape(name)}: {'run stopped' if error else 'run'}</h1>"]
    if error:
        parts.append(f'<p class="bad">{escape(error)}</p>')
    else:
        parts.append('<p><a href="video.mp4">video.mp4</a>, beside this page.</p>')
    if sheet is not None:
        parts.append(f'<img alt="Frames of the video" src="{io.data_uri(sheet)}">')
    if report.warnings:
        parts.append("<h2>Warnings</h2>")
        parts += [f'<p class="note">{escape(text)}</p>' for text in report.warnings]
    parts += ["<h2>Modelled</h2>", _table(_modelled(scene, report))]
    parts += ["<h2>Left out</h2>", "<ul>", *(f"<li>{escape(text)}</li>" for text in left_out(scene, report)), "</ul>"]
    parts += ["<h2>Objects</h2>", _objects(scene, report), "<h2>Times</h2>", _times(report)]
    parts += ["<h2>Health</h2>", _estimated(report), _health(report), _drift(report), _charts(scene, report)]
    parts += ["<h2>Settings</h2>", "<p>Save as a scene file beside this page to reproduce the run.</p>"]
    parts += [f"<pre>{escape(settings)}</pre>", "<h2>Versions</h2>", _table(_versions())]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(name)}</title>'
        f"<style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def left_out(scene: Scene, report: RunReport) -> list[str]:
    """What the run does not model, with the setting that would where there is one."""
    spec, moving = scene.simulation, [entry for _, entry in _listed(scene) if entry.moves]
    found = []
    if len(moving) > 1 and spec.contact_friction is None and not any(entry.rigid for entry in moving):
        found.append(
            "Contact between objects: they share one velocity field and stick where they touch"
            " (simulation.contact_friction parts them)."
        )
    if not spec.fill:
        found.append("The inside of objects: they are hollow (simulation.fill).")
    if not any(entry.fixed for entry in scene.objects.values()) and not scene.colliders():
        found.append("Any support: nothing stands in the way of matter (a table of the scene such as planes does).")
    if not any(isinstance(force, WindSpec) for force in scene.forces.values()):
        found.append('Air, and its drag (a table forces.NAME with kind = "wind").')
    found.append("Forces of matter on fixed objects and colliders, which stay or move as told.")
    turns = report.modelled.get("sh_coefficients", 1) > 1
    light = "shadows and highlights stay as they were captured" + (", and turn with the matter." if turns else ".")
    found.append(f"Light: {light}" + (" No shadows fall (a table light)." if scene.light is None else ""))
    if scene.clamp.mode == "fixed":
        found.append('The stretch of splats, which keep their rest shape (clamp.mode = "fixed").')
    if not any(entry.fill for entry in scene.objects.values()):
        found.append(
            "Places that no photo saw: they stay empty (objects.NAME.fill closes a fixed object's surface there)."
        )
    if count := report.sizes.get("gaussians_without_particle"):
        found.append(f"Particles of {count} Gaussians, which are carried by their neighbours.")
    return found


def _modelled(scene: Scene, report: RunReport) -> dict[str, Any]:
    told = {name.replace("_", " "): value for name, value in report.modelled.items()}
    spec = scene.simulation
    dx = report.sizes.get("dx", spec.dx)  # that which the run chose, where the scene gives none
    told |= {
        **({} if dx is None else {"grid spacing": f"{dx:g} m"}),
        "gravity": spec.gravity,
        "frames": f"{spec.frames} at {spec.fps:g} a second",
    }
    names = {"gaussians": "Gaussians", "particles": "particles", "substeps_per_frame": "substeps a frame, at most"}
    told |= {label: report.sizes[name] for name, label in names.items() if name in report.sizes}
    if "mass_kg" in report.sizes:
        told["mass"] = f"{report.sizes['mass_kg']:.4g} kg"
    return told


def _objects(scene: Scene, report: RunReport) -> str:
    gaussians, particles = (report.sizes.get(name, {}) for name in ("gaussians_of", "particles_of"))
    rows = [
        (
            name,
            "removed" if entry.removed else "fixed" if entry.fixed else entry.material or entry.model or "",
            gaussians.get(name, ""),
            particles.get(name, ""),
        )
        for name, entry in _listed(scene)
    ]
    return _rows(("object", "material", "Gaussians", "particles"), rows)


def _listed(scene: Scene) -> Iterable[tuple[str, ObjectSpec]]:
    """Objects with their copies, then volumes, by the names that they have in a run."""
    for name, entry in scene.objects.items():
        yield name, entry
        yield from ((name_of_copy(name, k), entry) for k in range(1, len(entry.copies) + 1))
    yield from scene.volumes.items()


def _times(report: RunReport) -> str:
    rows: list[tuple[str, ...]] = [
        (name, f"{t.run:.2f}", f"{t.compile:.2f}", f"{t.total:.2f}") for name, t in report.times.items()
    ]
    total = [sum(getattr(t, part) for t in report.times.values()) for part in ("run", "compile", "total")]
    rows.append(("all", *(f"{value:.2f}" for value in total)))
    if told := report.predicted:
        run, compiling = (math.fsum(told[part].values()) for part in ("run_s", "compile_s"))
        where = "predicted" if told["probed"] else "predicted for another machine"
        rows.append((where, f"{run:.2f}", f"{compiling:.2f}", f"{told['total_s']:.2f}"))
    return _rows(("stage", "run s", "compile s", "total s"), rows)


def _estimated(report: RunReport) -> str:
    found = report.estimated_error
    if not found:
        return ""
    return (
        f"<p>Estimated error of the motion by grid and time step: {100 * found['error_of_distance']:.2g} % of the"
        f" distance travelled, {found['error_m']:.2g} m after {found['frames']} frames (a second run on a grid of"
        f" {found['coarser_dx']:.3g} m).</p>"
    )


def _health(report: RunReport) -> str:
    return _table({name.replace("_", " "): v for name, v in report.health.items() if not isinstance(v, list | dict)})


def _drift(report: RunReport) -> str:
    """Change of energy, momentum and mass from the start to the end, and its causes."""
    found = report.health.get("drift")
    if not found:
        return ""
    momentum = ", ".join(f"{value:.2g}" for value in found["momentum_kg_m_s"])
    alone = found["alone"]
    rows = (
        (
            "energy",
            f"{found['energy_J']:.2g} J",
            f"{100 * found['energy_share']:.2g} % of the largest kinetic energy",
            "kinetic, of gravity and elastic together; losses by plastic flow, viscosity, "
            + ("" if alone else "friction, impacts, ")
            + "and the transfers between particles and grid",
        ),
        (
            "momentum",
            f"{momentum} kg m/s",
            f"{100 * found['momentum_share']:.2g} % of that of all matter at the largest kinetic energy",
            "beside gravity's impulse; "
            + ("nothing else acts on the matter" if alone else "by colliders, pins, forces and matter that is held"),
        ),
        ("mass", f"{found['mass_kg']:.2g} kg", f"{100 * found['mass_share']:.2g} %", "of particles that broke down"),
    )
    left = (
        "Not in the energy: motion within a particle, the energy that hardening stores, and torn matter under pressure."
    )
    return _rows(("drift", "end less start", "share", "of what"), rows) + f"<p>{left}</p>"


def _charts(scene: Scene, report: RunReport) -> str:
    health = report.health
    step = 1 / (scene.simulation.fps * scene.simulation.slow_motion)
    charts = []
    kinetic, gravity, elastic = (
        np.asarray(health.get(f"{name}_energy_J", []), float) for name in ("kinetic", "gravity", "elastic")
    )
    if len(kinetic):
        height = gravity - gravity[0]
        energies = {"kinetic": kinetic, "of gravity": height, "elastic": elastic, "sum": kinetic + height + elastic}
        charts.append(("Energy", "J", energies))
    momentum = np.asarray(health.get("momentum_kg_m_s", []), float)
    if len(momentum):
        charts.append(("Momentum", "kg m/s", dict(zip("xyz", momentum.T))))
    for title, unit, key in (
        ("Volume of the matter, relative to rest", "", "volume_ratio"),
        ("Stretch of the matter: root mean square over directions", "", "stretch"),
        ("Stretch of the splats: longest axis relative to rest", "", "splat_stretch"),
    ):
        if series := health.get(key):
            charts.append((title, unit, {name.replace("_", " "): np.asarray(v, float) for name, v in series.items()}))
    return f'<div class="charts">{"".join(chart(title, unit, series, step) for title, unit, series in charts)}</div>'


def chart(title: str, unit: str, series: Mapping[str, Float[np.ndarray, "t"]], step: float) -> str:
    """Curves over the simulated time as SVG.

    Args:
        title: of the figure.
        unit: of the values.
        series: values by name, one for each frame from the start; those that are not finite are left out.
        step: time of a frame [s].
    """
    every = np.concatenate([values[np.isfinite(values)] for values in series.values()])
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    room = (high - low) * 0.05 or max(abs(high), 1.0) * 0.05
    low, high = low - room, high + room
    last = max(len(values) for values in series.values()) - 1

    def place(frame: float | int, value: float) -> tuple[float, float]:
        across = _LEFT + (_WIDTH - _LEFT - _RIGHT) * frame / max(last, 1)
        return across, _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * (value - low) / (high - low)

    lines = []
    for value in np.linspace(low + room, high - room, 4):
        x, y = place(0, float(value))
        lines.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}" stroke="#e3e6ea"/>')
        lines.append(f'<text x="{x - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
    for frame in np.linspace(0, last, 5):
        x, _ = place(float(frame), low)
        anchor = "end" if frame == last and last else "middle"
        lines.append(f'<text x="{x:.1f}" y="{_HEIGHT - 18}" text-anchor="{anchor}">{frame * step:.3g}</text>')
    lines.append(f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 4}" text-anchor="end">time [s]</text>')
    for index, (name, values) in enumerate(series.items()):
        colour = _COLOURS[index % len(_COLOURS)]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in _places(values, place))
        lines.append(f'<polyline fill="none" stroke="{colour}" stroke-width="1.6" points="{points}"/>')
        lines.append(f'<text x="{_LEFT + 110 * index}" y="{_HEIGHT - 4}" style="fill:{colour}">{escape(name)}</text>')
    caption = escape(title + (f" [{unit}]" if unit else ""))
    return (
        f'<figure><figcaption>{caption}</figcaption><svg role="img" aria-label="{caption}" width="{_WIDTH}"'
        f' height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}">{"".join(lines)}</svg></figure>'
    )


def _places(values: np.ndarray, place: Any) -> Iterable[tuple[float, float]]:
    return (place(frame, float(value)) for frame, value in enumerate(values) if np.isfinite(value))


def _versions() -> dict[str, str]:
    found = {"python": f"{platform.python_version()}, {platform.system()} {platform.machine()}"}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    devices = jax.local_devices()
    return found | {"devices": f"{len(devices)} x {devices[0].device_kind}"}


def _table(values: Mapping[str, Any]) -> str:
    return _rows((), [(name, _said(value)) for name, value in values.items()])


def _said(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(_said, value)) or "none"
    return "none" if value is None else str(value)


def _rows(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    def cells(row: Sequence[Any]) -> str:
        texts = [(str(cell), index) for index, cell in enumerate(row)]
        return "".join(
            f"<td{' class=n' if index and text[:1].isdigit() else ''}>{escape(text)}</td>" for text, index in texts
        )

    top = "<tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>" if head else ""
    return "<table>" + top + "".join(f"<tr>{cells(row)}</tr>" for row in rows) + "</table>"
