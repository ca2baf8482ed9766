from pathlib import Path

import jax
import numpy as np
import pytest
from shapes import ball, box, make_gaussians, sphere, torus

from pigjax.core.errors import InputError
from pigjax.coupling.filling import fill_interior
from pigjax.coupling.solid import shell_of, solid_of
from pigjax.splat import Gaussians

BALL = 4 / 3 * np.pi


def solid(means, **kwargs):
    return solid_of(shell_of(make_gaussians(means, **kwargs)))


@pytest.mark.parametrize(
    ("means", "volume", "tolerance"),
    [
        (sphere(10_000), BALL, 0.01),
        (sphere(1_000), BALL, 0.012),  # 2.9 % off without the correction for curvature
        (box(10_000), 1.05, 0.01),
        (torus(10_000), 2 * np.pi**2 * 0.35**2, 0.02),
        (sphere(4_000, 1e-3) + 5, BALL * 1e-9, 0.02),
        (sphere(4_000, 1e3), BALL * 1e9, 0.02),
    ],
    ids=["sphere", "sparse sphere", "box", "torus", "tiny and far off", "huge"],
)
def test_volume_inside_a_closed_shell(x64, means, volume, tolerance):
    assert solid(means, scales=1e-6).volume == pytest.approx(volume, rel=tolerance)


@pytest.mark.parametrize(
    ("means", "volume"),
    [
        (box(10_000, without_bottom=True), 1.05),
        (sphere(10_000)[sphere(10_000)[:, 2] > -0.8], BALL - np.pi * 0.2**2 * (3 - 0.2) / 3),
        (sphere(20_000)[sphere(20_000)[:, 2] > 0], BALL / 2),
    ],
    ids=["box without bottom", "sphere without cap", "hemisphere"],
)
def test_a_shell_that_is_open_on_one_side_is_closed_by_a_flat_lid(means, volume):
    # 5 %: the rim is known to about half a voxel, which the hemisphere's whole base feels
    assert solid(means).volume == pytest.approx(volume, rel=0.05)


@pytest.mark.parametrize("count", [3_000, 20_000])
def test_a_cloud_filled_with_gaussians_keeps_its_volume(count):
    assert solid(ball(count)).volume == pytest.approx(BALL, rel=0.03)


def test_strays_within_a_reconstructed_shell_do_not_make_it_a_filled_cloud():
    # the bundled scene's duck: of the 47 voxels deep within its shell, 13 hold splats that no view could forbid
    data = np.load(Path(__file__).parents[1] / "data/tabletop_duck.npz")
    duck = Gaussians(**data, sh=np.zeros((len(data["means"]), 1, 3)))
    box_of_centres = np.prod(np.ptp(data["means"], axis=0))
    assert 0.25 * box_of_centres < solid_of(shell_of(duck)).volume < 0.5 * box_of_centres


def test_a_few_large_flat_gaussians_make_a_shell():
    # 6x6 flat Gaussians on each face of a unit cube: neighbours are two standard deviations apart
    u = (np.arange(6) + 0.5) / 6
    means, quats = [], []
    half = np.sqrt(0.5)
    for axis, quat in enumerate([(half, 0, half, 0), (half, half, 0, 0), (1, 0, 0, 0)]):
        for side in (0.0, 1.0):
            face = np.stack([*np.meshgrid(u, u)], -1).reshape(-1, 2)
            means.append(np.insert(face, axis, side, 1))
            quats.append(np.tile(quat, (36, 1)))
    flat = solid(np.concatenate(means), quats=np.concatenate(quats), scales=[1 / 12, 1 / 12, 1e-4])
    # 10 %: twelve voxels along the side, so each edge is rounded by one of them
    assert flat.volume == pytest.approx(1.0, rel=0.1)


def test_filled_points_lie_inside_and_share_the_volume():
    gaussians = make_gaussians(sphere(8_000))
    points = fill_interior(gaussians, spacing=0.1, particles_per_cell=8)
    radius = np.linalg.norm(points.positions, axis=1)
    assert radius.max() < 1.005
    assert points.volumes.sum() == pytest.approx(BALL, rel=0.01)
    assert points.volumes.min() > 0.2 * 0.05**3
    assert len(points.positions) * 0.1**3 / 8 == pytest.approx(BALL, rel=0.03)
    # uniform: each octant holds its eighth
    octants = np.bincount((points.positions > 0) @ [1, 2, 4], points.volumes)
    np.testing.assert_allclose(octants, BALL / 8, rtol=0.03)


def test_points_per_cell_and_seed_are_chosen_by_the_user():
    gaussians = make_gaussians(sphere(2_000))
    one, again, other, dense = (
        fill_interior(gaussians, spacing=0.2, seed=seed, particles_per_cell=count)
        for seed, count in [(0, 1), (0, 1), (1, 1), (0, 27)]
    )
    np.testing.assert_array_equal(one.positions, again.positions)
    assert not np.array_equal(one.positions, other.positions)
    assert len(dense.positions) == pytest.approx(27 * len(one.positions), rel=0.05)


def test_huge_radii_and_floaters_change_nothing():
    means = sphere(4_000)
    scales = np.full((4_000, 3), 2e-3)
    scales[::100] = 1e9
    reference = solid(means).volume
    assert solid(means, scales=scales).volume == pytest.approx(reference, rel=0.01)
    floating = np.concatenate([means, [[1e3, 0, 0], [0, 0, 1e9], [0, 3, 0]]])
    # 1 %: float32 means lose nothing near the origin, but medians shift
    assert solid(floating).volume == pytest.approx(reference, rel=0.01)
    assert shell_of(make_gaussians(floating)).connected.sum() == 4_000


def test_what_encloses_nothing_has_no_inside():
    rng = np.random.default_rng(0)
    sheet, line = rng.random((2, 2_000, 3))
    sheet[:, 2] = 0
    line[:, 1:] = 0
    for means in (sheet, line, np.zeros((20, 3)), np.zeros((1, 3)), sphere(3)):
        assert solid(means).volume < 1e-3


@pytest.mark.parametrize("turn", [0.3, 1.1])
def test_volume_does_not_depend_on_how_the_object_is_turned(turn):
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    assert solid(box(8_000) @ rotation.T).volume == pytest.approx(1.05, rel=0.02)


def test_bad_input_is_named():
    gaussians = make_gaussians(sphere(500))
    with pytest.raises(InputError, match=r"spacing = 0\.0"):
        fill_interior(gaussians, spacing=0.0)
    with pytest.raises(InputError, match="refine"):
        fill_interior(gaussians, spacing=50.0)
    with pytest.raises(InputError, match="coarsen"):
        fill_interior(gaussians, spacing=1e-4)
    with pytest.raises(InputError, match="no Gaussians"):
        shell_of(jax.tree.map(lambda a: a[:0], gaussians))
    with pytest.raises(InputError, match="1 means"):
        shell_of(make_gaussians(np.concatenate([sphere(10), [[np.nan, 0, 0]]])))
