"""Rivals' methods (benchmarks/baselines) find known objects, so that a comparison with them means something."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.baselines.box_selection import bounding_box, in_box, select_by_box
from benchmarks.baselines.feature_distillation import THRESHOLDS, select_by_similarity, similarities, train_features
from benchmarks.baselines.identity_encoding import encoded_ids, image_ids, neighbour_divergence, train_encoding
from pigjax.core.camera import look_at, stack_cameras
from pigjax.io import Views
from pigjax.splat import Gaussians

SIZE, EACH, NUM_IDS = 48, 80, 3
TRUTH = np.repeat([1, 2], EACH)
CENTRES, RADIUS, DEVIATION = np.array([[-0.55, 0, 0], [0.55, 0, 0]]), 0.4, 0.07
STEPS = 200


@functools.cache
def two_balls():
    """Two round shells side by side, and four views around them with the masks of what is seen."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2 * EACH, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = RADIUS * directions + CENTRES[TRUTH - 1]
    count = len(means)
    arrays = (means, np.full((count, 3), np.log(DEVIATION)), np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 2.0),
              np.zeros((count, 1, 3)))  # fmt: skip
    gaussians = Gaussians(*(jnp.asarray(array, jnp.float32) for array in arrays))
    # the corners of a tetrahedron, turned so that no ball hides the other for long
    eyes = 2.6 * np.array([[0.3, 1, 0.2], [-0.3, -1, 0.2], [0.2, 0.2, 1], [-0.2, 0.2, -1]])
    cameras = [look_at(eye, np.zeros(3), focal=50.0, width=SIZE, height=SIZE) for eye in eyes]
    masks = np.stack([silhouettes(camera) for camera in cameras])
    images = np.zeros((*masks.shape, 3))
    return gaussians, Views(stack_cameras(cameras), tuple("abcd"), images, masks, ("train",) * 4)


def silhouettes(camera):
    """Id of the nearest ball that the ray through each pixel hits, by the distance of ball centres from the ray."""
    pose, focal, centre = (np.asarray(v, float) for v in (camera.world_to_cam, camera.focal, camera.centre))
    column, row = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = np.stack([(column - centre[0]) / focal[0], (row - centre[1]) / focal[1], np.ones((SIZE, SIZE))], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    at = CENTRES @ pose[:3, :3].T + pose[:3, 3]
    along = rays @ at.T
    hit = np.sum(at**2, 1) - along**2 < (RADIUS + DEVIATION) ** 2
    along = np.where(hit, along, np.inf)
    return np.where(hit.any(-1), 1 + np.argmin(along, -1), 0).astype(np.int32)


@functools.cache
def encoding():
    gaussians, views = two_balls()
    return train_encoding(gaussians, views, NUM_IDS, steps=STEPS)


@pytest.mark.slow
@pytest.mark.slow
def test_identity_encoding_recovers_the_ids():
    gaussians, views = two_balls()
    fitted = encoding()
    right = np.mean(encoded_ids(fitted.final) == TRUTH)
    in_image = np.mean(image_ids(gaussians, fitted.final, views.cameras[0]) == views.masks[0])
    print(f"identity encoding: {right:.3f} of Gaussians, {in_image:.3f} of pixels right")
    assert right > 0.95
    assert in_image > 0.95


def test_training_keeps_checkpoints_and_lowers_the_loss():
    fitted = encoding()
    assert list(fitted.params) == [STEPS // 8, STEPS // 4, STEPS // 2, STEPS]
    start, early, middle, late = (fitted.mean_loss(step, 4) for step in fitted.params)
    assert late < middle < early < start < fitted.losses[0]
    assert fitted.mean_loss(STEPS, 4) == pytest.approx(np.mean(fitted.losses[-4:]))


@pytest.mark.slow
def test_feature_distillation_recovers_the_ids():
    gaussians, views = two_balls()
    features = train_features(gaussians, views, NUM_IDS, steps=STEPS).final
    members, thresholds = select_by_similarity(gaussians, features, views)
    right = np.mean((members[:, 1:] == (TRUTH[:, None] == [1, 2])).all(1))
    print(f"distilled features: {right:.3f} of Gaussians right at thresholds {thresholds}")
    assert right > 0.95
    cosine = np.asarray(similarities(features))
    for number, threshold in thresholds.items():
        assert threshold in THRESHOLDS
        np.testing.assert_array_equal(members[:, number], cosine[:, number] > threshold)


def test_cosine_of_a_feature_with_an_axis():
    cosine = similarities(jnp.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [0.0, -2.0, 0.0]]))
    np.testing.assert_allclose(cosine, [[0.6, 0.0, 0.8], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]], atol=1e-7)


def test_neighbour_divergence_equals_its_definition():
    rng = np.random.default_rng(1)
    points, neighbours, classes = 7, 5, 4
    p, q = rng.dirichlet(np.ones(classes), points), rng.dirichlet(np.ones(classes), (points, neighbours))
    expected = np.mean(
        [
            sum(p[i, c] * np.log(p[i, c] / q[i, k, c]) for c in range(classes))
            for i in range(points)
            for k in range(neighbours)
        ]
    )
    value = neighbour_divergence(jnp.log(jnp.asarray(p, jnp.float32)), jnp.log(jnp.asarray(q, jnp.float32)))
    assert float(value) == pytest.approx(expected, rel=1e-5)
    same = jnp.log(jnp.asarray(p, jnp.float32))
    assert float(neighbour_divergence(same, jnp.repeat(same[:, None], 5, 1))) == pytest.approx(0, abs=1e-6)


def test_a_box_holds_exactly_the_points_between_its_corners():
    points = np.array(
        [[0.0, 0, 0], [1, 2, 3], [0.5, 1, 1.5], [1.001, 1, 1], [-0.001, 1, 1], [0.5, 2.5, 1], [0, 0, 3.1]]
    )
    np.testing.assert_array_equal(in_box(points, np.zeros(3), np.array([1.0, 2, 3])), [1, 1, 1, 0, 0, 0, 0])
    line = np.arange(101.0)[:, None] * np.array([1.0, -1.0, 2.0])
    low, high = bounding_box(line, 5.0)
    np.testing.assert_allclose(low, [5, -95, 10])
    np.testing.assert_allclose(high, [95, -5, 190])


def test_training_views_choose_the_box_that_leaves_a_stray_label_out():
    gaussians, views = two_balls()
    labels = TRUTH.copy()
    labels[-1] = 1  # one Gaussian of the second ball is taken for the first
    members, percentiles = select_by_box(gaussians, labels, NUM_IDS, views)
    assert percentiles[1] > 0
    means = np.asarray(gaussians.means)
    low, high = bounding_box(means[labels == 1], percentiles[1])
    inside = [all(low[axis] <= mean[axis] <= high[axis] for axis in range(3)) for mean in means]
    np.testing.assert_array_equal(members[:, 1], inside)
    assert not members[TRUTH == 2, 1].any()
    right = np.mean((select_by_box(gaussians, TRUTH, NUM_IDS, views)[0][:, 1:] == (TRUTH[:, None] == [1, 2])).all(1))
    print(f"boxes: {right:.3f} of Gaussians right")
    assert right > 0.95
