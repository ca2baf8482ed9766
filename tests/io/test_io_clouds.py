"""Clouds and Gaussians of other tools: nothing that a file says is passed over, and damage is one clear error."""

import struct
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.core.errors import InputError
from pigjax.io import load_cameras, load_gaussians, load_ply, load_points, origin_of, save_ply
from pigjax.splat import Gaussians
from pigjax.splatting.types import as_splats

FAR = np.array([450000.37, 5400000.21, 12.5])


def columns(count=4, seed=0):
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    found = {name: rng.normal(size=count) for name in names + [f"rot_{i}" for i in range(4)]}
    return found | {f"scale_{i}": rng.normal(size=count) - 3 for i in range(3)}


def write(path, found, kinds=None, order="<", text=False):
    table = np.zeros(len(found["x"]), [(name, (kinds or {}).get(name, "f4")) for name in found])
    for name, values in found.items():
        table[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")], byte_order=order, text=text).write(str(path))
    return path


def sigmoid(logits):
    return 1 / (1 + np.exp(-np.asarray(logits, np.float64)))


def test_infinite_opacities_are_opaque_and_absent_with_finite_gradients(tmp_path):
    found = columns()
    found["opacity"][1:3] = np.inf, -np.inf
    gaussians = load_gaussians(write(tmp_path / "a.ply", found), drop_invalid=True)
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    assert opacities.shape == (4,)
    assert opacities[1] == 1
    assert opacities[2] == 0
    slopes = jax.grad(lambda g: jnp.sum(as_splats(g).opacities ** 2) + jnp.mean(g.logit_opacities))(gaussians)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    save_ply(tmp_path / "b.ply", gaussians)
    np.testing.assert_array_equal(load_ply(tmp_path / "b.ply").logit_opacities, gaussians.logit_opacities)


@settings(deadline=None, max_examples=20)
@given(st.floats(0, 1e3), st.floats(-20, 20), st.floats(-9, 2))
def test_the_3d_filter_of_mip_splatting_widens_and_fades(tmp_path_factory, width, logit, scale):
    found = columns(1) | {"filter_3D": np.array([width]), "opacity": np.array([logit])}
    found |= {f"scale_{i}": np.array([scale + i]) for i in range(3)}
    gaussians = load_gaussians(write(tmp_path_factory.mktemp("mip") / "a.ply", found, dict.fromkeys(found, "f8")))
    scales = np.exp(scale + np.arange(3))
    wide = np.sqrt(scales**2 + width**2)
    faded = sigmoid(logit) * np.sqrt(np.prod(scales**2) / np.prod(wide**2))
    np.testing.assert_allclose(np.exp(gaussians.log_scales[0]), wide, rtol=1e-5)
    np.testing.assert_allclose(sigmoid(gaussians.logit_opacities[0]), faded, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("comment", ["Größe: 3 m", "点云"])
@pytest.mark.parametrize("encoding", ["utf-8", "gb18030"])
@pytest.mark.parametrize("text", [False, True])
def test_comments_may_be_in_any_encoding(tmp_path, comment, encoding, text):
    write(tmp_path / "a.ply", columns(), text=text)
    content = (tmp_path / "a.ply").read_bytes()
    said = f"\ncomment {comment}\nobj_info {comment}\nelement".encode(encoding)
    (tmp_path / "b.ply").write_bytes(content.replace(b"\nelement", said, 1))
    np.testing.assert_array_equal(load_ply(tmp_path / "b.ply").means, load_ply(tmp_path / "a.ply").means)


def far_cloud(path, text=False):
    found = columns(9)
    for axis, name in enumerate("xyz"):
        found[name] = 0.1 * found[name] + FAR[axis]
    write(path, found, dict.fromkeys("xyz", "f8"), text=text)
    return np.stack([found[name] for name in "xyz"], 1)


@pytest.mark.parametrize("text", [False, True])
def test_far_doubles_are_refused_or_shifted_and_restored(tmp_path, text):
    path = tmp_path / "a.ply"
    positions = far_cloud(path, text)
    with pytest.raises(InputError, match=r"around \(450000, 5400000, 0\).*origin=\(450000, 5400000, 0\)"):
        load_gaussians(path)
    origin = origin_of(path)
    with pytest.raises(InputError, match=r"origin = \(1e\+300, 0, 0\) is subtracted.*around \(450000, 5400000, 0\)"):
        load_gaussians(path, origin=(1e300, 0.0, 0.0))
    gaussians = load_gaussians(path, origin=origin)
    np.testing.assert_allclose(np.asarray(gaussians.means, np.float64) + origin, positions, atol=1e-4)
    save_ply(tmp_path / "b.ply", gaussians, origin=origin)
    again = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    np.testing.assert_allclose(np.stack([again[name] for name in "xyz"], 1), positions, atol=1e-4)
    np.testing.assert_array_equal(load_gaussians(tmp_path / "b.ply", origin=origin).means, gaussians.means)


def test_far_points_are_refused_or_shifted(tmp_path):
    row = struct.pack("<Q3d3BdQ", 1, *FAR, 9, 8, 7, 0.5, 0)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2) + row + row)
    (tmp_path / "points3D.txt").write_text(f"1 {FAR[0]} {FAR[1]} {FAR[2]} 9 8 7 0.5\n" * 2)
    for kind in ("bin", "txt"):
        with pytest.raises(InputError, match=r"origin=\(450000, 5400000, 0\)"):
            load_points(tmp_path / f"points3D.{kind}")
        xyz, _ = load_points(tmp_path / f"points3D.{kind}", origin=(450000, 5400000, 0))
        np.testing.assert_allclose(xyz[0], [0.37, 0.21, 12.5], atol=1e-5)


