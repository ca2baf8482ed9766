"""Films and pictures read back by ffmpeg and Pillow hold what was written."""

import warnings

import imageio.v3 as imageio
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from pigjax.core.errors import InputError, MissingFileError
from pigjax.io import contact_sheet, read_image, read_video, write_image, write_video


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
        ("a.avi", np.zeros((1, 2, 2, 3)), 10, r"a\.avi: unknown video suffix '\.avi'; use \.mp4, \.webm or \.gif"),
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


@pytest.mark.parametrize("folder", ["2026-11-29T22:30:00", "run:1", "http:", "-v", "a b%03d", "[x]", "-i;-y"])
def test_any_name_of_a_folder_is_a_path_and_no_option_or_protocol(tmp_path, monkeypatch, folder):
    monkeypatch.chdir(tmp_path)
    path = f"{folder}/-y:0.mp4"
    write_video(path, colour_frames(4, 4, 2), fps=10)
    assert read_video(path).shape == (2, 4, 4, 3)
    write_video(f"{folder}/a.gif", colour_frames(4, 4, 2), fps=10)
    assert read_video(f"{folder}/a.gif").shape == (2, 4, 4, 3)
    assert [entry.name for entry in tmp_path.iterdir()] == [folder]


def test_a_playlist_that_names_other_files_is_no_film(tmp_path):
    write_video(tmp_path / "a.mp4", colour_frames(4, 4, 2), fps=10)
    inner = (tmp_path / "a.mp4").as_posix()
    (tmp_path / "b.mp4").write_text(f"ffconcat version 1.0\nfile '{inner}'\n")
    (tmp_path / "c.mp4").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{inner}\n#EXT-X-ENDLIST\n")
    for name in ("b.mp4", "c.mp4"):
        with pytest.raises(InputError, match="not a video that ffmpeg reads"):
            read_video(tmp_path / name)


@pytest.mark.parametrize(
    ("fps", "lasts"), [(60, 20), (35, 30), (24, 40), (25, 40), (50, 20), (100, 20), (240, 20), (10, 100), (1 / 3, 3000)]
)
def test_gif_times_are_rounded_to_hundredths_and_a_rate_that_is_not_held_is_said(tmp_path, fps, lasts):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        write_video(tmp_path / "a.gif", colour_frames(5, 7, 3), fps=fps)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.info["duration"] == lasts
    held = abs(1000 / lasts / fps - 1) < 0.01
    assert held != any("whole hundredths" in str(warning.message) for warning in caught)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (None, "frames is None"),
        ("text", "frames is the string"),
        ({"a": 1}, "frames is a dict"),
        (np.zeros((4, 5, 3)), r"frames has shape \(4, 5, 3\)"),
        (np.zeros((2, 2, 4, 5, 3)), r"frames has shape \(2, 2, 4, 5, 3\)"),
        ([None], "frame 0 is a NoneType that holds no numbers"),
        (["text"], "frame 0 is a str that holds no numbers"),
        ([np.zeros(5)], r"frame 0 has shape \(5,\)"),
        ([[[0.0, 1.0], [0.5]]], "frame 0 is ragged"),
        ([np.zeros((4, 4, 3)), object()], "frame 1 is a object"),
        ([np.zeros((0, 4, 3))], "no pixels"),
        ([np.full((4, 4, 3), 200)], "frame 0 holds int64 from 200 to 200"),
        ([np.zeros((4, 4, 3), complex)], "holds no numbers"),
    ],
)
@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_what_is_no_picture_is_named(tmp_path, name, frames, message):
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames, fps=5)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fps", [np.nan, np.inf, -1.0, 0.0])
def test_a_rate_that_is_none_is_refused(tmp_path, fps):
    with pytest.raises(InputError, match=r"fps = .*must be > 0"):
        write_video(tmp_path / "a.mp4", colour_frames(4, 4, 2), fps=fps)
    with pytest.raises(InputError, match=r"655\.35 s at most"):
        write_video(tmp_path / "a.gif", colour_frames(4, 4, 2), fps=1e-4)
    with pytest.raises(InputError, match=r"longer than a GIF can say"):
        write_video(tmp_path / "a.gif", np.zeros((3, 4, 4, 3)), fps=2e-3)


def test_nan_is_black_and_booleans_are_white(tmp_path):
    frames = [np.full((4, 4, 3), np.nan), np.ones((4, 4), bool)]
    write_video(tmp_path / "a.mp4", frames, fps=5)
    found = read_video(tmp_path / "a.mp4")
    assert found[0].max() < 0.02
    assert found[1].min() > 0.98
