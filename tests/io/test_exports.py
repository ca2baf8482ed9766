"""Files for other tools: each is read back, by another reader where there is one, and drawn as the original is."""

import base64
import json
import re
import struct
import zipfile
from io import BytesIO
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from splats import gaussians_of, make_scene

from pigjax import io
from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core.errors import InputError
from pigjax.core.gaussians import Splats
from pigjax.core.metrics import psnr
from pigjax.core.placing import as_gaussians, placed, up_to
from pigjax.io.gltf import EXTENSION, Mesh
from pigjax.splat import RenderConfig
from pigjax.splatting import reference

COUNT = 40
_render = eqx.filter_jit(reference.render)
SCENE, CAMERA = make_scene(count=COUNT, degree=2)


def draw(splats):
    return _render(splats, CAMERA, RenderConfig()).rgb


@pytest.fixture(scope="module")
def frames():
    """Three poses of a scene with view-dependent colour."""
    gaussians = gaussians_of(SCENE)
    rng = np.random.default_rng(3)
    poses = []
    for frame in range(3):
        F = jnp.asarray(rng.normal(np.eye(3), 0.1 + 0.2 * frame, (COUNT, 3, 3)), jnp.float32)
        moved = eigen_clamp(gaussians, F, ClampParams())
        poses.append(eqx.tree_at(lambda splats: splats.means, moved, moved.means + 0.05 * frame))
    return poses


# ---- glTF

# what a file without further extensions may hold: the properties that mesh.primitive.KHR_gaussian_splatting.schema.json
# lists and requires, with the values that the tables of the specification give (the schema itself leaves any string to
# extensions of the extension)
SCHEMA = {
    "type": "object",
    "required": ["kernel", "colorSpace"],
    "properties": {
        "kernel": {"enum": ["ellipse"]},
        "colorSpace": {"enum": ["srgb_rec709_display", "lin_rec709_display"]},
        "projection": {"enum": ["perspective"]},
        "sortingMethod": {"enum": ["cameraDistance"]},
    },
    "additionalProperties": False,
}
# type of each attribute's accessor, of the specification's table for the ellipse kernel; floats are allowed for all
TYPES = {"POSITION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR", "SH": "VEC3"}
ATTRIBUTES = {
    "type": "object",
    "required": ["POSITION", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))],
    "patternProperties": {
        "^(POSITION|COLOR_0)$": {"type": "integer"},
        f"^{EXTENSION}:(ROTATION|SCALE|OPACITY)$": {"type": "integer"},
        f"^{EXTENSION}:SH_DEGREE_(0_COEF_0|1_COEF_[0-2]|2_COEF_[0-4]|3_COEF_[0-6])$": {"type": "integer"},
    },
    "additionalProperties": False,
}


