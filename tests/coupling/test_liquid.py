"""Liquid surfaces: kernels from neighbours are flat on a pool and round in a drop, and rest is left alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pigjax import InputError
from pigjax.core.harmonics import sh_basis
from pigjax.coupling.liquid import SCHLICK, liquid_kernels, liquid_rest, sheen, smoothed

DX = 0.02


def lattice(nx, ny, nz, seed=0):
    points = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), np.arange(nz), indexing="ij"), -1).reshape(-1, 3)
    return DX / 2 * (points + np.random.default_rng(seed).uniform(-0.2, 0.2, points.shape))


def ratios(shapes):
    lengths = np.linalg.eigvalsh(shapes)
    return lengths[:, -1] / lengths[:, 0]


def test_kernel_deep_in_the_fluid_is_a_unit_ball():
    x = lattice(13, 13, 13)
    middle = np.argmin(np.linalg.norm(x - x.mean(0), axis=1))
    lengths = np.linalg.eigvalsh(liquid_kernels(x, dx=DX).shapes[middle])
    np.testing.assert_allclose(lengths, 1, atol=0.12)  # 74 jittered samples of a ball


def test_pool_has_flat_kernels_with_upright_normals_and_is_smoother():
    x = lattice(22, 22, 7)
    kernels = liquid_kernels(x, dx=DX)
    edge = 0.06
    top = (x[:, 2] > x[:, 2].max() - 0.4 * DX) & (np.abs(x[:, :2] - x[:, :2].mean(0)) < 0.11 - edge).all(1)
    assert top.sum() > 50
    assert (kernels.normals[top, 2] > 0.95).all()
    lengths, axes = np.linalg.eigh(kernels.shapes[top])
    assert (np.abs(axes[:, 2, 0]) > 0.95).all()  # the shortest axis is upright
    assert (lengths[:, 0] < 0.6 * lengths[:, 1]).all()
    assert np.std(kernels.centres[top, 2]) < 0.65 * np.std(x[top, 2])  # 0.61: the centre is within the window


def test_small_drop_and_lone_particle_are_round():
    points = lattice(9, 9, 9)
    drop = points[np.linalg.norm(points - points.mean(0), axis=1) < 0.6 * DX]
    lone = points.mean(0)[None] + [[0.5, 0.0, 0.0]]
    kernels = liquid_kernels(np.concatenate([drop, lone]), dx=DX)
    np.testing.assert_allclose(kernels.shapes[-1], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(kernels.centres[-1:], lone)
    assert np.median(ratios(kernels.shapes[:-1])) < 2
    mean = kernels.shapes.mean(0)
    assert ratios(mean[None])[0] < 1.2


def test_rest_and_rigid_motion_are_those_of_the_matter():
    x = lattice(8, 7, 6)
    rest = liquid_rest(x, dx=DX)
    F = np.broadcast_to(np.eye(3), (len(x), 3, 3)).copy()
    still, same = smoothed(x, F, rest, dx=DX)
    np.testing.assert_allclose(still, x, atol=1e-12)
    np.testing.assert_allclose(same, F, atol=1e-9)
    R = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    there, turned = smoothed(x @ R.T + 1.0, R @ F, rest, dx=DX)
    np.testing.assert_allclose(there, x @ R.T + 1.0, atol=1e-9)
    np.testing.assert_allclose(turned, R @ F, atol=1e-6)


def test_surface_that_turns_over_takes_its_normals_along():
    """A block whose matter moved without turning lies on another side: offsets along the normal follow the surface."""
    x = lattice(14, 14, 5)
    rest = liquid_rest(x, dx=DX)
    R = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()
    F = np.broadcast_to(np.eye(3), (len(x), 3, 3))  # the fluid's own record knows of no turn
    _, turned = smoothed(x @ R.T, F, rest, dx=DX)
    top = (x[:, 2] > x[:, 2].max() - 0.4 * DX) & (np.abs(x[:, :2] - x[:, :2].mean(0)) < 0.03).all(1)
    turned_up = turned[top] @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(turned_up @ (R @ [0.0, 0.0, 1.0]), 1, atol=0.15)


def test_lost_particles_do_not_spoil_the_others():
    x = lattice(6, 6, 6)
    F = np.broadcast_to(np.eye(3), (len(x), 3, 3)).copy()
    rest = liquid_rest(x, dx=DX)
    x = x.copy()
    x[3], F[3] = np.nan, np.nan
    there, turned = smoothed(x, F, rest, dx=DX)
    good = np.arange(len(x)) != 3
    assert np.isfinite(there[good]).all()
    assert np.isfinite(turned[good]).all()
    assert np.isnan(there[3]).all()


def test_sheen_is_the_part_of_schlicks_curve_that_leaves_the_colour_along_the_normal():
    c, w = np.polynomial.legendre.leggauss(40)
    c, w = (c + 1) / 2, w / 2  # both signs of c give the same
    curve, span = (1 - c) ** 5, 1 - c**2
    nearest = (w * curve * span).sum() / (w * span**2).sum()
    assert nearest == pytest.approx(SCHLICK, rel=1e-12)
    rng = np.random.default_rng(1)
    normals, d = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 200, 3)))
    strength = rng.uniform(size=200)
    seen = np.einsum("nk,nk->n", np.asarray(sh_basis(d, 2)), sheen(normals, strength))
    np.testing.assert_allclose(seen, strength * nearest * (1 - (normals * d).sum(1) ** 2), atol=1e-6)
    np.testing.assert_allclose(sheen(-normals, strength), sheen(normals, strength), atol=1e-7)
    assert not sheen(normals, 0 * strength).any()


def test_wrong_arguments_are_named():
    x = lattice(3, 3, 3)
    with pytest.raises(InputError, match="dx"):
        liquid_kernels(x, dx=0.0)
    with pytest.raises(InputError, match="at rest"):
        smoothed(x[1:], np.tile(np.eye(3), (len(x) - 1, 1, 1)), liquid_rest(x, dx=DX), dx=DX)
