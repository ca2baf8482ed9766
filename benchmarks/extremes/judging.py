"""What becomes of an extreme input: a finite result, the project's error, or a fault."""

import collections
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.common.pages import head, row
from pigjax.core.errors import InputError, SimulationError

FINITE, REFUSED, COUNTED, BEYOND, FAULT = "finite", "refused", "counted", "beyond", "fault"


class Outcome(NamedTuple):
    """The end of one case."""

    kind: str  # "finite"; "refused" by an error; "counted" by a result; "beyond" a stated limit; "fault"
    told: str = ""


def outcome(run: Callable[[], Any]) -> Outcome:
    """The outcome of a call: its arrays are all finite, or it raises the project's error; all else is a fault."""
    try:
        found = run()
    except (InputError, SimulationError) as error:
        told = str(error)
        return Outcome(REFUSED, told) if "\n" not in told else Outcome(FAULT, f"an error of many lines: {told[:200]}")
    except Exception as error:
        return Outcome(FAULT, f"{type(error).__name__}: {str(error)[:200]}")
    if isinstance(found, Outcome):
        return found
    lost = not_finite(found)
    return Outcome(FAULT, f"{lost} numbers that are not finite") if lost else Outcome(FINITE)


def not_finite(tree: Any) -> int:
    """Numbers among the leaves of a tree that are NaN or infinite."""
    arrays = (np.asarray(leaf) for leaf in jax.tree.leaves(tree))
    return sum(int((~np.isfinite(array)).sum()) for array in arrays if array.dtype.kind == "f")


def faults(outcomes: dict[str, Outcome]) -> list[str]:
    """The faults, a line each."""
    return [f"{name}: {found.told}" for name, found in outcomes.items() if found.kind == FAULT]


def table_of(rows: Iterable[tuple[str, list[Outcome], str]]) -> tuple[str, list[str]]:
    """A table with a line for each subject: cases, outcomes and limit; and the faults.

    Args:
        rows: subject, its outcomes, and its limit in words.
    """
    kinds = (FINITE, REFUSED, COUNTED, BEYOND, FAULT)
    lines, bad, total = [head("tried", "cases", *kinds, "limit")], [], collections.Counter()
    for subject, outcomes, limit in rows:
        counts = collections.Counter(found.kind for found in outcomes)
        total += counts
        lines.append(row(subject, len(outcomes), *(counts[kind] or "" for kind in kinds), limit))
        bad += [f"{subject}: {found.told}" for found in outcomes if found.kind == FAULT]
    lines.append(row("**all**", total.total(), *(total[kind] for kind in kinds), ""))
    return "\n".join(lines), bad
