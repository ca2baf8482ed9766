"""Extremes beyond matter: leaf functions over the float range, drawing, votes, clamp, filling, long runs.

A case ends as a finite result, as an error of the project (refused), or counted by a result that says so (`Health`,
marked rows); beyond a stated limit a leaf function overflows. All else is a fault, and the command ends with 1.
"""

import sys
import warnings

import jax
import numpy as np

from benchmarks.common.pages import head, row
from benchmarks.extremes import edges, leaves, matter, settings
from benchmarks.extremes.judging import FINITE, Outcome, table_of
from benchmarks.stability import MOVING

SAMPLE = ("neo_hookean", "drucker_prager", "fluid")


def leaf_functions(options):
    """A line for each function, with the scales between which it was finite."""
    rows = []
    for name, leaf in leaves.LEAVES.items():
        found, spans = [], []
        for precision in leaves.PRECISIONS:
            own = leaves.judged(leaf, precision)
            scales = leaves.float_range(precision) if leaf.scales is None else leaf.scales
            fine = scales[np.reshape([o.kind == FINITE for o in own], (len(scales), -1)).all(1)]
            spans.append(f"{fine[0]:.3g} to {fine[-1]:.3g}" if len(fine) else "none")
            found += own
        rows.append((name, found, f"{spans[0]}; float64 {spans[1]}: {leaf.why}"))
    end(rows)


def at_edges(options):
    """A line for each subject."""
    end([(name, list(edges.outcomes_of(name).values()), limit) for name, (_, limit) in edges.SUBJECTS.items()])


def of_matter(options):
    """A line for each kind of run."""
    laws = options.laws
    tried = {
        "every extreme of STABILITY": (matter.extremes(laws), "counted by `Health`"),
        "1e-6 to 1e6 m, to 1e7 m from the origin": (matter.worlds(laws), "dx of 64 spacings of floating point there"),
        "the same, float64": (matter.in_double(laws), "as float32, of its own spacing"),
        "the same bits twice": (matter.twice(laws), "on one machine and backend"),
        "`jax_debug_nans`": (matter.checked_by_jax(laws), ""),
    }
    end([(name, list(matter.outcomes_of(cases).values()), limit) for name, (cases, limit) in tried.items()])


def long_runs(options):
    """Drift of mass, momentum and energy."""
    print("A squeezed cube of 125 particles that turns freely; a cube that rests on the floor under gravity.\n")
    print(head("law", "steps", "mass", "momentum", "angular momentum lost", "kinetic energy left"))
    rows = []
    for steps in options.steps:
        found = matter.outcomes_of(matter.drifts(options.laws, steps) | matter.rests(options.laws, steps))
        rows.append((f"{steps} steps", list(found.values()), ""))
        for law in options.laws:
            of = matter.drift(law, steps)
            print(row(law, steps, "same" if of["mass"] else "**other**", f"{of['momentum']:.0e}",
                      f"{of['angular momentum']:.0e}", f"{of['energy']:.2g}"))  # fmt: skip
    print()
    end(rows)


def of_settings(options):
    """A line for each class of settings."""
    by_class: dict[str, list[Outcome]] = {}
    for name, found in settings.outcomes().items():
        by_class.setdefault(name.partition(".")[0], []).append(found)
    end([(name, found, "the ranges of its fields") for name, found in by_class.items()])


def end(rows):
    """Print the table; end with 1 at a fault."""
    text, bad = table_of(rows)
    print(text)
    if bad:
        print("\nFaults:\n\n" + "\n".join(f"- {line}" for line in bad[:50]))
        sys.exit(1)


def quiet(part):
    """The part with warnings of single cases left out."""

    def run(options):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with jax.enable_x64(False):
                return part(options)

    return run


PARTS = {
    "leaves": ("Leaf functions over the float range", quiet(leaf_functions)),
    "edges": ("Drawing, clamp, votes, filling, reconstruction, sweeps", quiet(at_edges)),
    "matter": ("Matter", quiet(of_matter)),
    "long": ("Long runs", quiet(long_runs)),
    "settings": ("Settings", quiet(of_settings)),
}
OPTIONS = {
    "laws": {"nargs": "+", "default": list(SAMPLE), "choices": MOVING, "help": "of the parts matter and long"},
    "steps": {"nargs": "+", "type": int, "default": [10_000, 100_000], "help": "of the part long"},
}
