"""The table of vertices of a PLY file: header and sizes are checked against the file before memory is asked for."""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, decoding, existing, reason_of

_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_ALIASES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES = {name: code for names in (_NAMES, _ALIASES) for name, code in zip(names, _CODES)}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_STRUCT = dict(zip(_CODES, "bBhHiIfd"))
_LONGEST_HEADER = 1 << 20  # [bytes]
_MOST_ROWS = 1 << 48  # of an element without properties, whose rows take no room


@dataclass(frozen=True)
class Property:
    """A column of an element."""

    name: str
    code: str  # of NumPy, without byte order: "f4"
    length: str | None = None  # code of the list's length; None: one value a row

    @property
    def size(self) -> int:
        """Least number of bytes of a row."""
        return np.dtype(self.length or self.code).itemsize


@dataclass(frozen=True)
class Element:
    """A table of the file, as its header says."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in size."""
        return any(column.length for column in self.properties)

    @property
    def row_size(self) -> int:
        """Least number of bytes of a binary row."""
        return sum(column.size for column in self.properties)


@dataclass(frozen=True)
class Header:
    """Header of a PLY file."""

    kind: str  # "ascii", "binary_little_endian" or "binary_big_endian"
    elements: tuple[Element, ...]
    end: int  # where the data begins [bytes]

    def find(self, name: str) -> Element | None:
        """The element of that name."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(path: PathLike) -> Header:
    """The header of a PLY file; comments may be in any encoding. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: not a PLY file, a property occurs twice, or the data is shorter than the header says.
    """
    path = existing(path, "PLY file")
    with decoding(path, "PLY file", remedy="give a PLY file you may read"):
        size = path.stat().st_size
        with path.open("rb") as file:
            start = file.read(_LONGEST_HEADER)
    opening = re.match(rb"ply[ \t]*(\r\n|\n|\r)", start)
    if opening is None:
        raise _no_ply(path, "it does not begin with 'ply'")
    newline = opening[1]
    end_line = re.compile(newline + rb"[ \t]*end_header[ \t]*" + newline)
    closing = end_line.search(start, opening.end() - len(newline))
    if closing is None:
        raise _no_ply(path, "its header has no end")
    lines = start[opening.end() : closing.start()].split(newline)
    header = _parsed(path, [line.decode("utf-8", "replace").split() for line in lines], closing.end())
    _check_sizes(path, header, size - header.end)
    return header


def read_vertices(path: PathLike) -> tuple[dict[str, np.ndarray], Header]:
    """Columns of the element `vertex` in the types that the file says, without its lists, and the header. Host.

    Raises:
        MissingFileError: there is no such file.
        InputError: not a PLY file, truncated, or without vertices.
    """
    path = Path(path)
    header = read_header(path)
    if header.find("vertex") is None:
        raise InputError(f"{path}: has no element 'vertex'; give a .ply of Gaussians or points.")
    try:
        if header.kind == "ascii":
            return _text_vertices(path, header), header
        return _binary_vertices(path, header), header
    except (ValueError, IndexError, OverflowError, struct.error, StopIteration, MemoryError) as error:
        raise InputError(
            f"{path}: the PLY file is truncated or damaged ({reason_of(error)}); copy or export it again."
        ) from error


def _parsed(path: PathLike, lines: list[list[str]], end: int) -> Header:
    kind, elements = None, list[tuple[str, int, list[Property]]]()
    for words in lines:
        match words:
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case ["format", str(given), "1.0"] if given in _ORDERS and kind is None:
                kind = given
            case ["element", name, count] if kind and re.fullmatch(r"\d{1,18}", count):
                elements.append((name, int(count), []))
            case ["property", "list", length, code, name] if elements and length in _TYPES and code in _TYPES:
                elements[-1][2].append(Property(name, _TYPES[code], _TYPES[length]))
            case ["property", code, name] if elements and code in _TYPES:
                elements[-1][2].append(Property(name, _TYPES[code]))
            case _:
                raise _no_ply(path, f"its header has a line {' '.join(words)[:80]!r}")
    if kind is None:
        raise _no_ply(path, "its header has no line 'format'")
    for name, _, properties in elements:
        names = [column.name for column in properties]
        twice = next((column for column in names if names.count(column) > 1), None)
        if twice is not None:
            raise InputError(f"{path}: element '{name}' has property '{twice}' twice; export it with one of them.")
    if len({name for name, *_ in elements}) < len(elements):
        raise _no_ply(path, "two elements have one name")
    return Header(kind, tuple(Element(name, count, tuple(columns)) for name, count, columns in elements), end)


def _no_ply(path: PathLike, reason: str) -> InputError:
    return InputError(f"{path}: not a PLY file ({reason}); give a .ply of Gaussians or points.")


def _check_sizes(path: PathLike, header: Header, room: int) -> None:
    """Refuse counts that the file has no room for."""
    for element in header.elements:
        # a number and what parts it from the next take two bytes; the last line may lack its end
        row = 2 * len(element.properties) if header.kind == "ascii" else element.row_size
        needed = element.count * row - (header.kind == "ascii")
        if needed > room or (row == 0 and element.count > _MOST_ROWS):
            raise InputError(
                f"{path}: the PLY file is truncated or damaged (element '{element.name}' has {element.count} rows of"
                f" at least {row} bytes, and {room} bytes are left); copy or export it again."
            )
        room -= max(needed, 0)


def _binary_vertices(path: Path, header: Header) -> dict[str, np.ndarray]:
    order, at = _ORDERS[header.kind], header.end
    for element in header.elements:
        last = element.name == "vertex"
        if element.has_lists:
            columns, at = _walk(path.read_bytes(), at, element, order)
        elif last:
            layout = np.dtype([(column.name, order + column.code) for column in element.properties])
            with path.open("rb") as file:
                file.seek(at)
                rows = np.fromfile(file, layout, element.count) if layout.itemsize else np.zeros(0, layout)
            columns = {column.name: rows[column.name] for column in element.properties}
            if len(rows) < element.count and layout.itemsize:
                raise ValueError(f"it ends in row {len(rows)} of {element.count}")
            at += rows.nbytes
        else:
            at += element.count * element.row_size
        if last:
            break
    if element is header.elements[-1] and path.stat().st_size - at >= max(element.row_size, 4):
        _warn_of_rest(path, f"{path.stat().st_size - at} bytes")
    return columns


def _walk(data: bytes, at: int, element: Element, order: str) -> tuple[dict[str, np.ndarray], int]:
    """Rows of different sizes, one after the other."""
    single = [column for column in element.properties if column.length is None]
    values: dict[str, list[float]] = {column.name: [] for column in single}
    for _ in range(element.count):
        for column in element.properties:
            (value,) = struct.unpack_from(order + _STRUCT[column.length or column.code], data, at)
            at += column.size
            if column.length is None:
                values[column.name].append(value)
            elif not 0 <= value <= len(data) or value != int(value):
                raise ValueError(f"a list of {value} values in '{column.name}'")
            else:
                at += int(value) * np.dtype(column.code).itemsize
        if at > len(data):
            raise ValueError(f"it ends within element '{element.name}'")
    return {column.name: np.asarray(values[column.name], column.code) for column in single}, at


def _text_vertices(path: Path, header: Header) -> dict[str, np.ndarray]:
    with path.open("rb") as file:
        file.seek(header.end)
        lines = iter([line for line in file.read().decode("latin-1").splitlines() if line.strip()])
    for element in header.elements:
        rows = _take(lines, element)
        if element.name != "vertex":
            continue
        if element is header.elements[-1] and (rest := sum(1 for _ in lines)):
            _warn_of_rest(path, f"{rest} lines")
        if element.has_lists:
            table = np.array([_without_lists(row.split(), element) for row in rows], np.float64)
        else:
            table = np.loadtxt(rows, np.float64, comments=None, ndmin=2) if rows else np.zeros((0, 0))
        single = [column for column in element.properties if column.length is None]
        if not rows:
            return {column.name: np.zeros(0, column.code) for column in single}
        if table.shape != (element.count, len(single)):
            raise ValueError(f"rows hold {table.shape[1]} numbers where the header has {len(single)} properties")
        return {column.name: _of_type(values, column) for column, values in zip(single, table.T)}
    raise AssertionError


def _take(lines: Iterator[str], element: Element) -> list[str]:
    if not element.properties:
        return []
    rows = [line for line, _ in zip(lines, range(element.count))] if element.count else []
    if len(rows) < element.count:
        raise ValueError(f"element '{element.name}' ends in row {len(rows)} of {element.count}")
    return rows


def _without_lists(words: list[str], element: Element) -> list[float]:
    values, at = [], 0
    for column in element.properties:
        if column.length is None:
            values.append(float(words[at]))
            at += 1
        else:
            at += 1 + int(words[at])
    if at != len(words):
        raise ValueError(f"a row holds {len(words)} numbers, not {at}")
    return values


def _of_type(values: np.ndarray, column: Property) -> np.ndarray:
    if column.code[0] != "f":
        limits = np.iinfo(column.code)
        if not np.all((values >= limits.min) & (values <= limits.max) & (values == np.floor(values))):
            raise ValueError(f"property '{column.name}' holds what is no {column.code}")
        return values.astype(column.code)
    return values  # as doubles: the text may say more digits than the type that the header names


def _warn_of_rest(path: Path, rest: str) -> None:
    warnings.warn(
        f"{path}: {rest} after the last row that its header counts were left out; is the header's count right?",
        stacklevel=5,
    )
