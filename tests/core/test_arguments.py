"""A wrong object given to a public function is one clear sentence, never a traceback of JAX or NumPy."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pigjax
from pigjax import io
from pigjax.core.arguments import checked
from pigjax.core.errors import InputError

FUNCTIONS = [value for name in pigjax.__all__ if not inspect.isclass(value := getattr(pigjax, name))]
FUNCTIONS += [io.read_image, io.write_image, io.read_video, io.contact_sheet]
WRONG = [None, "text", b"bytes", object(), {}, 3.5, [1, "a"], np.array(["a"])]
PATHS = {"load", "read", "write", "save"}


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("wrong", WRONG, ids=lambda w: type(w).__name__)
def test_what_no_argument_can_be_is_refused_in_a_line(function, wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parameters = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    positional = [wrong for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    if not parameters or (function is pigjax.vast_grid and wrong == 3.5):
        return  # it needs none, or the one argument that it has is a number
    with pytest.raises(InputError) as caught:
        function(*positional, **{p.name: wrong for p in parameters if p.kind is p.KEYWORD_ONLY})
    assert "\n" not in str(caught.value)


@pytest.fixture
def scene():
    count = 5
    means = np.random.default_rng(0).normal(size=(count, 3)) * 0.1
    values = means, np.full((count, 3), -3.0), np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros(count)
    cloud = pigjax.Gaussians(*(jnp.asarray(v, jnp.float32) for v in (*values, np.zeros((count, 1, 3)))))
    cameras = pigjax.orbit((0.0, 0.0, 0.0), radius=1.0, elevation=0.2, frames=2, focal=10.0, width=8, height=8)
    return cloud, cameras


def test_one_wrong_argument_is_named(scene):
    cloud, cameras = scene
    masks = np.ones((2, 8, 8), np.int32)
    cases = {
        "lift_masks: masks is None": lambda: pigjax.lift_masks(cloud, cameras, None, num_ids=2),
        "lift_masks: cameras is a list; Camera": lambda: pigjax.lift_masks(cloud, list(cameras), masks, num_ids=2),
        "lift_masks: num_ids is the string '2'": lambda: pigjax.lift_masks(cloud, cameras, masks, num_ids="2"),
        "render: camera is None; Camera is needed": lambda: pigjax.render(cloud, None),
        "render: config is a dict": lambda: pigjax.render(cloud, cameras[0], {}),
        r"render: features is an array of shape \(5,\)": lambda: pigjax.render(
            cloud, cameras[0], outputs=("features",), features=jnp.ones(5)
        ),
        "seed_particles: materials is a dict; a mapping of Material": lambda: pigjax.seed_particles(
            cloud, np.ones(5, int), {1: "jelly"}
        ),
        "psnr: b is an array of shape": lambda: pigjax.psnr(np.zeros((4, 4, 3), np.float32), np.zeros(4, np.float32)),
        "orbit: frames is the string": lambda: pigjax.orbit(
            (0.0, 0.0, 0.0), radius=1.0, elevation=0.0, frames="a", focal=1.0, width=2, height=2
        ),
    }
    for message, call in cases.items():
        with pytest.raises(InputError, match=message):
            call()


def test_a_batch_of_cameras_where_one_is_needed_names_index_and_vmap(scene):
    cloud, cameras = scene
    labels = pigjax.Labels(jnp.ones(5, jnp.int32), jnp.ones((5, 2), jnp.int32), jnp.ones(5))
    for call in (
        lambda: pigjax.render(cloud, cameras),
        lambda: pigjax.surface_depth(cloud, cameras),
        lambda: pigjax.object_mask(cloud, labels, 1, cameras),
        lambda: pigjax.core.camera.project(cloud.means, cameras),
        lambda: pigjax.core.camera.unproject(jnp.ones((8, 8)), cameras),
    ):
        with pytest.raises(InputError, match=r"is a batch of shape \(2,\).*camera\[0\].*vmap"):
            call()
    batch = jax.vmap(lambda world: pigjax.render(cloud, pigjax.Camera(world, *_intrinsics(cameras[0]))).alpha)
    assert batch(cameras.world_to_cam).shape == (2, 8, 8)


def _intrinsics(camera):
    return camera.focal, camera.centre, camera.width, camera.height


def test_arrays_of_any_kind_pass_and_lists_become_arrays():
    @checked
    def norm(points: "pigjax.core.camera.Float[jax.Array, 'n 3']", *, scale: float = 1.0):
        return scale * jnp.linalg.norm(points)

    for points in (jnp.ones((2, 3)), np.ones((2, 3)), [[1.0, 1, 1], [1, 1, 1]]):
        assert norm(points) == pytest.approx(6**0.5)
    assert jax.jit(norm)(jnp.ones((2, 3))) == pytest.approx(6**0.5)
    assert norm(jnp.ones((2, 3)), scale=jnp.asarray(2.0)) == pytest.approx(2 * 6**0.5)
    for wrong in (np.ones(3), np.ones((2, 4)), [[1.0], [1, 2]], 3.0):
        with pytest.raises(InputError, match="norm: points is"):
            norm(wrong)
    with pytest.raises(TypeError, match="missing"):
        norm()
