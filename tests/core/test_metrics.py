import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from pigjax.core.errors import InputError
from pigjax.core.metrics import boundary_iou, mean_iou, psnr, score_masks, ssim


def images(seed=0, shape=(24, 31, 3)):
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.random(shape), (2, 2, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return smooth, np.clip(smooth + 0.1 * rng.normal(size=shape), 0, 1)


def reference_ssim(a, b):
    """Wang et al. 2004 with scipy's correlation and a full 2D window, in float64."""
    line = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(line, line)[..., None] / line.sum() ** 2

    def mean(v):
        return ndimage.correlate(v, window, mode="constant")

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    c1, c2 = 1e-4, 9e-4
    return np.mean((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2)))


def test_psnr_of_a_known_error():
    a = jnp.full((4, 5, 3), 0.5)
    assert float(psnr(a, a + 0.1)) == pytest.approx(20.0, abs=1e-4)
    assert np.isinf(psnr(a, a))


def test_ssim_equals_the_two_dimensional_window_in_float64(x64):
    a, b = images()
    assert float(ssim(jnp.asarray(a), jnp.asarray(b))) == pytest.approx(reference_ssim(a, b), abs=1e-12)


def test_ssim_in_float32_and_of_equal_images():
    a, b = images()
    # 1e-5: variances are differences of float32 means of squares
    value = ssim(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32))
    assert float(value) == pytest.approx(reference_ssim(a, b), abs=1e-5)
    assert float(ssim(jnp.asarray(a, jnp.float32), jnp.asarray(a, jnp.float32))) == pytest.approx(1.0, abs=1e-6)
    assert ssim(jnp.asarray(a[..., 0]), jnp.asarray(b[..., 0])).shape == ()


def test_ssim_gradient_equals_central_differences(x64):
    a, b = (jnp.asarray(v) for v in images(shape=(13, 17, 3)))
    rng = np.random.default_rng(1)
    gradient = jax.grad(ssim, argnums=(0, 1))(a, b)
    for argument in (0, 1):
        direction = jnp.asarray(rng.normal(size=a.shape))
        step = 1e-6 * jnp.eye(2)[argument][:, None, None, None] * direction
        numeric = (ssim(a + step[0], b + step[1]) - ssim(a - step[0], b - step[1])) / 2e-6
        assert float(jnp.vdot(gradient[argument], direction)) == pytest.approx(float(numeric), rel=1e-7)


def test_ssim_gradient_under_vmap_and_jit():
    a, b = images(shape=(12, 12, 3))
    batch = jnp.asarray(np.stack([a, b]), jnp.float32)
    gradient = jax.grad(ssim)
    together = jax.vmap(gradient, (0, None))(batch, batch[0])
    apart = jnp.stack([gradient(image, batch[0]) for image in batch])
    np.testing.assert_allclose(together, apart, atol=1e-6)


def square(size, top, left, height, width):
    mask = np.zeros((size, size), bool)
    mask[top : top + height, left : left + width] = True
    return mask


def test_iou_of_hand_made_masks():
    truth, half = square(20, 4, 4, 8, 8), square(20, 4, 4, 8, 4)
    assert float(mean_iou(half, truth)) == pytest.approx(0.5)
    assert float(mean_iou(truth, truth)) == 1.0
    assert float(mean_iou(np.zeros_like(truth), truth)) == 0.0
    assert float(mean_iou(np.zeros_like(truth), np.zeros_like(truth))) == 1.0
    stack = np.stack([half, truth]), np.stack([truth, truth])
    assert float(mean_iou(*stack)) == pytest.approx(0.75)


def test_masks_are_cut_at_one_half():
    truth = square(10, 2, 2, 4, 4)
    soft = jnp.where(truth, 0.51, 0.5)
    assert float(mean_iou(soft, truth)) == 1.0
    assert float(mean_iou(truth.astype(np.uint8) * 255, truth)) == 1.0


def test_boundary_iou_of_hand_made_masks():
    # diagonal of 40x40 is 56.6: d = 1, so the boundary of a square is its outermost ring
    truth, wider = square(40, 10, 10, 10, 10), square(40, 10, 10, 10, 11)
    ring, other = 36, 38
    shared = 10 + 9 + 9  # left column, and the top and bottom rows without it
    assert float(boundary_iou(wider, truth)) == pytest.approx(shared / (ring + other - shared))
    # the image's edge counts as outside: a full mask has a boundary
    full = np.ones((40, 40), bool)
    assert float(boundary_iou(full, full)) == 1.0
    assert float(boundary_iou(full, square(40, 1, 1, 38, 38))) == 0.0


