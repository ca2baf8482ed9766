"""MLS-MPM against closed forms and experiments: verification case by case.

A section holds the case's description, a line for each figure, and a plot where there is one.
"""

import inspect
from functools import partial

from matplotlib.figure import Figure

from benchmarks.common.pages import head, picture, row
from benchmarks.verification.bars import bars
from benchmarks.verification.bodies import cantilever, plates, two_discs
from benchmarks.verification.classic import classic
from benchmarks.verification.flows import dam_break, sand, sand_cylinder
from benchmarks.verification.kernels import kernels
from benchmarks.verification.laws import laws
from benchmarks.verification.manufactured import axis_aligned, vortex


def study(case, options) -> str:
    """Section of the page on one case."""
    found = case()
    lines = [inspect.cleandoc(case.__doc__), "", head("case", "closed form or source", "expected", "ours", "error")]
    lines += [row(*figures) for figures in found.rows]
    if found.draw is not None:
        figure = Figure(figsize=(6, 4), layout="constrained", dpi=90)
        found.draw(figure)
        name = f"verify_{case.__name__}.png"
        figure.savefig(options.media / name)
        lines += ["", picture(name, case.__name__)]
    return "\n".join(lines)


CASES = (laws, bars, axis_aligned, vortex, cantilever, plates, two_discs, dam_break, sand, sand_cylinder, kernels,
         classic)  # fmt: skip
PARTS = {case.__name__: (case.__name__.replace("_", " "), partial(study, case)) for case in CASES}