def test_cameras_shift_with_the_cloud(tmp_path):
    text = '{"fl_x": 9, "w": 8, "h": 6, "frames": [{"file_path": "a.png", "transform_matrix":'
    pose = [*([*row, at] for row, at in zip(np.eye(3).tolist(), FAR.tolist())), [0, 0, 0, 1]]
    (tmp_path / "transforms.json").write_text(f"{text} {pose}}}]}}")
    cameras, _ = load_cameras(tmp_path, origin=(450000, 5400000, 0))
    np.testing.assert_allclose(cameras.position[0], [0.37, 0.21, 12.5], atol=1e-5)


@settings(deadline=None, max_examples=25)
@given(st.floats(1e-3, 1e4), st.floats(-1e8, 1e8), st.booleans())
def test_rounding_beyond_a_thousandth_is_never_silent(tmp_path_factory, extent, offset, text):
    found = columns(20)
    for name in "xyz":
        found[name] = extent * found[name] + offset
    path = write(tmp_path_factory.mktemp("far") / "a.ply", found, dict.fromkeys("xyz", "f8"), text=text)
    truth = np.stack([found[name] for name in "xyz"], 1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            means = np.asarray(load_ply(path).means, np.float64)
        except InputError as error:
            refusal = str(error)
            means = truth if "origin=" in refusal else np.full_like(truth, np.nan)
    error = np.abs(means - truth).max()
    # what a shift cannot mend is the rounding of the extent itself
    assert said or error <= max(1e-3, 2e-6 * extent)


@pytest.mark.parametrize("origin", [(1.0, 2.0), (1.0, 2.0, np.nan), (np.inf, 0.0, 0.0)])
def test_an_origin_is_three_finite_numbers(tmp_path, origin):
    with pytest.raises(InputError, match=r"origin = .*give three finite numbers"):
        load_ply(write(tmp_path / "a.ply", columns()), origin=origin)


def points(path, colours, kind):
    found = {"x": np.arange(3.0), "y": np.ones(3), "z": np.ones(3)}
    found |= {name: np.asarray(values) for name, values in zip(("red", "green", "blue"), colours)}
    return write(path, found, dict.fromkeys(("red", "green", "blue"), kind))


@pytest.mark.parametrize(
    ("kind", "value", "full"),
    [("u1", 200, 255), ("f4", 200, 255), ("f8", 127.5, 255), ("f4", 0.5, 1), ("u2", 60000, 65535), ("i4", 200, 255),
     ("f8", 1.0, 1), ("u2", 200, 255)],
)  # fmt: skip
def test_colours_come_in_the_unit_range(tmp_path, kind, value, full):
    _, rgb = load_points(points(tmp_path / "a.ply", [[value] * 3, [0] * 3, [0] * 3], kind))
    np.testing.assert_allclose(rgb[0], [value / full, 0, 0], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "value"), [("f4", -3), ("f8", 256), ("f4", 1.5), ("i4", -1), ("i4", 70000), ("f8", 1e30)]
)
def test_colours_of_no_range_are_refused(tmp_path, kind, value):
    with pytest.raises(InputError, match=r"property 'green' = .* in row 1"):
        load_points(points(tmp_path / "a.ply", [[0] * 3, [0, value, 0], [0] * 3], kind))


