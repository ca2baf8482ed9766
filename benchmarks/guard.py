"""Guard: timings as ratios to a yardstick, programs compiled, and accuracy, beside those that were stored last.

    python -m benchmarks guard            # compare with the last entry of this kind of machine; warn beyond 15 %
    python -m benchmarks guard timings --store   # on a quiet machine: keep an entry of this commit
    python -m benchmarks guard history           # entries of this kind of machine, and what changed between them

Every window of a task of `benchmarks/common/yardsticks.py` stands beside one of a yardstick that is no part of pigjax
(a product of matrices, exponentials, a scatter), so that load and clock cancel. `benchmarks/guard.json` holds an entry
for each commit and kind of machine. Programs and accuracy do not depend on the machine, and
`tests/benchmarks/test_guard.py` asserts them; timings only warn.
"""

import itertools
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np

import pigjax as pj
from benchmarks.common.kept import commit
from benchmarks.common.pages import head, row
from benchmarks.common.timing import clock, machine
from benchmarks.common.yardsticks import TASKS
from pigjax.mpm import reference as plain_matter
from pigjax.splatting import reference as plain_picture

FILE = Path(__file__).with_name("guard.json")
FAR_OFF = 0.15  # relative change of a ratio that is warned about
WORSE = 4.0  # times the stored error that fails: errors of a few roundings differ so much by fusions of XLA
MOST_ENTRIES = 40  # of one kind of machine
ROUNDING = 1e-6  # eight roundings of float32: smaller errors are as good as each other
_COMPILED = "/jax/core/compile/backend_compile_duration"  # comes for programs of the cache, too


# Timings.


def yardstick() -> Callable[[], Any]:
    """Work of fixed size for arithmetic, memory and scattered writes, a tenth of a second or so."""
    rng = np.random.default_rng(0)
    square = jnp.asarray(rng.random((384, 384)), jnp.float32)
    places = jnp.asarray(rng.integers(0, 200_000, 400_000))

    @jax.jit
    def work(square, places):
        product = square
        for _ in range(4):
            product = jnp.tanh(product @ square / 384)
        values = jnp.exp(-jnp.linspace(0.0, 1.0, len(places)))
        return product.sum() + jnp.zeros(200_000).at[places].add(values).max()

    return lambda: work(square, places)


def timings(windows: int, tasks: list[str]) -> dict[str, float]:
    """Time of each task in yardsticks: the median over pairs of windows that follow each other."""
    rule = yardstick()
    clock(rule)
    found = {}
    for name in tasks:
        run = TASKS[name]()
        clock(run)
        pairs = [(clock(run)[0], (clock(rule)[0] + clock(rule)[0]) / 2) for _ in range(windows)]
        found[name] = round(statistics.median(own / base for own, base in pairs), 3)
    return found


def kind() -> str:
    """Processor, cores, device and JAX: ratios of one kind are compared with each other."""
    info = Path("/proc/cpuinfo")
    names = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")] if (
        info.exists()
    ) else []  # fmt: skip
    device = jax.local_devices()[0].device_kind
    return f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores, {device}, jax {jax.__version__}"


# Programs.


@contextmanager
def counted_programs() -> Iterator[list[int]]:
    """Inside, the one number of the list counts the programs that JAX compiles or takes from its cache."""
    count = [0]

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        count[0] += event == _COMPILED

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield count
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def small_matter(young: float = 2e4) -> tuple[Any, ...]:
    """64 particles of jelly in 12³ nodes, flying freely."""
    axis = (np.arange(4) - 1.5) / 24
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + 0.5
    table = pj.material_table([pj.Material("neo_hookean", density=1000.0, young=young, poisson=0.3)])
    particles = pj.make_particles(np.float32(x), volume=1 / 24**3, table=table, velocity=jnp.asarray([0.3, 0.0, 0.0]))
    particles = replace(particles, F=particles.F * jnp.asarray([0.97, 1.02, 1.0]))
    return particles, pj.Grid(jnp.zeros(3), jnp.asarray(1 / 12), (12, 12, 12)), table


def small_picture(shift: float = 0.0) -> tuple[Any, Any]:
    """Forty Gaussians and a camera of 24 x 20 px."""
    rng = np.random.default_rng(0)
    parts = (
        rng.normal(0, 0.4, (40, 3)) + shift, rng.normal(np.log(0.1), 0.5, (40, 3)), rng.normal(size=(40, 4)),
        rng.normal(size=40), rng.normal(0, 0.2, (40, 4, 3)),
    )  # fmt: skip
    camera = pj.look_at(np.array([1.2, -2.0, 1.0]), np.zeros(3), focal=28.0, width=24, height=20)
    return pj.Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts)), camera


CONFIG = pj.SimConfig(substeps=10, devices=1)


