"""Damage to files: to bytes, to numbers in text, and to the structure of JSON, TOML, NumPy arrays and images."""

import gzip
import hashlib
import io
import json
import re
import struct
import tomllib
import zipfile
import zlib

import numpy as np
import tomli_w

_NUMBER = re.compile(rb"(?<![A-Za-z_.\d])-?\d+(\.\d+)?([eE][-+]?\d+)?")
_TEXTS = [b"nan", b"inf", b"-inf", b"-1", b"0", b"1e30", b"1e400", b"99999999999999999999", b"2147483648", b"1.5", b"x"]
_TEXTS += [b"9" * 5000, b"1000000000000", b"true", b'"a"', b"", b"-0.0", b"4294967295", b"[]"]
_VALUES = [None, True, -1, 0, 1.5, 1e30, 2**31, 2**63, -(2**63), 10**12, "a", "", "../../x", [], {}, [[]], [None]]
_VALUES += [{"a": 1}, float("nan"), float("inf"), [0, 0], "nan", ["a", 1, None], 65536, "\x00", "[/x]"]
_WIDE = [b"\xff" * 4, b"\x00" * 4, b"\xff" * 8, b"\xff\xff\xff\x7f", b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f"]
_WIDE += [b"\x00" * 8]


def damaged(name, data, rng, others):
    """Bytes of the file after one or two changes; None: a folder takes its place."""
    if rng.random() < 0.01:
        return None
    for _ in range(1 if rng.random() < 0.8 else 2):
        kinds = [_bytes]
        if _NUMBER.search(data[:4096]):
            kinds.append(_number)
        kinds += [change for suffix, change in _BY_SUFFIX.items() if name.endswith(suffix) for _ in range(2)]
        if rng.random() < 0.03:
            data = others[rng.integers(len(others))]
            continue
        try:
            data = kinds[rng.integers(len(kinds))](data, rng)
        except Exception:  # damage of the first round may leave nothing to change
            data = _bytes(data, rng)
    return data


def _bytes(data, rng):
    data, at = bytearray(data), int(rng.integers(max(len(data), 1)))
    wide = _WIDE[rng.integers(len(_WIDE))]
    match int(rng.integers(9)):
        case 0 | 1 if data:
            for spot in rng.integers(min(len(data), 10**6), size=rng.integers(1, 9)):
                data[spot] ^= 1 << int(rng.integers(8))
        case 2:
            del data[at:]
        case 3:
            data[at:at] = rng.bytes(int(rng.integers(1, 40)))
        case 4:
            del data[at : at + int(rng.integers(1, 40))]
        case 5:
            at -= at % 4
            data[at : at + len(wide)] = wide
        case 6:  # where headers are
            at = int(rng.integers(min(len(data), 64) + 1))
            data[at : at + len(wide)] = wide
        case 7:
            data += data[at : at + int(rng.integers(1, 200))]
        case _:
            data = bytearray(
                [b"", rng.bytes(100), b"\x00" * 64, b"[" * 100_000, b"\xef\xbb\xbf" + data][rng.integers(5)]
            )
    return bytes(data)


def _number(data, rng):
    """Another number in the text of the file, or of its header."""
    end = data.find(b"end_header")
    found = list(_NUMBER.finditer(data[: end if end > 0 else 1 << 16]))
    one = found[rng.integers(len(found))]
    return data[: one.start()] + _TEXTS[rng.integers(len(_TEXTS))] + data[one.end() :]


def _restructured(content, rng):
    """One value somewhere inside replaced, removed, wrapped or nested deeply."""
    places = []

    def walk(node):
        keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            places.append((node, key))
            walk(node[key])

    holder = [content]
    walk(holder)
    node, key = places[rng.integers(len(places))]
    value = node[key]
    match int(rng.integers(8)):
        case 0:
            del node[key]
        case 1:
            node[key] = [value]
        case 2:
            node[key] = {"a": value}
        case 3 if isinstance(node, dict):
            node[f"{key}x"] = node.pop(key)
        case 4 if isinstance(value, list) and value:
            node[key] = value * 3 if rng.random() < 0.5 else value[:-1]
        case 5:
            other, where = places[rng.integers(len(places))]
            node[key] = json.loads(json.dumps(other[where]))
        case _:
            node[key] = _VALUES[rng.integers(len(_VALUES))]
    return holder[0] if holder else {}


def _json(data, rng):
    content = json.loads(data.decode("utf-8-sig"))
    if rng.random() < 0.05:
        deep = 100_000
        return b'{"a":' * deep + b"1" + b"}" * deep
    return json.dumps(_restructured(content, rng)).encode()


def _toml(data, rng):
    if rng.random() < 0.05:
        return data + b"\nx = " + b"[" * 2000 + b"]" * 2000
    return tomli_w.dumps(_restructured(tomllib.loads(data.decode()), rng)).encode()


def _array_bytes(values, rng):
    """A `.npy` whose header may lie."""
    file = io.BytesIO()
    np.save(file, values, allow_pickle=True)
    data = file.getvalue()
    if rng.random() < 0.4:
        shape = ["(1000000000000,)", "(99999999999999999999999,)", "(-1,)", "()", "(2,", "(1,2,3,4)", "'''"][
            rng.integers(7)
        ]
        kind = [values.dtype.str, "|O", "<U4", "<M8[s]", "<f2", ">i8", "nonsense"][rng.integers(7)]
        header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
        data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + values.tobytes()[:4096]
    return data


def _changed_array(values, rng):
    flat = values.reshape(-1)
    match int(rng.integers(8)):
        case 0:
            return flat
        case 1:
            return values[None]
        case 2:
            return values[:-1] if values.ndim else values
        case 3:
            return values.astype(["f8", "i1", "u8", "U5", "?", "c8", "f2"][rng.integers(7)])
        case 4:
            return np.array([{"a": 1}], dtype=object)
        case 5:
            return np.zeros((0, *values.shape[1:]), values.dtype)
        case 6 if values.size and values.dtype.kind == "f":
            values = values.copy()
            values.reshape(-1)[rng.integers(values.size)] = [np.nan, np.inf, -1, 1e30][rng.integers(4)]
            return values
        case 7 if values.size and values.dtype.kind in "iu":
            values = values.copy()
            limits = np.iinfo(values.dtype)
            values.reshape(-1)[rng.integers(values.size)] = [limits.min, limits.max, limits.max // 2][rng.integers(3)]
            return values
    return np.array(["text"])


def _npy(data, rng):
    values = np.load(io.BytesIO(data), allow_pickle=False)
    return _array_bytes(_changed_array(values, rng) if rng.random() < 0.6 else values, rng)


def _npz(data, rng):
    if rng.random() < 0.1:
        file = io.BytesIO()
        np.save(file, np.arange(5))
        return file.getvalue()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[rng.integers(len(members))]
    match int(rng.integers(6)):
        case 0:
            del members[name]
        case 1:
            members[["x.npy", f"../{name}", name[:-4], "index.npy"][rng.integers(4)]] = members.pop(name)
        case 2:
            members[name] = _bytes(members[name], rng)
        case _:
            members[name] = _npy(members[name], rng)
    file = io.BytesIO()
    with zipfile.ZipFile(
        file, "w", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2][rng.integers(3)]
    ) as out:
        for name, content in members.items():
            out.writestr(name, content)
    return file.getvalue()


def _checkpoint(data, rng):
    """Another content below a checksum that fits it, which only readers of the content can refuse."""
    head, _, payload = data.partition(b"\n")
    parts = json.loads(head)["parts"]
    if rng.random() < 0.2:
        parts = _restructured({"parts": parts}, rng)
    else:
        payload = _bytes(payload, rng) if rng.random() < 0.7 else _number(payload, rng)
    known = sorted(parts.items()) if isinstance(parts, dict) else []
    sha256 = hashlib.sha256(json.dumps(known).encode() + payload).hexdigest()
    return json.dumps({"sha256": sha256, "parts": parts}).encode() + b"\n" + payload


def _gzipped(data, rng):
    if data[:2] != b"\x1f\x8b":
        return _bytes(data, rng)
    return gzip.compress(_bytes(gzip.decompress(data), rng), 1)


def _png(data, rng):
    """Another size, depth or kind in the first chunk, with its checksum."""
    header = bytearray(data[12:29])
    at = int(rng.integers(4, 17))
    if at < 12:
        at -= at % 4
        header[at : at + 4] = struct.pack(">I", [0, 1, 2**31 - 1, 60_000, 2**31][rng.integers(5)])
    else:
        header[at] = int(rng.integers(256))
    return data[:12] + bytes(header) + struct.pack(">I", zlib.crc32(header)) + data[33:]


def _ply(data, rng):
    """A line of the header changed, doubled, removed or of lists."""
    end = data.find(b"end_header")
    lines = data[:end].split(b"\n")
    at = int(rng.integers(1, len(lines)))
    match int(rng.integers(6)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[at])
        case 2:
            lines[at] = lines[at].replace(b"property float", b"property list uchar float")
        case 3:
            kind = [b"double", b"uchar", b"int", b"float64", b"list"][rng.integers(5)]
            lines[at] = re.sub(rb"property \w+", b"property " + kind, lines[at])
        case 4:
            lines.insert(at, ["comment Ä ж", "obj_info \xff", "element face 7", "property float x", "format ascii 1.0"][
                rng.integers(5)].encode("latin-1", "replace"))  # fmt: skip
        case _:
            kinds = [b"ascii", b"binary_little_endian", b"binary_big_endian"]
            lines[1] = b"format " + kinds[rng.integers(3)] + b" 1.0"
    return b"\n".join(lines) + data[end:]


_BY_SUFFIX = {
    ".json": _json, ".toml": _toml, ".npy": _npy, ".npz": _npz, ".spz": _gzipped, ".png": _png, ".ply": _ply,
    ".ckpt": _checkpoint,
}  # fmt: skip