def test_spz_of_version_4_is_read_or_names_what_is_missing(tmp_path, monkeypatch):
    gsply = pytest.importorskip("gsply")
    (tmp_path / "a.spz").write_bytes(b"NGSP" + struct.pack("<IIBBBB", 4, 1, 0, 12, 0, 6) + bytes(64))
    with monkeypatch.context() as patch:
        patch.setattr("importlib.util.find_spec", lambda name: None)
        with pytest.raises(InputError, match=r"version 4 needs zstandard: pip install 'pigjax\[formats\]'"):
            load_gaussians(tmp_path / "a.spz")
    pytest.importorskip("zstandard")
    write(tmp_path / "a.ply", columns())
    gsply.write_spz(tmp_path / "b.spz", gsply.plyread(tmp_path / "a.ply"), version=4)
    assert len(load_gaussians(tmp_path / "b.spz")) == 4


HEADER = "ply\nformat {kind} 1.0\nelement vertex {count}\n{x}\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize("count", ["1000000000000", "9" * 30, "-5", "nan", "4294967296"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("x", ["property float x", "property list uchar float x"])
def test_counts_beyond_the_file_ask_for_no_memory(tmp_path, count, kind, x):
    (tmp_path / "a.ply").write_text(HEADER.format(kind=kind, count=count, x=x) + "1 2 3\n")
    for read in (load_ply, load_points, origin_of):
        with pytest.raises(InputError, match=r"a\.ply: "):
            read(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_list_where_a_number_is_needed_is_refused(tmp_path, kind):
    rows = "1 1 2 3\n" if kind == "ascii" else struct.pack("<B3f", 1, 1, 2, 3).decode("latin-1")
    header = HEADER.format(kind=kind, count=1, x="property list uchar float x")
    (tmp_path / "a.ply").write_bytes((header + rows).encode("latin-1"))
    with pytest.raises(InputError, match="property 'x' is missing as a number"):
        load_points(tmp_path / "a.ply")


def test_a_list_that_is_not_needed_is_passed(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    body = struct.pack("<B2i", 2, 7, 8) + struct.pack("<3f3B", 1, 2, 3, 255, 0, 51)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    xyz, rgb = load_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(xyz, [[1, 2, 3]])
    np.testing.assert_allclose(rgb, [[1, 0, 0.2]])


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz"])
def test_a_folder_is_no_file(tmp_path, suffix):
    pytest.importorskip("gsply")
    (tmp_path / f"a{suffix}").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        load_gaussians(tmp_path / f"a{suffix}")


def test_properties_that_are_not_modelled_are_named(tmp_path):
    with pytest.warns(UserWarning, match="2 properties that 3DGS does not know were left out: beta, motion_0"):
        load_ply(write(tmp_path / "a.ply", columns() | {"nx": np.zeros(4), "beta": np.ones(4), "motion_0": np.ones(4)}))
    linear = columns() | {f"scale_{i}": np.full(4, 0.1) for i in range(3)} | {"opacity": np.full(4, 0.5)}
    with pytest.warns(UserWarning, match="as if stored as they are"):
        load_ply(write(tmp_path / "b.ply", linear))
    with pytest.warns(UserWarning, match="scales beyond exp"):
        load_ply(write(tmp_path / "c.ply", columns() | {"scale_1": np.full(4, 90.0)}))
    disks = {name: values for name, values in columns().items() if name != "scale_2"}
    with pytest.raises(InputError, match="flat disks"):
        load_ply(write(tmp_path / "d.ply", disks))
    with pytest.raises(InputError, match="coloured point cloud"):
        load_ply(points(tmp_path / "e.ply", [[0] * 3] * 3, "u1"))
    with pytest.raises(InputError, match="'opacity' holds whole numbers"):
        load_ply(write(tmp_path / "f.ply", columns(), {"opacity": "u1"}))


def test_a_property_that_occurs_twice_is_refused(tmp_path):
    content = write(tmp_path / "a.ply", columns(), text=True).read_text()
    (tmp_path / "b.ply").write_text(content.replace("property float y", "property float x"))
    with pytest.raises(InputError, match="has property 'x' twice"):
        load_ply(tmp_path / "b.ply")


def test_rows_that_the_header_does_not_count_are_told(tmp_path):
    for text in (False, True):
        content = write(tmp_path / "a.ply", columns(), text=text).read_bytes()
        (tmp_path / "b.ply").write_bytes(content.replace(b"vertex 4", b"vertex 2"))
        with pytest.warns(UserWarning, match="after the last row that its header counts"):
            assert len(load_ply(tmp_path / "b.ply")) == 2


def test_values_beyond_float32_are_invalid_and_long_quaternions_turn(tmp_path):
    found = columns()
    found["rot_0"][0] = 1e30
    found["y"][1] = 1e300
    write(tmp_path / "a.ply", found, dict.fromkeys(found, "f8"), order=">")
    with pytest.raises(InputError, match=r"property 'y' = 1e\+300 in row 1"):
        load_ply(tmp_path / "a.ply")
    with pytest.warns(UserWarning, match="dropped 1"):
        gaussians = load_ply(tmp_path / "a.ply", drop_invalid=True)
    np.testing.assert_allclose(
        as_splats(gaussians).factors[0], np.diag(np.exp(gaussians.log_scales[0])), rtol=1e-5, atol=1e-9
    )


def test_chunks_of_a_compressed_file_are_as_many_as_its_splats_need(tmp_path):
    gsply = pytest.importorskip("gsply")
    rng = np.random.default_rng(0)
    values = [rng.normal(size=shape) - 1 for shape in [(300, 3), (300, 3), (300, 4), (300,), (300, 1, 3)]]
    save_ply(tmp_path / "a.ply", Gaussians(*(jnp.asarray(value, jnp.float32) for value in values)))
    gsply.plywrite(tmp_path / "a.compressed.ply", gsply.plyread(tmp_path / "a.ply"), compressed=True)
    content = (tmp_path / "a.compressed.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content.replace(b"element chunk 2", b"element chunk 1"))
    with pytest.raises(InputError, match="1 chunks of 256 for 300 splats"):
        load_gaussians(tmp_path / "b.ply")
    (tmp_path / "c.ply").write_bytes(content.replace(b"\nelement", "\ncomment é\nelement".encode(), 1))
    assert len(load_gaussians(tmp_path / "c.ply")) == 300


@pytest.mark.parametrize("command", ["view", "segment", "evaluate", "run", "info"])
def test_commands_drop_invalid_gaussians_when_asked(command, capsys, monkeypatch):
    from pigjax import cli

    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["pigjax", command, "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert command == "info" or "--drop-invalid" in capsys.readouterr().out


def test_view_and_info_take_a_far_file_with_an_invalid_row(tmp_path, capsys, monkeypatch):
    from pigjax import cli

    far_cloud(tmp_path / "a.ply")
    table = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data.copy()
    table["y"][0] = np.nan
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(str(tmp_path / "a.ply"))
    for words in (["view", "--out", str(tmp_path / "a.png"), "--size", "32", "--drop-invalid"], ["info"]):
        monkeypatch.setattr(sys, "argv", ["pigjax", words[0], str(tmp_path / "a.ply"), *words[1:]])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        assert stop.value.code == 0
    assert (tmp_path / "a.png").is_file()
    assert "450000, 5400000, 0 m" in capsys.readouterr().err
