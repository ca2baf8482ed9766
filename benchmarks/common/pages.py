"""Pages of docs/results and their pictures: where they lie, Markdown of tables, and sections that are replaced."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGES, MEDIA = ROOT / "docs" / "results", ROOT / "docs" / "media"
EXAMPLES = ROOT / "examples"
TABLETOP = EXAMPLES / "tabletop"


def row(*cells: Any) -> str:
    """A line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*columns: Any) -> str:
    """The first two lines of a table."""
    return f"{row(*columns)}\n{'|---' * len(columns)}|"


def table(columns: list[str], rows: list[list[str]]) -> str:
    """A whole table."""
    return "\n".join([head(*columns), *(row(*cells) for cells in rows)])


def picture(name: str, told: str) -> str:
    """A line of a page that shows a file of docs/media."""
    return f"![{told}]({Path(os.path.relpath(MEDIA / name, PAGES)).as_posix()})"


def replaced(page: str, title: str, text: str) -> str:
    """The page with the printed part of a section replaced; prose before it stays, a new section comes last."""
    begin, end = f"<!-- {title}: printed -->", f"<!-- {title}: end -->"
    section = f"{begin}\n\n{text}\n\n{end}"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if pattern.search(page):
        return pattern.sub(lambda _: section, page)
    return f"{page.rstrip()}\n\n## {title}\n\n{section}\n"


def write_section(path: Path, heading: str, title: str, text: str) -> None:
    """Replace a section of a page; `heading` is that of a page that is not there yet."""
    page = path.read_text() if path.exists() else f"# {heading}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(replaced(page, title, text.strip()))


class _Tee(io.StringIO):
    """Keeps the text, and shows it at once."""

    def __init__(self):
        super().__init__()
        self._shown = sys.stdout

    def write(self, text: str) -> int:
        self._shown.write(text)
        self._shown.flush()
        return super().write(text)


@contextlib.contextmanager
def kept() -> Iterator[io.StringIO]:
    """Inside, printed text is shown and kept."""
    with contextlib.redirect_stdout(_Tee()) as text:
        yield text
