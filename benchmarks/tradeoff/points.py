"""Settings measured beside each other: the Pareto set, a table and a plot."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
from matplotlib.figure import Figure

from benchmarks.common.pages import head, picture, row


class Point(NamedTuple):
    """One setting: its time and its error."""

    name: str
    knob: str  # that differs from the standard
    seconds: float  # median of warm runs
    error: float  # smaller is better
    compile_seconds: float = float("nan")  # first run, less a warm one
    note: str = ""


def pareto(points: Sequence[Point]) -> set[str]:
    """Names of the points that no other beats: none is at least as fast and as right, and better in one of the two."""
    best, least = set(), float("inf")
    for point in sorted(points, key=lambda p: (p.seconds, p.error)):
        ties = [p for p in points if (p.seconds, p.error) == (point.seconds, point.error)]
        if point.error < least:
            best |= {p.name for p in ties}
            least = point.error
    return best


def said_windows(windows: int) -> str:
    """How often each setting was timed, in a sentence."""
    return "Times are of one warm run." if windows == 1 else f"Times are medians of {windows} warm runs taken in turn."


def by_scene(options, study: Callable, file: str, *, error: str) -> str:
    """Tables of all scenes, printed as they come, and one plot; `study(name)` gives points, floor or None, and text."""
    panels, floors = {}, {}
    for name in options.scenes:
        jax.clear_caches()  # compiled programs are mapped into memory piece by piece, and the pieces have a limit
        panels[name], floors[name], said = study(name)
        print("\n\n".join(text for text in (f"**{name}**", said, table(panels[name], error=error)) if text) + "\n")
    plot(panels, options.media / file, error=error, floors={name: floor for name, floor in floors.items() if floor})
    return picture(file, "error against time")


def table(points: Sequence[Point], *, error: str, show: Callable[[float], str] = "{:.2e}".format) -> str:
    """Markdown, fastest first, members of the Pareto set in bold."""
    best = pareto(points)
    rows = [head("setting", "knob", "time [s]", error, "compile [s]", "")]
    for point in sorted(points, key=lambda p: p.seconds):
        name = f"**{point.name}**" if point.name in best else point.name
        compiled = "" if point.compile_seconds != point.compile_seconds else f"{point.compile_seconds:.1f}"
        rows.append(row(name, point.knob, f"{point.seconds:.3g}", show(point.error), compiled, point.note))
    return "\n".join(rows)


def plot(panels: dict[str, Sequence[Point]], path: Path, *, error: str, floors: dict[str, float] | None = None) -> None:
    """One panel per scene: settings coloured by knob, the Pareto set joined, floors of the error dashed."""
    figure = Figure(figsize=(4.6 * len(panels), 4), layout="constrained", dpi=90)
    axes = figure.subplots(1, len(panels), squeeze=False)
    knobs = list(dict.fromkeys(point.knob for points in panels.values() for point in points))
    for axis, (title, points) in zip(axes[0], panels.items()):
        best = sorted((p for p in points if p.name in pareto(points)), key=lambda p: p.seconds)
        axis.plot([p.seconds for p in best], [p.error for p in best], color="0.7", zorder=0)
        for number, knob in enumerate(knobs):
            mine = [p for p in points if p.knob == knob]
            axis.scatter([p.seconds for p in mine], [p.error for p in mine], color=f"C{number}", label=knob, s=28)
        for point in points:
            axis.annotate(point.name, (point.seconds, point.error), xytext=(4, 3), textcoords="offset points",
                          fontsize=6.5, color="black" if point in best else "0.45")  # fmt: skip
        if floors and title in floors:
            axis.axhline(floors[title], ls="--", color="0.4", lw=0.8, label="floor")
        axis.set(title=title, xlabel="time [s]", xscale="log", yscale="log")
        axis.margins(x=0.2)
    axes[0, 0].set_ylabel(error)
    axes[0, -1].legend(fontsize=7)
    figure.savefig(path)
