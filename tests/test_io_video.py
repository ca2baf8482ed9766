"""Films and pictures read back by ffmpeg and Pillow hold what was written."""

import imageio.v3 as imageio
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.errors import InputError, MissingFileError
from pigjax.io import contact_sheet, read_image, write_image, write_video


def colour_frames(height, width, count=6):
    """Flat frames of different colours."""
    colours = np.random.default_rng(0).uniform(0.1, 0.9, (count, 1, 1, 3)).astype(np.float32)
    return np.broadcast_to(colours, (count, height, width, 3))


@pytest.mark.parametrize(("height", "width"), [(32, 48), (33, 47)])
@pytest.mark.parametrize("stream", [False, True])
def test_film_holds_its_frames(tmp_path, height, width, stream):
    frames = colour_frames(height, width)
    write_video(tmp_path / "a.mp4", (frame for frame in frames) if stream else frames, fps=12.5)
    found = imageio.imread(tmp_path / "a.mp4", plugin="FFMPEG")
    facts = imageio.immeta(tmp_path / "a.mp4", plugin="FFMPEG")
    assert facts["fps"] == 12.5
    assert facts["pix_fmt"].startswith("yuv420p")
    # an odd edge is repeated once
    assert found.shape == (len(frames), height + height % 2, width + width % 2, 3)
    error = np.abs(found[:, :height, :width] / 255 - frames).max()
    print(f"worst colour error of {width}x{height} film {error:.4f}")
    assert error < 0.03  # H.264 at this quality, chroma at half resolution


def test_gif_loops_at_its_speed(tmp_path):
    frames = colour_frames(5, 7)
    write_video(tmp_path / "a.gif", frames, fps=20)
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"], film.info["loop"]) == (len(frames), (7, 5), 50, 0)
        for index, frame in enumerate(frames):
            film.seek(index)
            assert np.abs(np.asarray(film.convert("RGB")) / 255 - frame).max() < 0.02


def test_jax_uint8_and_grey_frames_are_films(tmp_path):
    frames = colour_frames(8, 8)
    for values in (jnp.asarray(frames), (frames * 255).astype(np.uint8), frames[..., 0]):
        write_video(tmp_path / "a.mp4", values, fps=5)
        assert len(imageio.imread(tmp_path / "a.mp4", plugin="FFMPEG")) == len(frames)


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.avi", np.zeros((1, 2, 2, 3)), 10, r"a\.avi: unknown video suffix '\.avi'; use \.mp4 or \.gif"),
        ("a.mp4", np.zeros((1, 2, 2, 3)), 0, r"a\.mp4: fps = 0; it must be > 0"),
        ("a.mp4", [], 10, r"a\.mp4: no frames were given"),
        ("a.gif", [], 10, r"a\.gif: no frames were given"),
        ("a.mp4", [np.zeros((2, 2, 3)), np.zeros((2, 4, 3))], 10, r"frame 1 is \(2, 4\), the first \(2, 2\)"),
        ("a.mp4", [np.zeros((2, 2, 4))], 10, r"has shape \(2, 2, 4\)"),
        ("a.mp4", np.zeros((1, 2, 70000, 3)), 10, r"a\.mp4: cannot be written \(ffmpeg: .*"),
        ("file/a.mp4", np.zeros((1, 2, 2, 3)), 10, r"file is a file, where a folder is needed"),
    ],
)
def test_bad_films_are_named(tmp_path, name, frames, fps, message):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames, fps=fps)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]  # nothing half-written stays


def test_missing_input_of_a_frame_is_not_called_unwritable(tmp_path):
    def frames():
        yield np.zeros((2, 2, 3))
        yield read_image(tmp_path / "none.png")

    with pytest.raises(MissingFileError, match=r"none\.png: no such image"):
        write_video(tmp_path / "a.mp4", frames(), fps=5)


def test_picture_round_trip_rounds_to_the_nearest(tmp_path):
    values = np.random.default_rng(0).uniform(0, 1, (5, 4, 3)).astype(np.float32)
    write_image(tmp_path / "deep" / "a.png", values)
    assert np.abs(read_image(tmp_path / "deep" / "a.png") - values).max() <= 0.5 / 255 + 1e-6
    write_image(tmp_path / "g.png", jnp.asarray([[0.0, 0.2, 2.0, -1.0, jnp.nan]]))
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "g.png")), [[0, 51, 255, 0, 0]])


def test_bad_pictures_are_named(tmp_path):
    with pytest.raises(InputError, match=r"a\.what: .*use a suffix such as \.png"):
        write_image(tmp_path / "a.what", np.zeros((2, 2, 3)))
    (tmp_path / "a.png").write_text("text")
    with pytest.raises(InputError, match=r"a\.png: not a readable image"):
        read_image(tmp_path / "a.png")


def test_contact_sheet_places_frames_in_reading_order():
    frames = colour_frames(3, 5, count=5)
    sheet = contact_sheet(frames, 3, gap=2)
    assert sheet.shape == (2 * 3 + 3 * 2, 3 * 5 + 4 * 2, 3)
    np.testing.assert_allclose(sheet[2:5, 2:7] / 255, frames[0], atol=0.002)
    np.testing.assert_allclose(sheet[7:10, 9:14] / 255, frames[4], atol=0.002)
    assert (sheet[:2] == 255).all()
    assert (sheet[7:10, 16:] == 255).all()
    assert contact_sheet(frames[:2], 8, gap=0).shape == (3, 10, 3)


def test_bad_contact_sheets_are_named():
    with pytest.raises(InputError, match="no frames were given"):
        contact_sheet([])
    with pytest.raises(InputError, match=r"frame 1 is \(2, 3\), the first \(2, 2\)"):
        contact_sheet([np.zeros((2, 2, 3)), np.zeros((2, 3, 3))])