def simulated(number: float) -> Any:
    """Ten substeps, with all numbers a little different."""
    particles, grid, table = small_matter(2e4 + number)
    return pj.rollout(
        particles, grid, table, CONFIG, frames=1, frame_dt=0.01 + 1e-5 * number, gravity=(0.0, 0.0, -9.8 - number)
    )


def drawn(number: float) -> Any:
    """A picture, of splats a little elsewhere."""
    gaussians, camera = small_picture(0.01 * number)
    return pj.render(gaussians, camera, outputs=("rgb",))


def clamped(number: float) -> Any:
    """Shapes after a stretch, with other weights."""
    gaussians, _ = small_picture()
    F = jnp.broadcast_to(jnp.diag(jnp.asarray([1.0 + 0.1 * number, 1.0, 0.8])), (40, 3, 3))
    return pj.eigen_clamp(gaussians, F, pj.ClampParams(lambda_R=1.0 + number, tau_max=3.0 + number))


def voted(number: float) -> Any:
    """Votes with other thresholds."""
    gaussians, camera = small_picture()
    masks = np.arange(20 * 24).reshape(1, 20, 24) % 3
    return pj.lift_masks(
        gaussians, pj.stack_cameras([camera]), masks, num_ids=3, tau_d=0.03 + 0.01 * number, ties="lowest"
    )


ENTRIES = {"rollout": simulated, "render": drawn, "eigen_clamp": clamped, "lift_masks": voted}


def recompiled(name: str) -> int:
    """Programs that new numbers compile, once everything of that shape has run: 0 where numbers are arrays."""
    jax.block_until_ready(jax.tree.leaves(ENTRIES[name](0.0)))
    with counted_programs() as count:
        jax.block_until_ready(jax.tree.leaves(ENTRIES[name](1.0)))
    return count[0]


# Accuracy.


def matter_error() -> float:
    """Largest distance from the plain twin `mpm/reference.py` after ten substeps, in cells."""
    particles, grid, table = small_matter()
    dt = 5e-4
    end, _, _ = pj.rollout(particles, grid, table, CONFIG, frames=1, frame_dt=10 * dt, gravity=(0.0, 0.0, -9.8))
    now = particles
    for _ in range(10):
        now = plain_matter.substep(now, grid, table, CONFIG, dt, gravity=jnp.asarray([0.0, 0.0, -9.8]))
    return float(jnp.abs(end.x - now.x).max() / grid.dx)


def momentum_error() -> float:
    """Momentum of free flight that ten substeps lose, in parts of the first."""
    particles, grid, table = small_matter()
    end, _, _ = pj.rollout(particles, grid, table, CONFIG, frames=1, frame_dt=5e-3, gravity=(0.0, 0.0, 0.0))
    mass = np.asarray(particles.mass, np.float64)[:, None]
    first, last = ((mass * np.asarray(p.v, np.float64)).sum(0) for p in (particles, end))
    return float(np.abs(last - first).max() / np.abs(first).max())


def picture_error() -> float:
    """Largest difference of a channel from the plain twin `splatting/reference.py`, in values of 0 to 1."""
    gaussians, camera = small_picture()
    config = pj.RenderConfig()
    rgb = pj.render(gaussians, camera, config, outputs=("rgb",)).rgb
    return float(jnp.abs(rgb - plain_picture.render(gaussians, camera, config).rgb).max())


def clamp_error() -> float:
    """Largest relative difference of the covariance of turned shapes from the turned covariance."""
    gaussians, _ = small_picture()
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn = jnp.asarray(turn * np.sign(np.linalg.det(turn)), jnp.float32)
    posed = pj.eigen_clamp(gaussians, jnp.broadcast_to(turn, (40, 3, 3)), pj.ClampParams()).factors
    rest = pj.eigen_clamp(gaussians, jnp.broadcast_to(jnp.eye(3), (40, 3, 3)), pj.ClampParams()).factors
    found, wanted = posed @ posed.swapaxes(1, 2), turn @ rest @ rest.swapaxes(1, 2) @ turn.T
    return float((jnp.abs(found - wanted).max((1, 2)) / jnp.abs(wanted).max((1, 2))).max())


ACCURACY = {
    "10 substeps beside the plain twin [cells]": matter_error,
    "momentum lost in 10 substeps": momentum_error,
    "picture beside the plain twin": picture_error,
    "covariance of a turned shape": clamp_error,
}


# The file.


def stored() -> list[dict[str, Any]]:
    """All entries, oldest first."""
    return json.loads(FILE.read_text()) if FILE.exists() else []


def last_of(entries: list[dict[str, Any]], of_kind: str) -> dict[str, Any] | None:
    """The last entry of a kind of machine."""
    return next((entry for entry in reversed(entries) if entry["kind"] == of_kind), None)