def test_wide_boundaries_of_hand_made_masks():
    # diagonal of 120x90 is 150: d = 3, so the band of a 20x20 square is what its inner 14x14 leaves: 204 px
    truth, moved = np.zeros((2, 120, 90), bool)
    truth[30:50, 30:50], moved[30:50, 32:52] = True, True
    inner, inner_moved = np.zeros((2, 120, 90), bool)
    inner[33:47, 33:47], inner_moved[33:47, 35:49] = True, True
    assert (truth & ~inner).sum() == 204
    shared = (truth & ~inner & moved & ~inner_moved).sum()
    # two bars of 3x18 at top and bottom, and between them, 14 px high, the columns 32 (left) and 49 (right) of both
    assert shared == 2 * 3 * 18 + 14 * 2
    assert float(boundary_iou(moved, truth)) == pytest.approx(shared / (2 * 204 - shared))
    assert float(mean_iou(moved, truth)) == pytest.approx(18 / 22)
    # at the image's edge the mask ends, too: a band of 3 px along it
    corner = np.zeros((120, 90), bool)
    corner[:10, :10] = True
    rest = np.zeros((120, 90), bool)
    rest[3:7, 3:7] = True
    assert float(boundary_iou(corner & ~rest, corner)) == pytest.approx(1.0)
    assert float(boundary_iou(rest, corner)) == 0.0


@pytest.mark.parametrize(("shape", "ratio"), [((30, 50), 0.02), ((30, 50), 0.3), ((137, 201), 0.02)])
def test_boundary_equals_repeated_erosion_by_scipy(shape, ratio):
    rng = np.random.default_rng(0)
    masks = [ndimage.gaussian_filter(rng.random(shape), 3) > 0.5 for _ in range(2)]
    steps = max(1, round(ratio * np.hypot(*shape)))
    bands = [m & ~ndimage.binary_erosion(m, np.ones((3, 3)), steps, border_value=0) for m in masks]
    expected = (bands[0] & bands[1]).sum() / (bands[0] | bands[1]).sum()
    assert float(boundary_iou(*masks, ratio)) == pytest.approx(expected, abs=1e-6)


def test_prediction_of_another_size_is_resized_by_nearest_pixel():
    rng = np.random.default_rng(0)
    small = ndimage.gaussian_filter(rng.random((23, 31)), 2) > 0.5
    truth = ndimage.gaussian_filter(rng.random((60, 50)), 4) > 0.5
    resized = np.array(Image.fromarray(small.astype(np.uint8)).resize((50, 60), Image.Resampling.NEAREST)) > 0
    assert float(mean_iou(small, truth)) == float(mean_iou(resized, truth))


def test_scores_average_views_then_prompts_and_count_the_missing():
    truth, half, none = square(20, 4, 4, 8, 8), square(20, 4, 4, 8, 4), np.zeros((20, 20), bool)
    truths = {("a", "duck"): truth, ("b", "duck"): truth, ("c", "duck"): truth, ("a", "mug"): truth}
    predictions = {("a", "duck"): half, ("b", "duck"): truth, ("a", "mug"): none, ("z", "mug"): truth}
    scores = score_masks(predictions, truths)
    assert scores.per_prompt["duck"][0] == pytest.approx((0.5 + 1 + 0) / 3)
    assert scores.mean_iou == pytest.approx(0.25)
    assert scores.missing == 1
    boundaries = (float(boundary_iou(half, truth)) + 1 + 0) / 3
    assert scores.mean_boundary_iou == pytest.approx(boundaries / 2)
    with pytest.raises(InputError, match="truths"):
        score_masks(predictions, {})


def published_scores(predictions, truths):
    """Gaussian Grouping's protocol anew: 8-bit masks cut at 128, Pillow's nearest pixel, scipy's erosion, float64."""
    by_prompt = {}
    for (view, prompt), truth in truths.items():
        if (view, prompt) not in predictions:
            by_prompt.setdefault(prompt, []).append((0.0, 0.0))
            continue
        height, width = truth.shape
        grey = Image.fromarray((255 * predictions[view, prompt]).astype(np.uint8))
        prediction = np.asarray(grey.resize((width, height), Image.Resampling.NEAREST)) > 128
        steps = max(round(0.02 * np.hypot(height, width)), 1)
        element = np.ones((3, 3))
        edges = [
            mask & ~ndimage.binary_erosion(np.pad(mask, 1), element, steps)[1:-1, 1:-1] for mask in (prediction, truth)
        ]
        pairs = (prediction, truth), edges
        by_prompt.setdefault(prompt, []).append(tuple((a & b).sum() / (a | b).sum() for a, b in pairs))
    per_prompt = {prompt: np.mean(scores, 0) for prompt, scores in by_prompt.items()}
    return per_prompt, np.mean(list(per_prompt.values()), 0)


def test_scores_equal_the_published_protocol_written_anew():
    rng = np.random.default_rng(0)

    def blob(shape):
        return ndimage.gaussian_filter(rng.random(shape), 4) > 0.5

    truths = {(view, prompt): blob((61, 84)) for view in "abc" for prompt in ("sheep", "tea")}
    truths.pop(("b", "tea"))
    predictions = {key: blob((61, 84)) | truth for key, truth in truths.items()}
    predictions["a", "sheep"] = ndimage.binary_dilation(truths["a", "sheep"], iterations=2)[::2, ::2]
    predictions.pop(("c", "tea"))
    scores = score_masks(predictions, truths)
    per_prompt, means = published_scores(predictions, truths)
    for prompt, expected in per_prompt.items():
        assert scores.per_prompt[prompt] == pytest.approx(tuple(expected), abs=1e-6)
    assert (scores.mean_iou, scores.mean_boundary_iou) == pytest.approx(tuple(means), abs=1e-6)
    assert scores.missing == 1
