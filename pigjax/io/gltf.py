"""glTF 2.0 in its binary form (`.glb`): Gaussians by the extension KHR_gaussian_splatting, and meshes.

A file holds one JSON header and one block of numbers. Files of others are read as far as the ratified extension goes:
primitives of points under nodes with any similarity; scales are linear and not negative, opacities in 0..1, and
quaternions in the order x, y, z, w.
"""

from __future__ import annotations

import json
import struct
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from pigjax.core.arguments import checked
from pigjax.core.errors import InputError
from pigjax.core.gaussians import SH_CONSTANT, Gaussians, Splats
from pigjax.core.harmonics import sh_degree_of
from pigjax.core.placing import as_gaussians
from pigjax.io.files import PathLike, decoding, existing, writing
from pigjax.io.origin import Origin, checked_origin
from pigjax.io.ply import fields_of

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BINARY = b"glTF", 0x4E4F534A, 0x004E4942
_POINTS, _ARRAY_BUFFER, _ELEMENT_BUFFER = 0, 34962, 34963
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_CODES = {np.dtype(name): code for code, name in _COMPONENTS.items()}
_FULL = {"i1": 127.0, "u1": 255.0, "<i2": 32767.0, "<u2": 65535.0}  # what stands for 1 in normalized numbers
_LEAST_SCALE, _LEAST_OPACITY = 1e-30, 1e-37  # stand for zero, whose logarithms are not finite
_MOST_NODES = 100_000
_REMEDY = "export it again, uncompressed, as one .glb"


class Mesh(NamedTuple):
    """A triangle mesh by its name."""

    vertices: Float[np.ndarray, "v 3"]  # [m]
    faces: Int[np.ndarray, "f 3"]  # indices of the corners, counter-clockwise seen from outside
    colour: tuple[float, float, float] = (0.7, 0.7, 0.7)  # linear RGB in 0..1


@checked
def save_glb(path: PathLike, gaussians: Gaussians | Splats, *, origin: Origin | None = None) -> None:
    """Write Gaussians or posed splats as `.glb` with KHR_gaussian_splatting (Khronos 2026), in float32. Host.

    Colours are those of training, `srgb_rec709_display`; programs that do not know the extension show coloured points.
    glTF's y axis points up: turn a scene with z up by `placed` first.

    Args:
        path: the file.
        gaussians: the scene, or splats that are posed; positions in m.
        origin: offset that `load_gaussians` subtracted [m]; it becomes the place of the node that holds the splats.

    Raises:
        InputError: the file cannot be written, or `origin` is no point.
    """
    place = None if origin is None else checked_origin(origin)
    gaussians = as_gaussians(gaussians)
    sh = np.asarray(gaussians.sh, np.float32)
    opacities = _sigmoid(np.asarray(gaussians.logit_opacities, np.float64))
    quats = np.asarray(gaussians.quats, np.float64)
    quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    rgba = np.concatenate([sh[:, 0] * SH_CONSTANT + 0.5, opacities[:, None]], 1)
    file = _Writer()
    columns = {
        "POSITION": np.asarray(gaussians.means, np.float32),
        "COLOR_0": np.round(np.clip(rgba, 0, 1) * 255).astype(np.uint8),
        f"{EXTENSION}:SCALE": np.exp(np.asarray(gaussians.log_scales, np.float64)).astype(np.float32),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]].astype(np.float32),
        f"{EXTENSION}:OPACITY": opacities.astype(np.float32),
    }
    columns |= {
        _coefficient(degree, order): sh[:, degree**2 + order]
        for degree in range(sh_degree_of(gaussians) + 1)
        for order in range(2 * degree + 1)
    }
    attributes = {name: file.accessor(values, bounds=name == "POSITION") for name, values in columns.items()}
    kernel = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: kernel}}
    file.add("gaussians", {"primitives": [primitive]}, place)
    file.save(path, extensions=[EXTENSION])


