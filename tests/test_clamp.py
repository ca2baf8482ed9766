"""The eigen-clamp: each trap of matching axes, bounding scales and differentiating them has its own law here."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pigjax.clamp import ClampParams, eigen_clamp
from pigjax.core.errors import InputError
from pigjax.splat import Gaussians

EPS = np.finfo(np.float32).eps
COUNT = 200
MODES = ("aligned", "literal", "covariance", "fixed")
UNBOUNDED = (1e-6, 1e6)
pose = jax.jit(eigen_clamp, static_argnames="mode")


def transpose(matrices):
    return np.swapaxes(matrices, -1, -2)


def make_gaussians(rotations, scales, sh_count=4):
    count = len(scales)
    quats = np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=-1)
    parts = np.zeros((count, 3)), np.log(scales), quats, np.linspace(-2, 2, count), np.zeros((count, sh_count, 3))
    return Gaussians(*(jnp.asarray(part, jnp.result_type(float)) for part in parts))


def random_rotations(seed, count=COUNT):
    return Rotation.random(count, random_state=seed).as_matrix()


def random_scales(seed=1, ratio=1e4):
    return 0.1 * 10 ** -np.random.default_rng(seed).uniform(0, np.log10(ratio), (COUNT, 3))


def stretches(seed=2, low=0.6, high=1.7):
    """Deformation gradients with singular values between the bounds, as JAX array and as float64."""
    values = np.random.default_rng(seed).uniform(low, high, (COUNT, 3))
    matrices = random_rotations(seed) * values[:, None, :] @ random_rotations(seed + 1)
    return jnp.asarray(matrices), matrices


def covariances(splats_or_factors):
    factors = np.asarray(getattr(splats_or_factors, "factors", splats_or_factors), np.float64)
    return factors @ transpose(factors)


def rest_covariances(rotations, scales):
    return rotations * scales[:, None, :] ** 2 @ transpose(rotations)


def errors(ours, expected):
    return np.linalg.norm(ours - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))


def error(ours, expected):
    return errors(ours, expected).max()


def identities(count=COUNT):
    return jnp.broadcast_to(jnp.eye(3), (count, 3, 3))


@pytest.mark.parametrize("mode", ["aligned", "covariance"])
def test_rigid_motion_leaves_clamped_shape_unchanged(mode):
    rotations, scales, turn = random_rotations(0), random_scales(), random_rotations(9)
    splats = pose(make_gaussians(rotations, scales), jnp.asarray(turn), ClampParams(), mode=mode)
    figure = error(covariances(splats), rest_covariances(turn @ rotations, scales))
    print(f"\n{mode}: covariance error under rigid F {figure:.1e}")
    assert figure < 16 * EPS


def test_literal_reading_breaks_under_rigid_motion():
    """Why axes must be matched: differences of unmatched axes deform a Gaussian that only turned."""
    rotations, scales, turn = random_rotations(0), random_scales(ratio=5.0), random_rotations(9)
    splats = pose(make_gaussians(rotations, scales), jnp.asarray(turn), ClampParams(), mode="literal")
    expected = rest_covariances(turn @ rotations, scales)
    figure = np.mean(
        np.linalg.norm(covariances(splats) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    )
    print(f"\nliteral: mean covariance error under rigid F {figure:.2f}")
    assert figure > 0.2


@pytest.mark.parametrize("mode", ["aligned", "covariance", "fixed"])
@pytest.mark.parametrize(
    "params",
    [ClampParams(), ClampParams(1.5, 1.6), ClampParams(0.01, 0.02, relative=False), ClampParams(0.5, 2.0, 0.3, 1.5)],
    ids=["default", "rest outside tau", "absolute, rest outside tau", "weights"],
)
def test_matter_at_rest_returns_the_input(mode, params):
    rotations, scales = random_rotations(0), random_scales()
    gaussians = make_gaussians(rotations, scales)
    splats = pose(gaussians, identities(), params, mode=mode)
    assert error(covariances(splats), rest_covariances(rotations, scales)) < 16 * EPS
    np.testing.assert_array_equal(splats.means, gaussians.means)
    np.testing.assert_allclose(splats.opacities, jax.nn.sigmoid(gaussians.logit_opacities))
    np.testing.assert_array_equal(splats.sh, gaussians.sh)


@pytest.mark.parametrize("mode", ["aligned", "covariance"])
def test_clamped_shape_turns_with_a_rotation_after_the_stretch(mode):
    turn = random_rotations(9)
    F, exact = stretches()
    gaussians = make_gaussians(random_rotations(0), random_scales(ratio=30.0))
    before = covariances(pose(gaussians, F, ClampParams(), mode=mode))
    after = covariances(pose(gaussians, jnp.asarray(turn @ exact), ClampParams(), mode=mode))
    # float32 moves axes of nearly equal scales by eps over their relative gap
    assert error(after, turn @ before @ transpose(turn)) < 1e-4


RELABELLINGS = {
    "cyclic": np.eye(3)[[1, 2, 0]],
    "two negated": np.diag([-1.0, 1.0, -1.0]),
    "exchanged": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]),
}


@pytest.mark.parametrize("relabelling", RELABELLINGS.values(), ids=RELABELLINGS)
@pytest.mark.parametrize("mode", ["aligned", "covariance", "fixed"])
def test_permuted_or_negated_axes_give_the_same_covariance(mode, relabelling):
    rotations, scales = random_rotations(0), random_scales(ratio=30.0)
    F, _ = stretches(low=0.3, high=3.0)
    one = pose(make_gaussians(rotations, scales), F, ClampParams(), mode=mode)
    other = pose(make_gaussians(rotations @ relabelling, scales @ np.abs(relabelling)), F, ClampParams(), mode=mode)
    assert error(covariances(other), covariances(one)) < 1e-4


@pytest.mark.usefixtures("x64")
def test_full_weights_without_bounds_are_the_transported_covariance():
    rotations, scales = random_rotations(0), random_scales()
    F, exact = stretches(low=0.2, high=4.0)
    expected = exact @ rest_covariances(rotations, scales) @ transpose(exact)
    gaussians = make_gaussians(rotations, scales)
    assert error(covariances(pose(gaussians, F, ClampParams(), mode="covariance")), expected) < 1e-12
    aligned = pose(gaussians, F, ClampParams(*UNBOUNDED, 1.0, 1.0))
    assert error(covariances(aligned), expected) < 1e-12


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("shear", [0.1, 0.6, 1.5])
@pytest.mark.parametrize("weight", [0.0, 0.5, 1.2, 1.5])
def test_simple_shear_turns_axes_by_the_closed_form_angle(shear, weight):
    """In the plane: polar angle -atan(shear / 2), principal axis of M Mᵀ, and the angle of 1 - λ + λ exp(iθ)."""
    scales = np.array([0.2, 0.05, 0.1])
    F = np.array([[1, shear, 0], [0, 1, 0], [0, 0, 1.0]])
    covariance = F @ np.diag(scales**2) @ F.T
    principal = 0.5 * np.arctan2(2 * covariance[0, 1], covariance[0, 0] - covariance[1, 1])
    carried = -np.arctan(shear / 2)
    angle = carried + np.angle(1 - weight + weight * np.exp(1j * (principal - carried)))
    stretched = np.sqrt(np.linalg.eigvalsh(covariance)[::-1])[[0, 2, 1]]
    expected = scales + 0.8 * (np.clip(stretched, 0.7 * scales, 1.3 * scales) - scales)
    assert stretched[1] < scales[1]

    gaussian = make_gaussians(np.eye(3)[None], scales[None])
    factors = pose(gaussian, jnp.asarray(F[None]), ClampParams(0.7, 1.3, weight, 0.8)).factors[0]
    np.testing.assert_allclose(jnp.linalg.norm(factors, axis=0), expected, rtol=1e-12)
    rotation = Rotation.from_euler("z", angle).as_matrix()
    np.testing.assert_allclose(factors, rotation * expected, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_literal_mode_is_the_printed_formula():
    rotations, scales = random_rotations(0), random_scales(ratio=30.0)
    F, exact = stretches()
    M = exact @ (rotations * scales[:, None, :])
    values, axes = np.linalg.eigh(M @ transpose(M))
    values, axes = np.sqrt(values[:, ::-1]), axes[:, :, ::-1]
    splats = pose(make_gaussians(rotations, scales), F, ClampParams(*UNBOUNDED, 1.2, 0.8), mode="literal")
    scaled = scales + 0.8 * (values - scales)
    turned = np.asarray(splats.factors) / scaled[:, None, :]
    recovered = (turned - rotations) / 1.2 + rotations
    # the formula leaves the sign of an eigenvector open
    np.testing.assert_allclose(np.abs((recovered * axes).sum(1)), 1.0, atol=1e-6)


@pytest.mark.parametrize("ratio", [1e2, 1e4])
def test_float32_holds_thin_shapes(ratio):
    """Each scale, however thin, to 2e-5: a few eps times the conditioning of F, which spans 4."""
    rotations, scales = random_rotations(0), random_scales(ratio=ratio)
    F, _ = stretches(low=0.5, high=2.0)
    gaussians = make_gaussians(rotations, scales)
    single = np.linalg.svd(np.asarray(pose(gaussians, F, ClampParams()).factors, np.float64), compute_uv=False)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), (gaussians, F))
        double = np.linalg.svd(np.asarray(pose(*wide, ClampParams()).factors), compute_uv=False)
    figure = np.abs(single / double - 1).max()
    print(f"\nratio {ratio:.0e}: relative error of the scales in float32 {figure:.1e}")
    assert figure < 2e-5


ORDINARY = (
    np.array([[1.1, 0.3, -0.2], [0.1, 0.7, 0.4], [-0.3, 0.2, 1.9]]),
    np.array([0.8, 0.1, -0.4, 0.3]),
    np.log([0.2, 0.05, 0.1]),
)


@partial(jax.jit, static_argnums=(0, 1))
def shape(mode, relative, F, quats, log_scales, tau_min, tau_max, lambda_R, lambda_S):
    """Covariance and colour rotation of one Gaussian."""
    one = jnp.zeros((1, 3)), log_scales[None], quats[None], jnp.zeros(1), jnp.zeros((1, 4, 3))
    params = ClampParams(tau_min, tau_max, lambda_R, lambda_S, relative)
    splats = eigen_clamp(Gaussians(*one), F[None], params, mode=mode)
    return splats.factors @ jnp.swapaxes(splats.factors, -1, -2), splats.sh_rotations


@partial(jax.jit, static_argnums=(0, 1))
def slope(mode, relative, inputs, direction):
    return jax.jvp(partial(shape, mode, relative), inputs, direction)[1]


@partial(jax.jit, static_argnums=0)
def gradient(mode, inputs):
    return jax.grad(lambda x: sum(jnp.sin(10 * y).sum() for y in jax.tree.leaves(shape(mode, True, *x))))(inputs)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(
    ("mode", "relative", "taus"),
    [
        ("aligned", True, (0.8, 1.25)),
        pytest.param("aligned", False, (0.04, 0.25), marks=pytest.mark.slow),
        pytest.param("literal", True, (0.8, 1.25), marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_central_differences(mode, relative, taus):
    """To F, quats, log_scales, tau_min, tau_max, lambda_R and lambda_S in turn; step 1e-6 leaves 1e-12 / 1e-6."""
    inputs = tuple(jnp.asarray(x) for x in (*ORDINARY, *taus, 1.2, 0.8))
    random, step = np.random.default_rng(5), 1e-6
    for chosen in range(len(inputs)):
        direction = [jnp.zeros_like(x) for x in inputs]
        direction[chosen] = jnp.asarray(random.normal(size=inputs[chosen].shape))
        plus, minus = (shape(mode, relative, *(x + h * d for x, d in zip(inputs, direction))) for h in (step, -step))
        slopes = jax.tree.leaves(slope(mode, relative, inputs, tuple(direction)))
        for ours, above, below in zip(slopes, jax.tree.leaves(plus), jax.tree.leaves(minus)):
            np.testing.assert_allclose(ours, (above - below) / (2 * step), atol=1e-7, rtol=1e-6)
        assert max(np.abs(leaf).max() for leaf in slopes) > 1e-4, "each input should be felt at the point tested"


@pytest.mark.parametrize("mode", MODES)
def test_derivatives_are_finite_at_every_point(mode):
    deformations = {
        "rest": np.eye(3),
        "turned": random_rotations(3, 1)[0],
        "inverted": np.diag([1.0, 1.0, -0.5]),
        "inside out": -np.eye(3),
        "flat": np.diag([1.0, 1.0, 0.0]),
        "line": np.diag([1.0, 0.0, 0.0]),
        "zero": np.zeros((3, 3)),
        "at the bounds": np.diag([0.5, 2.0, 1.0]),
    }
    scales = {"isotropic": [0.1, 0.1, 0.1], "two equal": [0.1, 0.1, 0.02], "thin": [0.1, 1e-3, 1e-5]}
    for name, F in deformations.items():
        for kind, values in scales.items():
            for quats in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5]):
                inputs = (F, quats, np.log(values), 0.5, 2.0, 1.2, 0.8)
                inputs = tuple(jnp.asarray(x, jnp.float32) for x in inputs)
                along_ones = slope(mode, True, inputs, jax.tree.map(jnp.ones_like, inputs))
                derivatives = jax.tree.leaves((along_ones, gradient(mode, inputs)))
                assert all(np.isfinite(leaf).all() for leaf in derivatives), f"{name}, {kind}"


def test_inverted_matter_keeps_proper_axes_and_bounded_scales():
    scales = random_scales()
    F, _ = stretches()
    mirrored = F * jnp.asarray([1.0, 1.0, -1.0])
    factors = np.asarray(pose(make_gaussians(random_rotations(0), scales), mirrored, ClampParams()).factors, np.float64)
    lengths = np.linalg.norm(factors, axis=1)
    np.testing.assert_allclose(np.linalg.det(factors / lengths[:, None, :]), 1.0, atol=16 * EPS)
    assert (lengths >= 0.5 * scales * (1 - 8 * EPS)).all()


def test_full_scale_weight_keeps_scales_within_bounds():
    scales = random_scales()
    F, _ = stretches(low=0.05, high=20.0)
    params = ClampParams(0.5, 2.0, 1.2, 1.0)
    lengths = np.linalg.norm(pose(make_gaussians(random_rotations(0), scales), F, params).factors, axis=1)
    assert (lengths >= 0.5 * scales * (1 - 8 * EPS)).all()
    assert (lengths <= 2.0 * scales * (1 + 8 * EPS)).all()
    assert np.mean(lengths > 1.99 * scales) > 0.1, "the upper bound should be reached"

    absolute = ClampParams(0.01, 0.05, 1.2, 1.0, relative=False)
    lengths = np.linalg.norm(pose(make_gaussians(random_rotations(0), scales), F, absolute).factors, axis=1)
    assert (lengths >= np.minimum(0.01, scales) * (1 - 8 * EPS)).all()
    assert (lengths <= np.maximum(0.05, scales) * (1 + 8 * EPS)).all()


def test_scales_stay_positive_at_weights_above_one():
    """S + 1.5 (0.05 S - S) would be negative; a thousandth of the clamped scale remains."""
    scales, params = random_scales(), ClampParams(0.01, 2.0, 1.5, 1.5)
    splats = pose(make_gaussians(random_rotations(0), scales), 0.05 * identities(), params)
    np.testing.assert_allclose(np.linalg.norm(splats.factors, axis=1), 5e-5 * scales, rtol=1e-5)


def test_axes_of_inverted_matter_are_matched_to_the_nearest_side():
    """Thin Gaussians, tilted by 0.1 rad, in matter inverted along another axis than their thin one.

    M and F then flip different axes; with the sides matched, half the weight still leaves half of the tilt.
    """
    tilts = Rotation.from_rotvec(0.1 * random_rotations(3)[:, 0]).as_matrix()
    scales = np.broadcast_to([0.01, 0.2, 0.1], (COUNT, 3))
    F = random_rotations(9) @ np.diag([1.0, 1.1, -0.5])
    expected = F @ rest_covariances(tilts, scales) @ transpose(F)

    def remaining(weight):
        params = ClampParams(*UNBOUNDED, weight, 1.0)
        return errors(covariances(pose(make_gaussians(tilts, scales), jnp.asarray(F), params)), expected).mean()

    assert remaining(0.5) < 0.55 * remaining(0.0)


def test_weights_can_be_swept_by_vmap():
    weights = jnp.linspace(0.0, 1.5, 8)
    grid = jnp.meshgrid(weights, weights)
    params = ClampParams(jnp.full(64, 0.5), jnp.full(64, 2.0), grid[0].ravel(), grid[1].ravel())
    gaussians, (F, _) = make_gaussians(random_rotations(0), random_scales()), stretches()
    swept = jax.jit(jax.vmap(lambda p: eigen_clamp(gaussians, F, p).factors))(params)
    for k in (0, 27, 63):
        single = pose(gaussians, F, jax.tree.map(lambda x, k=k: x[k], params)).factors
        assert error(covariances(swept[k]), covariances(single)) < 1e-4


def test_new_weights_do_not_recompile():
    traces = []
    counted = jax.jit(lambda g, F, p: (traces.append(1), eigen_clamp(g, F, p).factors)[1])
    gaussians, (F, _) = make_gaussians(random_rotations(0), random_scales()), stretches()
    for weight in (0.2, 0.9, 1.4):
        counted(gaussians, F, ClampParams(0.5, 1.0 + weight, weight, weight))
    assert len(traces) == 1


def test_colour_turns_with_the_matter_only_where_there_is_any():
    turn = random_rotations(9)
    F = jnp.asarray(turn * np.array([1.3, 1.3, 0.8]) @ np.eye(3))
    gaussians = make_gaussians(random_rotations(0), random_scales())
    for mode in ("aligned", "literal", "covariance"):
        np.testing.assert_allclose(pose(gaussians, F, ClampParams(), mode=mode).sh_rotations, turn, atol=16 * EPS)
    assert pose(gaussians, F, ClampParams(), mode="fixed").sh_rotations is None
    plain = make_gaussians(random_rotations(0), random_scales(), sh_count=1)
    assert pose(plain, F, ClampParams()).sh_rotations is None


def test_clamp_draws_fewer_needles_than_transport():
    """The paper's ablation in small: matter drawn out fivefold, shapes that start at aspect 3 or less."""
    random = np.random.default_rng(4)
    gaussians = make_gaussians(random_rotations(0), 0.1 * random.uniform(1, 3, (COUNT, 3)))
    F = jnp.asarray(random_rotations(6) * np.array([5.0, 0.45, 0.45]) @ transpose(random_rotations(7)))

    def needle_share(mode):
        values = np.linalg.svd(np.asarray(pose(gaussians, F, ClampParams(), mode=mode).factors), compute_uv=False)
        return np.mean(values[:, 0] / values[:, 2] > 8)

    shares = {mode: needle_share(mode) for mode in MODES}
    print("\nshare of aspects above 8: " + ", ".join(f"{mode} {share:.2f}" for mode, share in shares.items()))
    assert shares["covariance"] > 0.8
    assert shares["aligned"] < 0.2
    assert shares["fixed"] == 0.0


def test_bad_input_is_named():
    gaussians = make_gaussians(random_rotations(0), random_scales())
    with pytest.raises(InputError, match=r"tau_min = 2.* exceeds tau_max = 1"):
        ClampParams(2.0, 1.0)
    with pytest.raises(InputError, match=r"mode = 'sharp' is unknown"):
        eigen_clamp(gaussians, identities(), ClampParams(), mode="sharp")
    with pytest.raises(InputError, match=r"F has shape \(7, 3, 3\); 200 Gaussians"):
        eigen_clamp(gaussians, identities(7), ClampParams())


def test_swept_bounds_are_accepted_while_tracing():
    scales = jax.jit(lambda low: ClampParams(low, 1.0).tau_min)(2.0)
    assert float(scales) == 2.0
