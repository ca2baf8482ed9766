"""Compressed files: what another package wrote comes back within the rounding of the format."""

import struct
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import load_gaussians, load_ply, save_ply
from pigjax.splat import Gaussians
from pigjax.splatting.types import as_splats

SH_CONSTANT = 0.28209479177387814


def random_gaussians(count=700, degree=1):
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    values = (
        rng.uniform(-1, 1, (count, 3)),
        rng.uniform(-5, -2, (count, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(-3, 3, count),
        rng.uniform(-0.8, 0.8, (count, (degree + 1) ** 2, 3)),
    )
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def covariances(gaussians):
    factors = np.asarray(as_splats(gaussians).factors)
    return factors @ factors.transpose(0, 2, 1)


@pytest.mark.parametrize("kind", ["compressed.ply", "spz"])
def test_files_that_gsply_wrote_come_back_within_the_rounding_of_their_format(tmp_path, kind):
    gsply = pytest.importorskip("gsply")
    truth = random_gaussians()
    save_ply(tmp_path / "truth.ply", truth)
    data = gsply.plyread(tmp_path / "truth.ply")
    if kind == "spz":
        gsply.write_spz(tmp_path / "a.spz", data)
    else:
        gsply.plywrite(tmp_path / "a.compressed.ply", data, compressed=True)
    loaded = load_gaussians(tmp_path / f"a.{kind}")
    # the compressed .ply sorts its splats along a space-filling curve
    pair = np.linalg.norm(np.asarray(loaded.means)[:, None] - np.asarray(truth.means), axis=2).argmin(1)
    assert sorted(pair) == list(range(700))
    np.testing.assert_allclose(loaded.means, truth.means[pair], atol=2e-3)
    expected = covariances(truth)[pair]
    error = np.linalg.norm(covariances(loaded) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert error.max() < 0.15
    np.testing.assert_allclose(as_splats(loaded).opacities, as_splats(truth).opacities[pair], atol=3e-3)
    np.testing.assert_allclose(loaded.sh[:, 0], truth.sh[pair, 0], atol=0.02)
    assert loaded.sh.shape == truth.sh.shape
    np.testing.assert_allclose(loaded.sh[:, 1:], truth.sh[pair, 1:], atol=0.04)


def splat_bytes(scale=0.5):
    return struct.pack("<6f8B", 1, 2, 3, scale, 0.25, 0.125, 255, 0, 51, 204, 192, 64, 128, 128)


def test_splat_records_land_in_their_fields(tmp_path):
    (tmp_path / "a.splat").write_bytes(splat_bytes() * 2)
    loaded = load_gaussians(tmp_path / "a.splat")
    assert len(loaded) == 2
    np.testing.assert_allclose(loaded.means[0], [1, 2, 3])
    np.testing.assert_allclose(np.exp(loaded.log_scales[1]), [0.5, 0.25, 0.125], rtol=1e-6)
    np.testing.assert_allclose(loaded.sh[0, 0] * SH_CONSTANT + 0.5, [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(as_splats(loaded).opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(loaded.quats[0], [0.5, -0.5, 0, 0])


def test_bad_files_are_clear_errors(tmp_path, monkeypatch):
    with pytest.raises(MissingFileError):
        load_gaussians(tmp_path / "none.splat")
    (tmp_path / "short.splat").write_bytes(splat_bytes() + b"123")
    with pytest.raises(InputError, match=r"short.splat: 35 bytes are no whole number of 32-byte splats"):
        load_gaussians(tmp_path / "short.splat")
    (tmp_path / "empty.splat").write_bytes(b"")
    with pytest.raises(InputError, match="the scene is empty"):
        load_gaussians(tmp_path / "empty.splat")
    (tmp_path / "flat.splat").write_bytes(splat_bytes(scale=0.0) + splat_bytes())
    with pytest.raises(InputError, match="scale_0"):
        load_gaussians(tmp_path / "flat.splat")
    with pytest.warns(UserWarning, match="dropped 1 splats"):
        assert len(load_gaussians(tmp_path / "flat.splat", drop_invalid=True)) == 1
    (tmp_path / "a.ksplat").write_bytes(b"")
    with pytest.raises(InputError, match=r"\.ksplat is not read; save it as \.ply"):
        load_gaussians(tmp_path / "a.ksplat")
    (tmp_path / "junk.spz").write_bytes(b"junk" * 20)
    pytest.importorskip("gsply")
    with pytest.raises(InputError, match=r"junk.spz: damaged or of another kind"):
        load_gaussians(tmp_path / "junk.spz")
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(InputError, match=r"needs gsply: pip install 'pigjax\[formats\]'"):
        load_gaussians(tmp_path / "junk.spz")


def test_a_plain_ply_needs_no_gsply(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gsply", None)
    save_ply(tmp_path / "a.ply", random_gaussians(count=3))
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.ply").means, load_ply(tmp_path / "a.ply").means)


def test_the_command_line_says_what_to_install_and_leaves_with_2(tmp_path, monkeypatch, capsys):
    from pigjax import cli

    (tmp_path / "a.spz").write_bytes(b"junk" * 20)
    monkeypatch.setitem(sys.modules, "gsply", None)
    monkeypatch.setattr(sys, "argv", ["pigjax", "info", str(tmp_path / "a.spz")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    # brackets are no markup
    assert "pip install 'pigjax[formats]'" in capsys.readouterr().err.replace("\n", "")
