"""Griffe extension: a field's comment in the source is its text in the API reference.

Fields of pytrees bear their unit and meaning in a comment, beside them or on the lines above, so that the code reads
in one place. Griffe shows docstrings only; here comments become the docstrings of fields that have none.
"""

from __future__ import annotations

from typing import Any

try:
    from griffe import Docstring, Extension
except ImportError:  # tests read comments by `comment_of` without the extra `docs`
    Docstring, Extension = None, object


class FieldComments(Extension):
    """Gives fields of classes their comments."""

    def on_class(self, *, cls: Any, **kwargs: Any) -> None:
        """Called by Griffe for a class whose members are known."""
        known = cls.filepath in cls.lines_collection
        lines = cls.lines_collection[cls.filepath] if known else []
        for field in cls.attributes.values():
            if field.docstring is None and 0 < (field.lineno or 0) <= len(lines):  # builtins have no source
                text = comment_of(lines, field.lineno, field.endlineno or field.lineno)
                field.docstring = Docstring(text, parent=field) if text else None


def comment_of(lines: list[str], first: int, last: int) -> str:
    """Comment at the end of a statement on lines `first` to `last`, counted from 1, after those on the lines above."""
    found = []
    above = first - 2
    while above >= 0 and lines[above].lstrip().startswith("#"):
        found.insert(0, lines[above].strip().lstrip("# "))
        above -= 1
    found += [text.partition("  # ")[2].strip() for text in lines[first - 1 : last] if "  # " in text]
    return " ".join(text for text in found if text)