def test_glb_follows_the_schema_and_another_reader_finds_the_numbers(tmp_path, frames):
    pygltflib, jsonschema = pytest.importorskip("pygltflib"), pytest.importorskip("jsonschema")
    io.save_glb(tmp_path / "a.glb", frames[1])
    gltf = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    assert gltf.extensionsUsed == [EXTENSION]
    (primitive,) = gltf.meshes[0].primitives
    assert primitive.mode == pygltflib.POINTS
    jsonschema.validate(primitive.extensions[EXTENSION], SCHEMA)
    names = {name: index for name, index in vars(primitive.attributes).items() if index is not None}
    jsonschema.validate(names, ATTRIBUTES)
    assert len(names) == 5 + 9  # every coefficient of degrees 0 to 2
    truth, blob = as_gaussians(frames[1]), gltf.binary_blob()

    def values(name):
        accessor = gltf.accessors[names[name]]
        view = gltf.bufferViews[accessor.bufferView]
        kind = TYPES[name.removeprefix(f"{EXTENSION}:").partition("_")[0]]
        assert (accessor.componentType, accessor.type, accessor.count) == (pygltflib.FLOAT, kind, COUNT)
        assert view.byteOffset % 4 == 0
        return np.frombuffer(blob, "<f4", offset=view.byteOffset, count=view.byteLength // 4).reshape(COUNT, -1)

    np.testing.assert_array_equal(values("POSITION"), truth.means)
    np.testing.assert_allclose(values(f"{EXTENSION}:SCALE"), np.exp(truth.log_scales), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(values(f"{EXTENSION}:ROTATION"), axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(values(f"{EXTENSION}:ROTATION")[:, 3], truth.quats[:, 0], atol=1e-6)
    np.testing.assert_allclose(values(f"{EXTENSION}:OPACITY")[:, 0], frames[1].opacities, rtol=1e-5)
    np.testing.assert_array_equal(values(f"{EXTENSION}:SH_DEGREE_2_COEF_3"), truth.sh[:, 7])
    position = gltf.accessors[names["POSITION"]]
    np.testing.assert_array_equal([position.min, position.max], [truth.means.min(0), truth.means.max(0)])


@pytest.mark.parametrize("suffix", ["glb", "usdc", "usda"])
def test_what_is_read_back_is_drawn_as_the_original(tmp_path, frames, suffix):
    path = tmp_path / f"a.{suffix}"
    if suffix == "glb":
        io.save_glb(path, frames[2])
    else:
        pytest.importorskip("pxr")
        io.save_usd(path, [frames[2]])
    assert float(psnr(draw(io.load_gaussians(path)), draw(frames[2]))) > 80


def test_an_origin_is_the_place_of_the_node(tmp_path, frames):
    """UTM coordinates, which float32 does not hold."""
    origin = (432100.0, 5412300.0, 120.0)
    io.save_glb(tmp_path / "a.glb", frames[0], origin=origin)
    assert io.origin_of(tmp_path / "a.glb") != (0.0, 0.0, 0.0)
    back = io.load_gaussians(tmp_path / "a.glb", origin=origin)
    np.testing.assert_allclose(back.means, frames[0].means, atol=1e-6)


def test_nodes_turn_scale_and_shift_what_they_hold(tmp_path, frames):
    """As other tools put z up: a parent that turns, a child that scales."""
    io.save_glb(tmp_path / "a.glb", frames[0])
    raw = (tmp_path / "a.glb").read_bytes()
    length = struct.unpack("<I", raw[12:16])[0]
    head = json.loads(raw[20 : 20 + length])
    half = np.sqrt(0.5)
    head["nodes"] = [{"rotation": [half, 0, 0, half], "children": [1]}, {"mesh": 0, "scale": [2, 2, 2]}]
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    body = raw[20 + length :]
    start = b"glTF" + struct.pack("<IIII", 2, 20 + len(text) + len(body), len(text), 0x4E4F534A)
    (tmp_path / "b.glb").write_bytes(start + text + body)
    matrix = np.eye(4)
    matrix[:3, :3] = 2 * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    wanted, found = placed(frames[0], matrix), io.load_gaussians(tmp_path / "b.glb")
    np.testing.assert_allclose(found.means, wanted.means, atol=1e-5)
    assert float(psnr(draw(found), draw(wanted))) > 80


def test_damaged_and_foreign_glb_are_one_clear_line(tmp_path, frames):
    io.save_glb(tmp_path / "a.glb", frames[0])
    raw = (tmp_path / "a.glb").read_bytes()
    io.save_mesh(tmp_path / "mesh.glb", {"tetrahedron": TETRAHEDRON})
    bad = {"cut": raw[:-200], "empty": b"", "text": b"glTF" + bytes(40), "mesh": (tmp_path / "mesh.glb").read_bytes()}
    for name, content in bad.items():
        (tmp_path / f"{name}.glb").write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}\.glb.*(damaged|not a readable|no Gaussians)") as caught:
            io.load_gaussians(tmp_path / f"{name}.glb")
        assert "\n" not in str(caught.value)


def test_scales_of_drafts_are_read_as_logarithms(tmp_path, frames):
    io.save_glb(tmp_path / "a.glb", frames[0])
    raw = bytearray((tmp_path / "a.glb").read_bytes())
    linear = np.exp(np.asarray(as_gaussians(frames[0]).log_scales, np.float64)).astype("<f4")
    at = raw.index(linear.tobytes()[:24])
    raw[at : at + linear.nbytes] = np.log(linear).astype("<f4").tobytes()
    (tmp_path / "b.glb").write_bytes(raw)
    with pytest.warns(UserWarning, match="read as logarithms"):
        assert float(psnr(draw(io.load_gaussians(tmp_path / "b.glb")), draw(frames[0]))) > 80


# ---- USD


def test_usd_has_a_time_sample_for_each_frame_that_moves(tmp_path, frames):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdVol

    still = [frames[0], frames[0], frames[1], frames[2]]
    io.save_usd(tmp_path / "a.usdc", iter(still), fps=30, up="Y", origin=(10.0, 0.0, 0.0))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 3, 30)
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/Splats"))
    assert field.GetPositionsAttr().GetTimeSamples() == [0, 1, 2, 3]
    assert field.GetOpacitiesAttr().GetTimeSamples() == []
    for frame, splats in enumerate(still):
        np.testing.assert_array_equal(field.GetPositionsAttr().Get(frame), splats.means)
    turns = [np.asarray(field.GetOrientationsAttr().Get(frame)) for frame in range(4)]
    assert all(((a * b).sum(1) >= 0).all() for a, b in pairwise(turns)), "the long way round between frames"
    low, high = np.asarray(field.GetExtentAttr().Get(2))
    assert (low < frames[1].means.min(0)).all()
    assert (high > frames[1].means.max(0)).all()
    back = io.read_usd(tmp_path / "a.usdc", frame=2)
    np.testing.assert_allclose(back["means"], frames[1].means + jnp.asarray([10.0, 0, 0]), atol=1e-6)


def test_usd_that_draws_on_other_files_is_refused(tmp_path, frames):
    pytest.importorskip("pxr")
    io.save_usd(tmp_path / "a.usda", [frames[0]])
    text = "#usda 1.0\n(\n    subLayers = [@./a.usda@]\n)\n"
    (tmp_path / "b.usda").write_text(text)
    with pytest.raises(InputError, match=r"b\.usda: draws on other files"):
        io.load_gaussians(tmp_path / "b.usda")
    (tmp_path / "c.usdc").write_bytes(b"PXR-USDC" + bytes(80))
    with pytest.raises(InputError, match=r"c\.usdc: not a readable USD file"):
        io.load_gaussians(tmp_path / "c.usdc")


# ---- the page


def scene_of_page(text):
    """Nodes of viser's recorded scene in a page: splats by name, and when each is shown."""
    zstandard, msgspec = pytest.importorskip("zstandard"), pytest.importorskip("msgspec")
    raw = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]*)"', text)[1])
    size = struct.unpack("<Q", raw[:8])[0]
    inner = zstandard.ZstdDecompressor().decompress(raw[8:], max_output_size=size)
    length = struct.unpack("<Q", inner[:8])[0]
    told = msgspec.msgpack.decode(inner[8 : 8 + length])
    at, buffers = 8 + length, []
    for nbytes in told["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(inner[at : at + nbytes])
        at += nbytes
    splats = {}  # rows of each node, at each time

    def rows(place):
        index = next(v for v in place.values() if isinstance(v, int)) if isinstance(place, dict) else place
        return np.frombuffer(buffers[index], np.uint32).reshape(-1, 8)

    for time, message in told["messages"]:
        if message["type"] == "GaussianSplatsMessage":
            splats[message["name"]] = {time: rows(message["props"]["buffer"])}
        if message["type"] == "SceneNodeUpdateMessage":
            splats[message["name"]][time] = rows(message["updates"]["buffer"])
    return splats, told["durationSeconds"]


def splats_of(packed):
    """Splats from viser's rows: positions float32, covariances float16, RGBA bytes."""
    means = packed[:, :3].copy().view(np.float32)
    upper = packed[:, 4:7].copy().view(np.float16).astype(np.float64)
    covariance = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    rgba = packed[:, 7:].copy().view(np.uint8) / 255
    w, q = np.linalg.eigh(covariance)
    factors = q * np.sqrt(np.maximum(w, 0))[:, None, :]
    sh = (rgba[:, None, :3] - 0.5) / 0.28209479177387814
    return Splats(*(jnp.asarray(v, jnp.float32) for v in (means, factors, rgba[:, 3], sh)))


def test_a_page_holds_all_frames_and_asks_no_host(tmp_path, frames):
    pytest.importorskip("viser")
    moving = np.arange(COUNT) < 30
    rest = as_gaussians(frames[0])
    posed = [
        eqx.tree_at(lambda g: g.means, rest, rest.means.at[:30].set(as_gaussians(frame).means[:30])) for frame in frames
    ]
    io.save_page(tmp_path / "a.html", iter(posed), moving=moving, fps=10, camera=CAMERA, title="a <b> & c")
    text = (tmp_path / "a.html").read_text()
    assert "<title>a &lt;b&gt; &amp; c</title>" in text
    assert "Apache License" in text
    assert not re.search(r'(src|href)="(https?:)?//', text)
    splats, duration = scene_of_page(text)
    assert duration == pytest.approx(0.3)
    assert list(splats["/splats"]) == pytest.approx([0, 0.1, 0.2])
    assert {name: {len(rows) for rows in times.values()} for name, times in splats.items()} == {
        "/splats": {30},
        "/still": {10},
    }
    flat = eqx.tree_at(lambda g: g.sh, posed[2], posed[2].sh[:, :1])
    both = np.concatenate([[*splats["/splats"].values()][-1], splats["/still"][0]])
    assert float(psnr(draw(splats_of(both)), draw(flat))) > 45  # colours and opacities have 8 bits


# ---- SOG


def write_sog(path, gaussians):
    """A writer of SOG 2 for the test, with codebooks of quantiles and a palette of every colour."""
    count, width = len(gaussians), 8
    rows = -(-count // width)
    archive = zipfile.ZipFile(path, "w")

    def picture(name, values, across=width):
        full = np.zeros((rows * across if across == width else len(values), 4), np.uint8)
        full[:, 3] = 255
        full[: len(values), : values.shape[1]] = values
        room = BytesIO()
        Image.fromarray(full.reshape(-1, across, 4)).save(room, "webp", lossless=True, exact=True)
        archive.writestr(name, room.getvalue())

    def coded(values):
        book = np.quantile(values, np.linspace(0, 1, 256))
        return book.tolist(), np.abs(np.asarray(values)[..., None] - book).argmin(-1).astype(np.uint8)

    means = np.asarray(gaussians.means, np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    words = np.round((logs - low) / (high - low) * 65535).astype(int)
    picture("means_l.webp", (words % 256).astype(np.uint8))
    picture("means_u.webp", (words // 256).astype(np.uint8))
    scales, index = coded(np.asarray(gaussians.log_scales))
    picture("scales.webp", index)
    quats = np.asarray(gaussians.quats, np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(1)
    quats *= np.sign(quats[np.arange(count), largest])[:, None]
    kept = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    small = np.round((np.take_along_axis(quats, kept, 1) / np.sqrt(2) + 0.5) * 255)
    picture("quats.webp", np.concatenate([small, 252 + largest[:, None]], 1).astype(np.uint8))
    colours, index = coded(np.asarray(gaussians.sh[:, 0]))
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.logit_opacities)))
    picture("sh0.webp", np.concatenate([index, np.round(opacity * 255).astype(np.uint8)[:, None]], 1))
    book, index = coded(np.asarray(gaussians.sh[:, 1:]))
    palette = np.zeros((64, 8, 3), np.uint8)
    palette[:count] = index
    picture("shN_centroids.webp", palette.reshape(-1, 3), across=64 * 8)
    picture("shN_labels.webp", np.stack([np.arange(count), np.zeros(count)], 1).astype(np.uint8))
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours, "files": ["sh0.webp"]},
        "shN": {"count": count, "bands": 2, "codebook": book, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }
    archive.writestr("meta.json", json.dumps(meta))
    archive.close()


def test_sog_is_read_within_its_rounding(tmp_path, frames):
    truth = as_gaussians(frames[0])
    write_sog(tmp_path / "a.sog", truth)
    found = io.load_gaussians(tmp_path / "a.sog")
    np.testing.assert_allclose(found.means, truth.means, atol=1e-4)
    np.testing.assert_allclose(found.log_scales, truth.log_scales, atol=0.15)
    assert float(psnr(draw(found), draw(truth))) > 40
    (tmp_path / "b.sog").write_bytes((tmp_path / "a.sog").read_bytes()[:-30])
    with pytest.raises(InputError, match=r"b\.sog: not a readable"):
        io.load_gaussians(tmp_path / "b.sog")
    (tmp_path / "c.ksplat").write_bytes(b"0")
    with pytest.raises(InputError, match=r"\.ksplat is not read; save it as \.ply"):
        io.load_gaussians(tmp_path / "c.ksplat")


# ---- points, meshes, film

TETRAHEDRON = Mesh(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
)


@pytest.mark.parametrize("suffix", ["ply", "vtu", "vtk"])
def test_points_come_back_with_their_fields(tmp_path, suffix):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(9, 3)).astype(np.float32)
    fields = {"v": rng.normal(size=(9, 3)).astype(np.float32), "object": np.arange(9), "F": rng.normal(size=(9, 3, 3))}
    if suffix != "ply":
        pytest.importorskip("meshio")
    io.save_points(tmp_path / f"a.{suffix}", x, fields)
    if suffix == "ply":
        import plyfile

        vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
        found = {"x": np.stack([vertex[n] for n in "xyz"], 1), "v": np.stack([vertex[f"v_{n}"] for n in "xyz"], 1)}
        found |= {"object": vertex["object"], "F": np.stack([vertex[f"F_{i}"] for i in range(9)], 1)}
    else:
        import meshio

        mesh = meshio.read(tmp_path / f"a.{suffix}")
        found = {"x": mesh.points, **mesh.point_data}
    for name, values in {"x": x, **fields}.items():
        np.testing.assert_allclose(np.asarray(found[name]).reshape(9, -1), values.reshape(9, -1), rtol=1e-6)


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_meshes_come_back(tmp_path, suffix):
    moved = TETRAHEDRON._replace(vertices=TETRAHEDRON.vertices + 2)
    io.save_mesh(tmp_path / f"a.{suffix}", {"first": TETRAHEDRON, "the second": moved})
    if suffix == "obj":
        text = (tmp_path / "a.obj").read_text()
        vertices = np.array(re.findall(r"^v (\S+) (\S+) (\S+)$", text, re.M), float)
        faces = np.array(re.findall(r"^f (\d+) (\d+) (\d+)$", text, re.M), int) - 1
        assert "o the second\n" in text
    else:
        pygltflib = pytest.importorskip("pygltflib")
        gltf = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
        assert [node.name for node in gltf.nodes] == ["first", "the second"]
        blob, parts, first = gltf.binary_blob(), [], 0
        for mesh in gltf.meshes:
            told = [gltf.accessors[i] for i in (mesh.primitives[0].attributes.POSITION, mesh.primitives[0].indices)]
            views = [gltf.bufferViews[accessor.bufferView] for accessor in told]
            points = np.frombuffer(blob, "<f4", 12, views[0].byteOffset).reshape(-1, 3)
            parts.append(
                (points, first + np.frombuffer(blob, "<u4", 12, views[1].byteOffset).reshape(-1, 3).astype(int))
            )
            first += len(points)
        vertices, faces = (np.concatenate(values) for values in zip(*parts))
    corners = vertices[faces]
    np.testing.assert_allclose(corners[:4], TETRAHEDRON.vertices[TETRAHEDRON.faces])
    np.testing.assert_allclose(corners[4:] - 2, corners[:4])
    volume = np.einsum("fi,fi->f", corners[:4, 0], np.cross(corners[:4, 1], corners[:4, 2])).sum() / 6
    assert volume == pytest.approx(1 / 6), "faces are counter-clockwise seen from outside"


def test_webm_keeps_transparency(tmp_path):
    import subprocess

    import imageio_ffmpeg

    frame = np.zeros((32, 32, 4), np.uint8)
    frame[:, :16] = [200, 40, 40, 255]
    io.write_video(tmp_path / "a.webm", [frame] * 3, fps=10)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-c:v", "libvpx-vp9", "-i", str(tmp_path / "a.webm")]
    command += ["-f", "rawvideo", "-pix_fmt", "rgba", "-"]
    out = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8)
    out = out.reshape(-1, 32, 32, 4).astype(int)
    assert len(out) == 3
    assert np.abs(out[:, :, 2:14] - frame[:, 2:14]).max() < 12
    assert out[:, :, 20:, 3].max() < 4


def test_up_of_a_scene_becomes_gltfs_y(frames):
    """z up in the scene is y up in the file, and a turn back gives the scene."""
    turn = up_to(np.array([0, 0, 1.0]), np.array([0, 1.0, 0]))
    there = placed(frames[0], turn)
    np.testing.assert_allclose(there.means[:, 1], frames[0].means[:, 2], atol=1e-6)
    assert float(psnr(draw(placed(there, turn.T)), draw(frames[0]))) > 80
