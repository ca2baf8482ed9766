"""PLY: hand-made bytes as oracle, exact round trips, and one clear error per kind of bad file."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import plyfile
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_ply, load_points, read_ply, save_ply
from pigjax.splat import Gaussians


def random_gaussians(seed=0, count=5, degree=3):
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    return Gaussians(*(rng.standard_normal(shape).astype(np.float32) for shape in shapes))


def handmade(path, *, count=2, drop=(), change=None, degree=1):
    """A binary PLY written by struct in INRIA's order; row r, property i holds 100 r + i + 0.5."""
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4)), "extra"]
    header = f"ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex {count}\n"
    header += "".join(f"property float {name}\n" for name in names if name not in drop) + "end_header\n"
    values = {(row, name): 100 * row + i + 0.5 for row in range(count) for i, name in enumerate(names)}
    values.update(change or {})
    kept = [value for (_, name), value in values.items() if name not in drop]
    path.write_bytes(header.encode() + struct.pack(f"<{len(kept)}f", *kept))
    return path


def test_handmade_bytes_land_in_their_fields(tmp_path):
    gaussians = load_ply(handmade(tmp_path / "a.ply"))
    np.testing.assert_array_equal(gaussians.means, [[0.5, 1.5, 2.5], [100.5, 101.5, 102.5]])
    # 3 positions and 3 normals precede f_dc; f_rest holds 3 reds, 3 greens, 3 blues of bands 1 to 3
    expected = [[6.5, 7.5, 8.5], [9.5, 12.5, 15.5], [10.5, 13.5, 16.5], [11.5, 14.5, 17.5]]
    np.testing.assert_array_equal(gaussians.sh[0], expected)
    np.testing.assert_array_equal(gaussians.logit_opacities, [18.5, 118.5])
    np.testing.assert_array_equal(gaussians.log_scales[0], [19.5, 20.5, 21.5])
    np.testing.assert_array_equal(gaussians.quats[1], [122.5, 123.5, 124.5, 125.5])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ascii", [False, True])
def test_round_trip_is_bitwise(tmp_path, degree, ascii):
    gaussians = random_gaussians(degree, degree=degree)
    save_ply(tmp_path / "a.ply", gaussians, ascii=ascii)
    again = load_ply(tmp_path / "a.ply")
    for before, after in zip(jax.tree.leaves(gaussians), jax.tree.leaves(again), strict=True):
        assert before.dtype == after.dtype == jnp.float32
        assert np.asarray(before).tobytes() == np.asarray(after).tobytes()


@settings(deadline=None, max_examples=25)
@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=3, max_size=3), st.booleans())
def test_any_finite_float32_survives(tmp_path_factory, values, ascii):
    path = tmp_path_factory.mktemp("any") / "a.ply"
    gaussians = random_gaussians(count=1, degree=0)
    mean = np.asarray([values], np.float32)
    save_ply(path, Gaussians(mean, *jax.tree.leaves(gaussians)[1:]), ascii=ascii)
    assert np.asarray(load_ply(path).means).tobytes() == mean.tobytes()


def test_another_library_reads_what_is_saved(tmp_path):
    gaussians = random_gaussians(degree=2)
    save_ply(tmp_path / "a.ply", gaussians)
    vertex = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    names = [prop.name for prop in vertex.properties]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[-8:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    # 8 higher bands per channel: band 3, green is f_rest_(8 + 2)
    np.testing.assert_array_equal(vertex["f_rest_10"], gaussians.sh[:, 3, 1])


def test_big_endian_and_double_properties_are_read(tmp_path):
    gaussians = random_gaussians(degree=0)
    save_ply(tmp_path / "a.ply", gaussians)
    table = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    double = table.astype([(name, "f8") for name in table.dtype.names])
    plyfile.PlyData([plyfile.PlyElement.describe(double, "vertex")], byte_order=">").write(str(tmp_path / "b.ply"))
    np.testing.assert_array_equal(load_ply(tmp_path / "b.ply").quats, gaussians.quats)


def test_float64_state_is_saved_and_float32_comes_back(tmp_path, x64):
    gaussians = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), random_gaussians(degree=0))
    save_ply(tmp_path / "a.ply", gaussians)
    assert {leaf.dtype for leaf in jax.tree.leaves(load_ply(tmp_path / "a.ply"))} == {jnp.dtype("float32")}


