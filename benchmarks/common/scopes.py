"""Where the time of a compiled program goes, by the named scopes of its operations (jax.profiler)."""

import collections
import re
import tempfile
from pathlib import Path

import jax


def seconds_by_scope(compiled, run, scopes) -> dict[str, float]:
    """Seconds of `run()`, which calls the compiled program, in each of the scopes; the rest under "rest".

    An operation counts for the last of the scopes in its name, without the operations that it calls; those without a
    name count for their caller. The profiler itself slows programs of small operations: compare the shares.
    """
    name_of = dict(re.findall(r'%?([\w.\-]+) = [^\n]*?op_name="([^"]*)"', compiled.as_text()))
    found = {part for name in name_of.values() for part in name.split("/")}
    if missing := [scope for scope in scopes if scope not in found]:
        raise ValueError(f"no operation of the program is in scope {', '.join(missing)}")

    def scope(operation):
        parts = [part for part in name_of.get(operation, "").split("/") if part in scopes]
        return parts[-1] if parts else None

    total: dict[str, float] = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(run())
        (path,) = Path(folder).rglob("*.xplane.pb")
        lines = [line for plane in jax.profiler.ProfileData.from_file(str(path)).planes for line in plane.lines]
        for line in lines:
            events = sorted(
                ((e.start_ns, -e.duration_ns, e.name) for e in line.events if e.name in name_of), key=lambda e: e[:2]
            )
            _add_own_times(events, scope, total)
    return {name: total[name] * 1e-9 for name in (*scopes, "rest")}


def _add_own_times(events, scope, total):
    """Of one thread, whose events are nested, in the order of their starts."""
    open_events: list[tuple[float, str]] = []  # end and scope
    for start, minus_duration, name in events:
        while open_events and open_events[-1][0] <= start:
            open_events.pop()
        caller = open_events[-1][1] if open_events else "rest"
        own = scope(name) or caller
        total[own] -= minus_duration
        if open_events:
            total[caller] += minus_duration
        open_events.append((start - minus_duration, own))
