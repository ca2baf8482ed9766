"""Arrays, tables and figures on disk: `.npy`, `.npz`, `.csv`, `.parquet`, and figures of matplotlib."""

from __future__ import annotations

import csv
import io
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from pigjax.core.errors import InputError
from pigjax.io.files import PathLike, decoding, existing, writing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Columns = Mapping[str, Shaped[np.ndarray, "n"]]
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # how a text begins that a spreadsheet would compute


class ArrayHeader(NamedTuple):
    """Shape and type of an array, read before the array itself."""

    shape: tuple[int, ...]
    dtype: np.dtype


def save_arrays(path: PathLike, arrays: Mapping[str, Any], *, compress: bool = True) -> None:
    """Write named arrays as a `.npz` that `numpy.load` reads, whole or not at all. Host.

    Args:
        path: of the file.
        arrays: of numbers, truth values or texts, of any shape, by any names.
        compress: smaller files; off where they are written often.

    Raises:
        InputError: an array holds Python objects, or the file cannot be written.
    """
    room = io.BytesIO()  # a disk that fills up meets one write of bytes
    with zipfile.ZipFile(room, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                try:
                    np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)
                except ValueError:
                    raise InputError(
                        f"{path}: array {name!r} holds Python objects; give numbers, truth values or texts."
                    ) from None
    with writing(path) as partial:
        partial.write_bytes(room.getbuffer())


def load_arrays(
    path: PathLike,
    what: str,
    *,
    remedy: str,
    check: Callable[[Mapping[str, ArrayHeader]], None] | None = None,
    prefixes: tuple[str, ...] = ("",),
) -> dict[str, np.ndarray]:
    """Arrays of a `.npz` by name. Nothing in the file is run, and no memory is asked for that the file does not fill.

    Args:
        path: of the file.
        what: the kind of file, for messages: "table".
        remedy: advice to the reader of a message.
        check: told {name: ArrayHeader} before any array is read; its exceptions are passed on.
        prefixes: arrays whose names begin with none of these are not read.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, holds Python objects, or `check` refuses it.
    """
    path = existing(path, what)
    with decoding(path, what, remedy=remedy), zipfile.ZipFile(path) as archive:
        headers = {info.filename.removesuffix(".npy"): _header(archive, info) for info in archive.infolist()}
        if len(headers) < len(archive.infolist()):
            raise ValueError("two of its arrays have one name")
        if check is not None:
            check(headers)
        arrays = {}
        for info in archive.infolist():
            if not info.filename.startswith(prefixes):
                continue
            with archive.open(info) as file:
                arrays[info.filename.removesuffix(".npy")] = np.lib.format.read_array(file, allow_pickle=False)
                file.read()  # to the end, where the checksum is compared
        return arrays


def load_array(
    path: PathLike,
    what: str,
    *,
    remedy: str = "save it again",
    check: Callable[[ArrayHeader], None] = lambda header: None,
) -> np.ndarray:
    """The array of a `.npy`; no memory is asked for that the file does not fill.

    Args:
        path: of the file.
        what: the kind of file, for messages.
        remedy: what the reader of a message can do.
        check: told shape and type before the array is read; its exceptions come through.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, holds Python objects, or `check` refuses it.
    """
    path = existing(path, what)
    with decoding(path, what, remedy=remedy), path.open("rb") as file:
        check(read_header(file, path.stat().st_size))
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


def write_csv(path: PathLike, columns: Columns) -> None:
    """Write columns under their names as CSV in UTF-8. Host.

    A text that a spreadsheet would take for a formula is led by an apostrophe.

    Raises:
        InputError: the file cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([_no_formula(name) for name in columns])
    writer.writerows(zip(*([_no_formula(value) for value in column.tolist()] for column in columns.values())))
    with writing(path) as partial:
        partial.write_bytes(text.getvalue().encode(errors="replace"))


def write_parquet(path: PathLike, columns: Columns) -> None:
    """Write columns under their names as Parquet. Host.

    Raises:
        InputError: pyarrow is missing, or the file cannot be written.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InputError("Parquet needs pyarrow: pip install 'pigjax[tables]', or save as .csv or .npz.") from None
    with writing(path) as partial:
        pyarrow.parquet.write_table(pyarrow.table(dict(columns)), partial)


def save_figure(path: PathLike, figure: Figure, *, dpi: int = 120) -> None:
    """Write a figure of matplotlib; the suffix picks the format.

    Args:
        path: of the picture.
        figure: drawn already.
        dpi: pixels per inch of the figure's size; 120 makes a plot of 5 inches 600 px wide.

    Raises:
        InputError: the suffix names no format, or the file cannot be written.
    """
    formats = figure.canvas.get_supported_filetypes()
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in formats:
        raise InputError(f"{path}: unknown suffix of a picture; use .png, .svg or .pdf.")
    with writing(path) as partial:
        figure.savefig(partial, dpi=dpi, format=suffix)


def plain_label(text: str) -> str:
    """A text as matplotlib draws it literally: dollar signs would begin mathematics."""
    return "".join(letter if letter.isprintable() else " " for letter in text).replace("$", r"\$")


def _header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> ArrayHeader:
    with archive.open(info) as file:
        return read_header(file, info.file_size)


def read_header(file: Any, size: int) -> ArrayHeader:
    """Shape and type of the array in NumPy's format that begins here in a file of a size [bytes], which is read on.

    Raises:
        ValueError: there is none, it holds Python objects, or the file has no room for it.
    """
    try:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = _HEADERS[version](file)
    except OSError:
        raise
    except Exception as error:  # NumPy reads it as Python code, and answers in the words of a tokenizer
        raise ValueError("the header of an array is damaged") from error
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    if any(extent < 0 for extent in shape):
        raise ValueError(f"shape {shape}")
    if (wanted := math.prod(shape) * dtype.itemsize) > (left := size - file.tell()):
        raise ValueError(f"the header of an array tells of {wanted} bytes, and {left} follow")
    return ArrayHeader(shape, dtype)


_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def _no_formula(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