def warnings_of(found: dict[str, float], before: dict[str, float]) -> list[str]:
    """A line for each ratio that is more than 15 % off."""
    return [
        f"warning: {name}: {ratio:g} yardsticks, {before[name]:g} stored: {ratio / before[name] - 1:+.0%}"
        for name, ratio in found.items()
        if name in before and not abs(ratio / before[name] - 1) <= FAR_OFF
    ]


def with_entry(entries: list[dict[str, Any]], entry: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries and one more, in place of that of its commit and kind; the oldest of a kind give way."""
    kept = [old for old in entries if (old["commit"], old["kind"]) != (entry["commit"], entry["kind"])] + [entry]
    own = [old for old in kept if old["kind"] == entry["kind"]]
    too_old = own[: max(len(own) - MOST_ENTRIES, 0)]
    return [old for old in kept if old not in too_old]


def compare(options):
    """Print the ratios beside the last ones; warn, and store them if asked."""
    tasks = list(TASKS)
    found = timings(options.windows, [tasks[k] for k in options.tasks] if options.tasks else tasks)
    entries, own = stored(), kind()
    before = last_of(entries, own)
    print(head("task", "yardsticks", "stored", "change"))
    for name, ratio in found.items():
        old = (before or {"timings": {}})["timings"].get(name)
        print(
            row(name, f"{ratio:g}", "" if old is None else f"{old:g}", "" if old is None else f"{ratio / old - 1:+.0%}")
        )
    print(f"\nStored: {'none of this kind' if before is None else before['commit']}.")
    for line in warnings_of(found, (before or {"timings": {}})["timings"]):
        print(line, file=sys.stderr)
        print(line)
    if options.store:
        entry = {
            "commit": commit(), "kind": own, "machine": machine(), "timings": found,
            "programs": {name: recompiled(name) for name in ENTRIES},
            "accuracy": {name: float(f"{error():.2g}") for name, error in ACCURACY.items()},
        }  # fmt: skip
        FILE.write_text(json.dumps(with_entry(entries, entry), indent=1, ensure_ascii=False) + "\n")


def history(options):
    """Print the stored ratios of this kind of machine by commit, and warn of each step from one to the next."""
    own = kind()
    entries = [entry for entry in stored() if entry["kind"] == own and entry["timings"]]
    for line in history_of(entries):
        print(line)


def history_of(entries: list[dict[str, Any]]) -> list[str]:
    """A table with a column for each of the last eight entries, and a line for each ratio that is more than 15 % off.

    Args:
        entries: of one kind of machine, oldest first.
    """
    if not entries:
        return ["No entry of this kind of machine; `guard timings --store` adds one."]
    last = entries[-8:]
    names = dict.fromkeys(name for entry in last for name in entry["timings"])
    lines = [head("task, in yardsticks", *(entry["commit"] for entry in last))]
    lines += [row(name, *(f"{entry['timings'].get(name, '')}" for entry in last)) for name in names]
    for before, after in itertools.pairwise(last):
        told = warnings_of(after["timings"], before["timings"])
        lines += [f"{before['commit']} to {after['commit']}: {line}" for line in told]
    return lines


def exact(options):
    """Print programs and accuracy beside the stored ones; end with 1 where one is worse."""
    entries = stored()
    before = entries[-1] if entries else {"programs": {}, "accuracy": {}}
    print(head("programs that new numbers compile", "", "stored"))
    programs = {name: recompiled(name) for name in ENTRIES}
    for name, count in programs.items():
        print(row(name, count, before["programs"].get(name, "")))
    print("\n" + head("error", "", "stored"))
    errors = {name: error() for name, error in ACCURACY.items()}
    for name, error in errors.items():
        print(row(name, f"{error:.2g}", before["accuracy"].get(name, "")))
    if worse(programs, errors, before):
        sys.exit(1)


def worse(programs: dict[str, int], errors: dict[str, float], before: dict[str, Any]) -> list[str]:
    """Names of programs and errors that are worse than the stored ones."""
    more = [name for name, count in programs.items() if count > before["programs"].get(name, count)]
    bounds = {name: max(WORSE * before["accuracy"].get(name, error), ROUNDING) for name, error in errors.items()}
    return more + [name for name, error in errors.items() if not error <= bounds[name]]


PARTS = {
    "timings": ("Timings in yardsticks", compare),
    "history": ("Timings by commit", history),
    "exact": ("Programs and accuracy", exact),
}
OPTIONS = {
    "windows": {"type": int, "default": 15, "help": "pairs of warm windows of each task"},
    "tasks": {"nargs": "+", "type": int, "help": "numbers of the tasks, from 0; all without"},
    "store": {"action": "store_true", "help": "add an entry to benchmarks/guard.json"},
}