def test_invalid_splats_are_dropped_and_counted(tmp_path):
    change = {(1, "y"): np.nan, (2, "opacity"): np.nan, **{(3, f"rot_{i}"): 0.0 for i in range(4)}}
    path = handmade(tmp_path / "a.ply", count=5, change=change)
    gaussians, dropped = read_ply(path, drop_invalid=True)
    assert dropped == 3
    np.testing.assert_array_equal(gaussians.means[:, 0], [0.5, 400.5])
    with pytest.warns(UserWarning, match=r"a\.ply: dropped 3 splats"):
        load_ply(path, drop_invalid=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({(1, "f_dc_1"): np.nan}, r"a\.ply: property 'f_dc_1' = nan in row 1 \(1 such rows\).*drop_invalid"),
        ({(0, "scale_2"): -np.inf}, r"a\.ply: property 'scale_2' = -inf in row 0.*drop_invalid"),
        ({(1, f"rot_{i}"): 0.0 for i in range(4)}, r"a\.ply: rot_0..3 is a zero quaternion in row 1.*drop_invalid"),
    ],
)
def test_invalid_values_are_named(tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        load_ply(handmade(tmp_path / "a.ply", change=change))


@pytest.mark.parametrize("name", ["x", "opacity", "f_dc_2", "scale_0", "rot_3"])
def test_missing_property_is_named(tmp_path, name):
    with pytest.raises(InputError, match=rf"a\.ply: property '{name}' is missing"):
        load_ply(handmade(tmp_path / "a.ply", drop=(name,)))


def test_broken_harmonics_are_counted(tmp_path):
    with pytest.raises(InputError, match=r"has 8 f_rest properties.*SH degree 0 to 3"):
        load_ply(handmade(tmp_path / "a.ply", drop=("f_rest_8",)))


def test_missing_file(tmp_path):
    with pytest.raises(MissingFileError, match=r"none\.ply: no such PLY file"):
        load_ply(tmp_path / "none.ply")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"ply\nformat nonsense\n", b"ply\r\n\xff\xfe\n"])
def test_not_a_ply(tmp_path, content):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.ply: not a PLY file"):
        load_ply(tmp_path / "a.ply")


def test_folder_is_not_a_ply(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_ply(tmp_path)


@pytest.mark.parametrize("ascii", [False, True])
@pytest.mark.parametrize("keep", [0.5, 0.97])
def test_truncated_ply(tmp_path, ascii, keep):
    save_ply(tmp_path / "a.ply", random_gaussians(count=50, degree=0), ascii=ascii)
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content[: int(keep * len(content))])
    with pytest.raises(InputError, match=r"a\.ply: the PLY file is truncated or damaged"):
        load_ply(tmp_path / "a.ply")


def test_empty_scene(tmp_path):
    with pytest.raises(InputError, match=r"a\.ply: the scene is empty"):
        load_ply(handmade(tmp_path / "a.ply", count=0))
    with pytest.raises(InputError, match=r"a\.ply: the scene is empty \(1 splats, none valid\)"):
        load_ply(handmade(tmp_path / "a.ply", count=1, change={(0, "x"): np.nan}), drop_invalid=True)


def test_no_vertices_element(tmp_path):
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n")
    with pytest.raises(InputError, match="has no element 'vertex'"):
        load_ply(tmp_path / "a.ply")


def test_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=r"file is a file, where a folder is needed"):
        save_ply(tmp_path / "file" / "a.ply", random_gaussians())


def test_points_of_bytes_and_floats(tmp_path):
    rows = "1 2 3 255 0 51\n4 5 6 0 255 102\n"
    for kind, body in (("uchar", rows), ("float", "1 2 3 1 0 0.2\n4 5 6 0 1 0.4\n")):
        colours = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        (tmp_path / "p.ply").write_text(header + colours + "end_header\n" + body)
        xyz, rgb = load_points(tmp_path / "p.ply")
        np.testing.assert_array_equal(xyz, [[1, 2, 3], [4, 5, 6]])
        np.testing.assert_allclose(rgb, [[1, 0, 0.2], [0, 1, 0.4]], rtol=1e-6)


def test_points_without_colour_or_rows_are_named(tmp_path):
    with pytest.raises(InputError, match="property 'red' is missing"):
        load_points(handmade(tmp_path / "a.ply"))
    header = "ply\nformat ascii 1.0\nelement vertex 0\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    (tmp_path / "b.ply").write_text(header + "end_header\n")
    with pytest.raises(InputError, match="holds no points"):
        load_points(tmp_path / "b.ply")
