"""The ablation's instruments (benchmarks/ablation): shares counted by hand, and a reference that reproduces splats."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import pigjax as pj
from benchmarks.ablation.reference import EXACT, _components, _lattice, render_parts, split
from benchmarks.ablation.scores import holes, needles
from pigjax.core.camera import look_at
from pigjax.splat import Splats

SIZE = 0.04  # [m] of parts; the Gaussians' largest scales are 0.12


@pytest.fixture(scope="module")
def blobs():
    draw = np.random.default_rng(0)
    scales = 0.12 * np.exp(draw.uniform(-1.5, 0, (24, 3)))
    scales[:, 2] *= 0.2  # flat, as trained ones
    parts = (
        draw.normal(0, 0.25, (24, 3)),
        np.log(scales),
        draw.normal(size=(24, 4)),
        draw.uniform(-2, 5, 24),
        draw.uniform(-1.7, 1.7, (24, 1, 3)),
    )
    return pj.Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


@pytest.fixture(scope="module")
def camera():
    return look_at((2.0, 0.5, 0.7), (0.0, 0.0, 0.0), focal=75.0, width=64, height=64)


def both(blobs, camera, A):
    """The Gaussians under a uniform A in mode "covariance", and their parts."""
    n, parts = len(blobs), split(blobs, SIZE)
    moved = eqx.tree_at(lambda g: g.means, blobs, blobs.means @ A.T)
    splats = pj.eigen_clamp(moved, jnp.broadcast_to(A, (n, 3, 3)), pj.ClampParams(), mode="covariance")
    x = jnp.asarray(parts.positions(blobs)) @ A.T
    F = jnp.broadcast_to(A, (len(x), 3, 3))
    dense = render_parts(blobs, parts, x, F, moved.means, camera)
    return pj.render(splats, camera, EXACT, background=1.0), dense, len(x)


@pytest.mark.parametrize(
    ("name", "A"),
    [
        ("rest", np.eye(3)),
        ("turned", [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
        ("stretched and sheared", [[1.8, 0.6, 0.0], [0.0, 0.7, 0.3], [-0.2, 0.0, 0.6]]),
    ],
)
def test_parts_reproduce_gaussians_under_uniform_deformation(blobs, camera, name, A):
    """40 dB is one grey level in a hundred; what is left is the fit of optical depth and the pixels' filter."""
    splats, dense, count = both(blobs, camera, jnp.asarray(A, jnp.float32))
    error = float(pj.psnr(jnp.clip(splats.rgb, 0, 1), jnp.clip(dense.rgb, 0, 1)))
    print(f"\n{name}: {len(blobs)} Gaussians, {count} parts, {error:.1f} dB")
    assert count > 20 * len(blobs)
    assert error > 40


def test_lattice_has_the_covariance_it_stands_for():
    """Variances of centres and parts add up to the squared width; the cut at 3.2 σ takes 3 % away."""
    offsets, widths, weights = _lattice(0.8, (0.25, 0.5, 1.0))
    covariance = (weights[:, None, None] * offsets[:, :, None] * offsets[:, None, :]).sum(0) + np.diag(widths**2)
    np.testing.assert_allclose(covariance, 0.64 * np.eye(3), atol=0.03 * 0.64)
    np.testing.assert_allclose(weights.sum(), 1)


@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.9, 0.99])
def test_components_composite_to_the_gaussians_alpha(opacity):
    radius = np.linspace(0, 3, 31)
    widths = np.array([1.0, 0.8, 0.64, 0.5, 0.38, 0.28])
    depth = np.exp(-0.5 * (radius[:, None] / widths) ** 2) @ _components(opacity)
    # the widest miss is the peak of opaque ones, where the narrowest width is too wide
    np.testing.assert_allclose(1 - np.exp(-depth), opacity * np.exp(-0.5 * radius**2), atol=0.015)


def test_needle_shares_of_hand_made_splats():
    def splats(*lengths):
        factors = jnp.stack([jnp.diag(jnp.array(length)) for length in lengths])
        means = jnp.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
        return Splats(means, factors, jnp.ones(4), jnp.zeros((4, 1, 3)))

    rest = splats(*[[0.01, 0.01, 0.001]] * 4)
    # as it was; a needle of 8 middle axes, grown 4x; a disc grown 10x, over 5 % of the diagonal; a sliver no needle
    posed = splats([0.01, 0.01, 0.001], [0.04, 0.005, 0.001], [0.1, 0.001, 0.1], [0.02, 0.0101, 1e-5])
    shares = {name: float(value) for name, value in needles(posed, rest).items()}
    assert shares == {"needles": 0.25, "grown": 0.5, "large": 0.25}


def test_hole_and_spill_shares_of_hand_made_images():
    reference = np.zeros((10, 10), np.float32)
    reference[2:7, 2:6] = 1.0  # 20 pixels
    reference[8, 8] = 0.5  # an edge: neither silhouette nor empty
    alpha = reference.copy()
    alpha[2, 2:5] = 0.7  # three holes
    alpha[3, 2] = 0.9  # within the gap
    alpha[0, :5] = 0.3  # five of spill
    alpha[1, 0] = 0.15  # within the gap
    alpha[8, 8] = 1.0
    found = holes(jnp.asarray(alpha), jnp.asarray(reference))
    np.testing.assert_allclose([float(found["holes"]), float(found["spill"])], [3 / 20, 5 / 20])
