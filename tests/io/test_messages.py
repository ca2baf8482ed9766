"""Damage is told in plain words of the file: none of Python's settings, tokenizers, classes or addresses."""

import hashlib
import io as memory
import json
import re
import zipfile

import numpy as np
import pytest

from pigjax import io
from pigjax.core.errors import InputError
from pigjax.io.datasets import load_names
from pigjax.scene import load_scene
from pigjax.study.optimize import load_table

DIGITS = "9" * 5000
OF_PYTHON = r"set_int_max|<ast|tokenize|\(\('|codec|unpack_from|recursion|unhashable|pickle|literal|NUMPY|object at"


def with_header(text):
    """A `.npy` with this in place of its header."""
    header = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(100)


def archive(header):
    room = memory.BytesIO()
    with zipfile.ZipFile(room, "w") as file:
        file.writestr("object_id.npy", with_header(header))
    return room.getvalue()


def masks(path):
    return io.load_masks(path.parent, [path.stem], (8, 6))


SOUND = "{'descr': '<i4', 'fortran_order': False, 'shape': (6, 8), }"  # but no array follows
BROKEN_HEADERS = [
    "{'descr': '<i4', 'shape': (6, 8",
    "{'descr': x, 'fortran_order': False, 'shape': (6, 8), }",
    "(",
    "'''",
]
DAMAGE = {
    "digits of JSON": ("a.json", f"[{DIGITS}]".encode(), io.read_json, "a number has more than"),
    "digits of TOML": ("a.toml", f"x = {DIGITS}".encode(), load_scene, "a number has more than"),
    "depth of JSON": ("a.json", b"[" * 100_000, io.read_json, "nested too deeply"),
    "bytes of JSON": ("a.json", b'{"a": "\xff"}', io.read_json, "byte 7 is not UTF-8"),
    "count of COLMAP": ("points3D.txt", b"1 2 3\n", io.load_points, "not enough parts"),
    "word of COLMAP": ("points3D.txt", b"1 x 2 3 4 5 6 7\n", io.load_points, "'x' is no number"),
    "end of COLMAP": ("points3D.bin", b"\x01" + bytes(30), io.load_points, "it ends too early"),
    "objects": ("v.npy", with_header(SOUND.replace("<i4", "|O")), masks, "it holds Python objects"),
    "size of a mask": ("v.npy", with_header(SOUND), masks, "tells of 192 bytes, and 100 follow"),
    **{f"mask {text}": ("v.npy", with_header(text), masks, "header of an array is damaged") for text in BROKEN_HEADERS},
    **{f"labels {t}": ("a.npz", archive(t), io.load_labels, "header of an array is damaged") for t in BROKEN_HEADERS},
    "table": ("a.npz", archive("("), load_table, "header of an array is damaged"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "content", "read", "said"), DAMAGE.values(), ids=DAMAGE)
def test_damage_is_told_in_words_of_the_file(tmp_path, name, content, read, said):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert message.endswith(".")
    assert ";" in message
    assert not re.search(OF_PYTHON, message)
    assert len(message) < 300


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (10**12,), }", "header of an array is damaged"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }", "tells of 4000000000000 bytes, and"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (3,), }", r"float32 \(3,\) in place of float32 \(4,\)"),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (4,), }", "holds Python objects"),
    ],
)
def test_a_checkpoint_whose_checksum_fits_asks_for_no_memory_that_it_does_not_fill(tmp_path, header, said):
    path, payload = tmp_path / "a.ckpt", with_header(header)
    known = hashlib.sha256(b"[]" + payload).hexdigest()
    path.write_bytes(json.dumps({"sha256": known, "parts": {}}).encode() + b"\n" + payload)
    with pytest.raises(InputError, match=rf"a\.ckpt: not a readable checkpoint \(.*{said}.*\); use the settings"):
        io.load_pytree(path, np.zeros(4, np.float32))


EYE = np.eye(4).tolist()
CAMERAS = {"fl_x": 10.0, "fl_y": 10.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}
RUNS = {"size": [6, 8], "counts": [48]}


@pytest.mark.parametrize("code", [0xD800, 0xDCFF])
@pytest.mark.parametrize(
    ("content", "read"),
    [
        (lambda half: {"1": half}, load_names),
        (lambda half: {half: {"1": RUNS}}, lambda path: io.load_masks(path, ["v"], (8, 6))),
        (lambda half: {"images": [{"id": 1, "file_name": half}], "annotations": []},
         lambda path: io.load_masks(path, ["v"], (8, 6))),
        (lambda half: CAMERAS | {"frames": [{"file_path": half, "transform_matrix": EYE}]}, io.load_cameras),
    ],
)  # fmt: skip
def test_names_with_half_a_character_are_refused(tmp_path, content, read, code):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content(chr(code))))
    with pytest.raises(InputError, match=r"a\.json: .*a text holds \\ud(800|cff), half of a character") as caught:
        read(path)
    str(caught.value).encode()


def test_names_with_both_halves_are_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"1": "\\ud83d\\ude00 \\\\ud800"}')
    assert load_names(path) == {1: "\U0001f600 \\ud800"}
