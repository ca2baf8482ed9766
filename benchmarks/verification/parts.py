"""MLS-MPM against closed forms and experiments: `python benchmarks/verify_mpm.py [case ...] [--plots docs/media]`.

One line per figure. Without names every case runs, and docs/results/VERIFICATION.md is written from what was printed.
"""

import argparse
import inspect
import time
from pathlib import Path

import matplotlib.pyplot as plt
from benchmarks.common.timing import machine
from benchmarks.verification.bars import bars
from benchmarks.verification.bodies import cantilever, plates, two_discs
from benchmarks.verification.classic import classic
from benchmarks.verification.flows import dam_break, sand, sand_cylinder
from benchmarks.verification.kernels import kernels
from benchmarks.verification.laws import laws
from benchmarks.verification.manufactured import axis_aligned, vortex

DOCS = Path(__file__).parents[1] / "docs"
CASES = {
    case.__name__: case
    for case in (
        laws,
        bars,
        axis_aligned,
        vortex,
        cantilever,
        plates,
        two_discs,
        dam_break,
        sand,
        sand_cylinder,
        kernels,
        classic,
    )
}
COMMAND = "python benchmarks/verify_mpm.py"
HEAD = ("case", "closed form or source", "expected", "ours", "error", "CPU s")


def table_line(cells):
    return f"| {' | '.join(cells)} |"


def drawn(name, case, folder):
    """File of the case's plot, None where it has none."""
    if case.draw is None:
        return None
    figure = plt.figure(figsize=(6, 4), layout="constrained")
    case.draw(figure)
    path = folder / f"verify_{name}.png"
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path


def run(name, folder):
    """Section of the page on one case, printed line by line: rows, and the text and plot beside them."""
    begun = time.process_time()
    case = CASES[name]()
    spent = time.process_time() - begun
    lines = [table_line([*row, f"{spent:.0f}" if k == 0 else ""]) for k, row in enumerate(case.rows)]
    print("\n".join(lines), flush=True)
    plot = drawn(name, case, folder)
    text = inspect.cleandoc(CASES[name].__doc__)
    section = [f"## {name.replace('_', ' ')}", f"`{COMMAND} {name}`", text]
    if plot is not None:
        section.append(f"![{name}]({'..' / plot.relative_to(DOCS) if plot.is_relative_to(DOCS) else plot})")
    return lines, "\n\n".join(section)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="case", help=f"{', '.join(CASES)}; all without")
    parser.add_argument("--plots", type=Path, default=DOCS / "media", help="folder of the plots")
    arguments = parser.parse_args()
    if unknown := set(arguments.cases) - set(CASES):
        parser.error(f"no case {', '.join(sorted(unknown))}: choose of {', '.join(CASES)}")
    folder = arguments.plots.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    plt.switch_backend("agg")
    head = [table_line(HEAD), table_line(["---"] * len(HEAD))]
    print("\n".join([machine(), *head]), flush=True)
    sections = [run(name, folder) for name in arguments.cases or CASES]
    if not arguments.cases:
        rows = [line for lines, _ in sections for line in lines]
        intro = [
            "# Verification",
            f"Written by `{COMMAND}` from what it printed on {machine()}. CPU seconds are of a whole case,"
            " compilation and all. `pytest tests/benchmarks/test_verification.py -s -n0` holds the"
            " cheapest form of each case.",
            "\n".join([*head, *rows]),
        ]
        (DOCS / "results" / "VERIFICATION.md").write_text("\n\n".join([*intro, *(text for _, text in sections)]) + "\n")


if __name__ == "__main__":
    main()
