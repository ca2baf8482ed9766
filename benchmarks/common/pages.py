"""Benchmarks whose parts print tables, and pages in docs/ that hold what they printed."""

import argparse
import contextlib
import io
import re
import sys
from pathlib import Path

from _timing import machine


def replaced(page: str, title: str, text: str) -> str:
    """The page with the tables of a section replaced; what stands before the section's first table or line stays."""
    begin, end = f"<!-- {title}: printed -->", f"<!-- {title}: end -->"
    section = f"{begin}\n\n{text}\n\n{end}"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if pattern.search(page):
        return pattern.sub(lambda _: section, page)
    return f"{page.rstrip()}\n\n## {title}\n\n{section}\n"


class _Tee(io.StringIO):
    """Keeps what is printed, and shows it at once."""

    def write(self, text: str) -> int:
        sys.__stdout__.write(text)
        sys.__stdout__.flush()
        return super().write(text)


def run_parts(script: str, heading: str, parts: dict, description: str, **arguments: dict) -> None:
    """Run the parts named on the command line; `--write PAGE` replaces their sections there.

    Args:
        script: name of the benchmark, for the command that the page tells.
        heading: of a page that is not there yet.
        parts: title and function by name; it prints its tables, or gives their text.
        description: for --help.
        arguments: further options of the command line, as `add_argument` takes them; with any, the functions are given
            all that was chosen.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(parts))
    parser.add_argument("--write", type=Path, help="page whose sections are replaced")
    for name, settings in arguments.items():
        parser.add_argument(f"--{name}", **settings)
    options = parser.parse_args()
    other = [f" --{name} {_shown(getattr(options, name))}" for name in arguments
             if getattr(options, name) != parser.get_default(name)]  # fmt: skip
    for name in options.parts or parts:
        title, study = parts[name]
        kept = _Tee()
        print(f"\n## {title}\n")
        with contextlib.redirect_stdout(kept):
            print(f"`python benchmarks/{script} {name}{''.join(other)}`, {machine()}\n")
            if text := study(options) if arguments else study():
                print(text)
        if options.write:
            page = options.write.read_text() if options.write.exists() else f"# {heading}\n"
            options.write.write_text(replaced(page, title, kept.getvalue().strip()))


def _shown(value) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
