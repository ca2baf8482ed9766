"""States that stay beside a video: all of them, thinned, in half precision, or none."""

import numpy as np
import pytest
from scenes import ball, values

from pigjax import io
from pigjax.core.errors import StaleError
from pigjax.scene import run_scene, scene_from


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene")
    io.save_ply(path / "cloud.ply", ball(120))
    return path


@pytest.fixture(scope="module")
def full(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return run_scene(scene(folder), out), out


def scene(folder, **output):
    return scene_from(values(simulation__dx=0.08, output=output), folder=folder)


def same_result(report, out, full):
    wanted, whole = full
    assert report.health == wanted.health
    assert report.sizes["substeps_per_frame"] == wanted.sizes["substeps_per_frame"]
    pictures = [io.read_image(folder / "contact_sheet.png") for folder in (out, whole)]
    np.testing.assert_allclose(*pictures, atol=3 / 255)  # half precision of F


def test_thinned_states_in_half_precision_keep_every_second_frame_and_the_last(full, folder, tmp_path):
    report = run_scene(scene(folder, states_every=2, compress_states=True), tmp_path)
    assert io.state_frames(tmp_path / "states") == [0, 2, 3]
    same_result(report, tmp_path, full)
    for frame in (0, 2, 3):
        half, whole = (io.load_state(path / "states", frame) for path in (tmp_path, full[1]))
        np.testing.assert_array_equal(half["x"], whole["x"])
        for name in ("v", "F_visual"):
            assert half[name].dtype == np.float32
            np.testing.assert_allclose(half[name], whole[name], rtol=1e-3, atol=1e-6)
    sizes = [(path / "states" / "000003.npz").stat().st_size for path in (tmp_path, full[1])]
    assert sizes[0] < 0.75 * sizes[1]
    with pytest.raises(StaleError, match="compress_states"):  # what is in single precision must have been simulated so
        run_scene(scene(folder), tmp_path)
    # what is missing is made again, so that the video can be drawn again
    again = run_scene(scene(folder, states_every=2, compress_states=True), tmp_path)
    assert again.sizes["resumed_from_frame"] == 3
    same_result(again, tmp_path, full)


def test_states_that_are_off_leave_none_even_where_a_run_was_stopped(full, folder, tmp_path):
    class Stopped(Exception):
        pass

    seen = []

    def stop(stage, done, of):
        seen.append((stage, done, len(io.state_frames(tmp_path / "states"))))
        if (stage, done) == ("simulate", 2):
            raise Stopped

    with pytest.raises(Stopped):
        run_scene(scene(folder, states_every=0), tmp_path, progress=stop)
    report = run_scene(
        scene(folder, states_every=0),
        tmp_path,
        progress=lambda *told: seen.append((*told[:2], len(io.state_frames(tmp_path / "states")))),
    )
    assert max(count for _, _, count in seen) <= 2  # a frame that is drawn makes room for the next one
    assert not list((tmp_path / "states").glob("*.npz"))
    assert not (tmp_path / "states" / "last.ckpt").exists()
    same_result(report, tmp_path, full)
    assert report.times["draw"].total > report.times["draw"].compile