def _coefficient(degree: int, order: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"


@checked
def save_mesh(path: PathLike, meshes: Mapping[str, Mesh]) -> None:
    """Write triangle meshes by their names to `.obj` or `.glb`. Host.

    Args:
        path: the file; the suffix picks the format.
        meshes: `Mesh` by name; vertices in m.

    Raises:
        InputError: another suffix, no meshes, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".obj", ".glb"):
        raise InputError(f"{path}: unknown suffix of a mesh {suffix!r}; use .obj or .glb.")
    if not meshes:
        raise InputError(f"{path}: there are no meshes to write; give one.")
    if suffix == ".obj":
        _save_obj(path, meshes)
        return
    file = _Writer()
    for name, mesh in meshes.items():
        material = {"pbrMetallicRoughness": {"baseColorFactor": [*map(float, mesh.colour), 1.0], "metallicFactor": 0.0}}
        primitive = {
            "attributes": {"POSITION": file.accessor(np.asarray(mesh.vertices, np.float32), bounds=True)},
            "indices": file.accessor(np.asarray(mesh.faces, np.uint32).reshape(-1), target=_ELEMENT_BUFFER),
            "material": file.material({**material, "doubleSided": True}),
        }
        file.add(name, {"primitives": [primitive]})
    file.save(path)


def _save_obj(path: PathLike, meshes: Mapping[str, Mesh]) -> None:
    lines, first = [], 1
    for name, mesh in meshes.items():
        lines.append("o " + " ".join(name.split()))
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(mesh.vertices, np.float64).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(mesh.faces, int) + first).tolist()]
        first += len(mesh.vertices)
    with writing(path) as partial:
        partial.write_bytes(("\n".join(lines) + "\n").encode(errors="replace"))


class _Writer:
    """Numbers and their description, gathered until the file is whole."""

    def __init__(self) -> None:
        self.blocks: list[bytes] = []
        self.size = 0
        self.told: dict[str, list[Any]] = {
            name: [] for name in ("nodes", "meshes", "materials", "accessors", "bufferViews")
        }

    def accessor(self, values: np.ndarray, *, bounds: bool = False, target: int = _ARRAY_BUFFER) -> int:
        """Number of the accessor of an array [n] or [n, k]; `bounds`: with least and largest, as positions need."""
        data = np.ascontiguousarray(values).tobytes()
        self.told["bufferViews"].append(
            {"buffer": 0, "byteOffset": self.size, "byteLength": len(data), "target": target}
        )
        data += bytes(-len(data) % 4)
        self.blocks.append(data)
        self.size += len(data)
        kind = next(name for name, width in _TYPES.items() if width == (values.shape[1] if values.ndim > 1 else 1))
        told: dict[str, Any] = {"bufferView": len(self.told["bufferViews"]) - 1, "count": len(values), "type": kind}
        told["componentType"] = _CODES[values.dtype]
        if values.dtype == np.uint8:
            told["normalized"] = True
        if bounds:
            told |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.told["accessors"].append(told)
        return len(self.told["accessors"]) - 1

    def material(self, material: dict[str, Any]) -> int:
        """Number of a material."""
        self.told["materials"].append(material)
        return len(self.told["materials"]) - 1

    def add(self, name: str, mesh: dict[str, Any], place: np.ndarray | None = None) -> None:
        """Add a mesh in a node of its own, at a place [m]."""
        self.told["meshes"].append({"name": name, **mesh})
        node: dict[str, Any] = {"name": name, "mesh": len(self.told["meshes"]) - 1}
        self.told["nodes"].append(node if place is None else {**node, "translation": place.tolist()})

    def save(self, path: PathLike, *, extensions: Sequence[str] = ()) -> None:
        """Write the file."""
        head: dict[str, Any] = {"asset": {"version": "2.0", "generator": "pigjax"}, "scene": 0}
        head |= {"extensionsUsed": list(extensions)} if extensions else {}
        head |= {"scenes": [{"nodes": list(range(len(self.told["nodes"])))}], "buffers": [{"byteLength": self.size}]}
        head |= {name: entries for name, entries in self.told.items() if entries}
        text = json.dumps(head, ensure_ascii=True).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self.size
        if total >= 1 << 32:
            raise InputError(f"{path}: {total} bytes are more than a .glb holds (4 GiB); export fewer splats.")
        with writing(path) as partial, partial.open("wb") as file:
            file.write(_MAGIC + struct.pack("<IIII", 2, total, len(text), _JSON) + text)
            file.write(struct.pack("<II", self.size, _BINARY))
            file.writelines(self.blocks)


def read_glb(path: PathLike) -> dict[str, np.ndarray]:
    """Columns of each field of the Gaussians of a `.glb`, all its splat primitives one after the other.

    Raises:
        MissingFileError: there is no such file.
        InputError: the file is damaged, holds no Gaussians, or only compressed ones.
    """
    path = existing(path, "file of Gaussians")
    with decoding(path, "file of Gaussians", remedy=_REMEDY):
        head, binary = _chunks(path.read_bytes())
        scenes, nodes = head.get("scenes") or [{}], head.get("nodes") or []
        roots = scenes[int(head.get("scene", 0))].get("nodes", range(len(nodes)))
        parts = [
            (_gaussians_of(path, head, binary, primitive), transform)
            for node, transform in _walk(nodes, list(roots), np.eye(4), set())
            if "mesh" in node
            for primitive in head["meshes"][node["mesh"]]["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        ]
        if not parts:
            raise InputError(f"{path}: holds no Gaussians ({EXTENSION}); give a .glb that has that extension.")
        return fields_of(parts)


def _chunks(raw: bytes) -> tuple[dict[str, Any], bytes]:
    if len(raw) < 20 or raw[:4] != _MAGIC:
        raise ValueError("it has no header of a .glb")
    version, total, length, kind = struct.unpack("<IIII", raw[4:20])
    if version != 2 or kind != _JSON or total > len(raw) or 20 + length > len(raw):
        raise ValueError("its header does not fit its size, or is not of version 2")
    head = json.loads(raw[20 : 20 + length])
    rest = raw[20 + length :]
    if len(rest) < 8:
        return head, b""
    size, kind = struct.unpack("<II", rest[:8])
    if kind != _BINARY or 8 + size > len(rest):
        raise ValueError("its block of numbers is cut short")
    return head, rest[8 : 8 + size]


def _walk(nodes: list[Any], roots: list[int], above: np.ndarray, met: set[int]) -> Any:
    """Each node with its transform to the world, from the roots down."""
    for index in roots:
        if index in met or len(met) > _MOST_NODES:
            raise ValueError("its nodes are no tree, or too many")
        met.add(index)
        node = nodes[index]
        transform = np.einsum("ij,jk->ik", above, _local(node))
        yield node, transform
        yield from _walk(nodes, node.get("children", []), transform, met)


def _local(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.asarray(node.get("rotation", (0, 0, 0, 1)), np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    local = np.eye(4)
    local[:3, :3] = np.asarray(rows) * np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    local[:3, 3] = node.get("translation", (0, 0, 0))
    return local


def _gaussians_of(path: Path, head: dict[str, Any], binary: bytes, primitive: dict[str, Any]) -> Gaussians:
    attributes, told = primitive["attributes"], primitive["extensions"][EXTENSION]
    packed, needed = sorted(told.get("extensions", {})), head.get("extensionsRequired", [])
    if packed and (f"{EXTENSION}:SCALE" not in attributes or packed[0] in needed):
        raise InputError(f"{path}: its Gaussians are compressed ({packed[0]}), which is not read; {_REMEDY}.")
    if told.get("kernel", "ellipse") != "ellipse":
        warnings.warn(f"{path}: its kernel is {told['kernel']!r}; it is drawn as an ellipse.", stacklevel=6)
    if str(told.get("colorSpace", "srgb")).startswith("lin"):
        warnings.warn(f"{path}: its colours are linear light; they are drawn as they are, darker.", stacklevel=6)

    def column(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise InputError(f"{path}: attribute {name} is missing; {_REMEDY}.")
        values = _values_of(head, binary, attributes[name])
        if values.shape[1] != width:
            raise ValueError(f"{name} has {values.shape[1]} components instead of {width}")
        return values

    degree = 0
    while degree < 3 and _coefficient(degree + 1, 0) in attributes:
        degree += 1
    names = [_coefficient(d, order) for d in range(degree + 1) for order in range(2 * d + 1)]
    scales, opacities = column(f"{EXTENSION}:SCALE", 3), column(f"{EXTENSION}:OPACITY", 1)[:, 0]
    if (scales < 0).any():  # drafts of the extension had logarithms
        warnings.warn(f"{path}: scales are negative, as in drafts of {EXTENSION}: read as logarithms.", stacklevel=6)
        log_scales = scales
    else:
        log_scales = np.log(np.maximum(scales, _LEAST_SCALE))
    if (opacities < 0).any() or (opacities > 1).any():
        raise InputError(f"{path}: opacities lie beyond 0..1 ({opacities.min():g} to {opacities.max():g}); {_REMEDY}.")
    with np.errstate(divide="ignore"):
        logits = np.log(np.maximum(opacities, _LEAST_OPACITY)) - np.log1p(-opacities)
    values = {
        "means": column("POSITION", 3),
        "log_scales": log_scales,
        "quats": column(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        "logit_opacities": logits,
        "sh": np.stack([column(name, 3) for name in names], 1),
    }
    return Gaussians(**{name: jnp.asarray(array, jnp.float32) for name, array in values.items()})


def _values_of(head: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """The numbers of an accessor [n, k] in float64; what the file has no room for is refused."""
    told = head["accessors"][index]
    if "sparse" in told or "bufferView" not in told:
        raise ValueError("it has sparse accessors")
    view = head["bufferViews"][told["bufferView"]]
    if "uri" in head["buffers"][view["buffer"]] or view["buffer"] != 0:
        raise ValueError("its numbers lie in another file")
    name, width, count = _COMPONENTS[told["componentType"]], _TYPES[told["type"]], int(told["count"])
    item = np.dtype(name).itemsize * width
    stride = int(view.get("byteStride", item))
    start = int(view.get("byteOffset", 0)) + int(told.get("byteOffset", 0))
    end = start + (count - 1) * stride + item if count else start
    if min(start, count, stride - item) < 0 or end > len(binary):
        raise ValueError("an accessor leads beyond the block of numbers")
    block = np.frombuffer(binary, np.uint8, count=end - start, offset=start)
    rows = np.lib.stride_tricks.as_strided(block, (count, item), (stride, 1), writeable=False)
    values = np.ascontiguousarray(rows).view(name).astype(np.float64)
    return np.maximum(values / _FULL[name], -1) if told.get("normalized") else values


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.exp(-np.logaddexp(0, -values))
