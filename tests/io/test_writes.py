"""Writes: whole or not at all, inside the output folder, and told in one line where they cannot be."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from pigjax import cli, io
from pigjax.cli import segmenting
from pigjax.core.camera import look_at, stack_cameras
from pigjax.core.errors import InputError
from pigjax.objects.overlay import comparison_sheet, legend_sheet
from pigjax.scene import load_scene, run_scene
from pigjax.segmentation import Labels
from pigjax.splat import Gaussians
from pigjax.study.optimize.history import History
from pigjax.study.optimize.table import Table, load_table

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"
STUDY = TABLETOP.parent / "studies" / "young_sweep.toml"
QUICK = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
NAMES = st.text(max_size=80) | st.sampled_from(
    ["..", "../../x", "/etc/x", "a/b", "a\\b", "C:x", "", ".", "-", "[/x]", "[bold]", "a\nb", "a" * 300, "é" * 200]
)
HOSTILE = ["[/x]", "[bold red]cup", ":smile:", "\x1b[31mred", "a\nb"]


@pytest.fixture
def command(monkeypatch, capsys):
    """Run a command as a shell does: exit code, and what it prints to standard error."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["pigjax", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code, capsys.readouterr().err

    return call


# names


@QUICK
@given(NAMES)
def test_a_safe_name_is_one_component_of_a_path(name):
    safe = io.safe_name(name)
    assert Path("folder", safe).parent == Path("folder")
    assert safe not in (".", "..", "")
    assert safe[0] not in "-."
    assert len(os.fsencode(safe)) <= 60


@QUICK
@given(st.lists(NAMES | st.sampled_from(["a b", "a_b", "A_B", "a/b"]), max_size=6, unique=True))
def test_different_names_become_different_files(names):
    safe = io.safe_names(names)
    assert len({name.casefold() for name in safe}) == len(names)


@pytest.fixture
def segment_two(monkeypatch):
    """`segment_files` of two Gaussians with what it draws left out."""
    gaussians = Gaussians(*(jnp.zeros(s) for s in ((2, 3), (2, 3), (2, 4), (2,), (2, 1, 3))))
    gaussians = eqx.tree_at(lambda g: g.quats, gaussians, jnp.ones((2, 4)))
    labels = Labels(jnp.array([1, 2]), jnp.ones((2, 3)), jnp.ones(2))
    black = np.zeros((4, 4, 3), np.float32)
    monkeypatch.setattr(segmenting, "lift", lambda *a, **k: labels)
    monkeypatch.setattr(segmenting, "contributions", lambda *a: np.ones(2))
    monkeypatch.setattr(segmenting, "hole_mask", lambda *a, **k: np.ones((4, 4), bool))
    monkeypatch.setattr(segmenting, "render", lambda *a, **k: type("Frame", (), {"rgb": black}))
    monkeypatch.setattr(segmenting, "_sheet", lambda *a: black)
    camera = look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), focal=4.0, width=4, height=4)
    two = stack_cameras([camera, camera])

    def segment(out, names, views=("a", "b")):
        photos = io.Views(two, tuple(views), np.stack([black, black]), np.ones((2, 4, 4), np.int32), ("train",) * 2)
        return segmenting.segment_files(gaussians, photos, names, out, fill=False, remove=["1"])

    return segment


@settings(QUICK, max_examples=15)
@given(name=NAMES, other=NAMES, view=NAMES)
def test_names_never_leave_the_output_folder(segment_two, tmp_path_factory, name, other, view):
    home = tmp_path_factory.mktemp("home")
    segment_two(home / "deep" / "out", {1: name, 2: other}, views=(view, "b"))
    out = home / "deep" / "out"
    written = {path for path in home.rglob("*") if path.is_file()}
    assert all(path.parent in (out, out / "objects", out / "removed", *(out / "removed").iterdir()) for path in written)
    assert len(list((out / "objects").glob("00[12]*.ply"))) == 2
    assert len(list((out / "removed").glob("001*/*.png"))) == 2


def test_a_victim_beside_the_output_folder_is_untouched(segment_two, tmp_path):
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "mine.ply").write_text("mine")
    segment_two(tmp_path / "out", {1: "a/../../../victim/mine", 2: "red/blue cup"})
    assert (tmp_path / "victim" / "mine.ply").read_text() == "mine"
    assert (tmp_path / "out" / "objects" / "002_red_blue_cup.ply").is_file()


@pytest.mark.parametrize("name", ["../x", "/x/y", "a/../../x", "", "..\\x"])
def test_masks_are_not_written_out_of_their_folder(tmp_path, name):
    with pytest.raises(InputError, match=r"a view named .* leads out of it"):
        io.save_masks(tmp_path / "masks", [name], np.zeros((1, 2, 2), int))


# printed texts


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_printed_literally(monkeypatch, tmp_path, name):
    io.write_json(tmp_path / "names.json", {"1": name})
    monkeypatch.setattr(io, "load_gaussians", lambda path, **k: None)
    monkeypatch.setattr(io, "load_views", lambda path, **k: None)
    monkeypatch.setattr(segmenting, "segment_files", lambda *a, **k: {1: 7})
    arguments = ["segment", "a.ply", "views", "--names", str(tmp_path / "names.json"), "-o", str(tmp_path)]
    said = CliRunner().invoke(cli.app, arguments, catch_exceptions=False, env={"COLUMNS": "120"})
    assert said.exit_code == 0
    for part in name.replace("\x1b", "\ufffd").split("\n"):
        assert part in said.output
    assert "\x1b" not in said.output


@pytest.mark.parametrize("name", HOSTILE[:4])
def test_errors_are_printed_literally_on_one_line(command, name):
    code, said = command("info", f"{name}.ply")
    assert code == 2
    assert name.replace("\x1b", "\ufffd") in said
    assert len(said.splitlines()) == 1
    assert "\x1b" not in said


@pytest.mark.parametrize("name", [*HOSTILE, "\ud800", "\0", "x" * 100_000])
def test_sheets_take_any_name(name):
    assert legend_sheet({1: name}).shape == (48, 320, 3)
    mask = np.zeros((4, 4), bool)
    assert comparison_sheet([(name, np.zeros((4, 4, 3)), mask, mask)]).ndim == 3


@pytest.mark.parametrize("name", ["a$b", "$\\frac$", "[/x]", "a\nb"])
def test_plots_take_any_name(tmp_path, name):
    table = table_of(name, [1.0, 2.0])
    table.curve(tmp_path / "curve.png", name, "loss")
    assert io.read_image(tmp_path / "curve.png").ndim == 3


def test_a_spreadsheet_takes_no_name_for_a_formula(tmp_path):
    table_of("=cmd|' /C calc'!A0", [1.0, -2.0], ("", "@SUM(1)")).save(tmp_path / "table.csv")
    header, first, second = (tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()
    assert header.startswith("'=cmd")
    assert first.startswith("1.0,")
    assert second.startswith("-2.0,")  # numbers stay numbers
    assert second.endswith(",'@SUM(1)")


# places that cannot be written


def commands(out):
    cloud, photos = TABLETOP / "tabletop.ply", TABLETOP
    yield "demo", "-o", out
    yield "run", TABLETOP / "scene.toml", "-o", out
    yield "reconstruct", photos, "--max-size", 32, "-o", out
    yield "segment", cloud, photos, "-o", out
    yield "evaluate", photos, cloud, "--format", "views", "--max-size", 32, "-o", out
    yield "view", cloud, "-o", f"{out}/view.mp4"
    yield "sweep", STUDY, "-o", out
    yield "tune", STUDY, "-o", out


def test_a_file_in_place_of_the_folder_is_one_line_of_every_command(command, tmp_path):
    (tmp_path / "file").write_text("mine")
    for arguments in [*commands(tmp_path / "file"), ("demo", "-o", tmp_path / "file" / "deeper")]:
        code, said = command(*arguments)
        last = said.splitlines()[-1]
        assert code == 2, (arguments, said)
        assert last.startswith("error: "), (arguments, said)
        assert "file is a file, where a folder is needed" in last, (arguments, said)
        assert "Traceback" not in said
    assert (tmp_path / "file").read_text() == "mine"


def test_an_empty_or_overlong_output_is_one_line(command):
    code, said = command("demo", "-o", "")
    assert (code, said) == (2, "error: --out is empty; name where the results go, or leave the option out.\n")
    code, said = command("demo", "-o", "x" * 300)
    assert code == 2
    assert "cannot be made (File name too long)" in said
    code, said = command("info", "x" * 300)
    assert code == 2
    assert len(said.splitlines()) == 1


def test_a_tilde_is_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/someone")
    assert cli.base.output_path("~/out") == Path("/home/someone/out")


def test_a_folder_in_place_of_a_result_is_told_before_the_work(tmp_path):
    scene = load_scene(TABLETOP / "scene.toml")
    (tmp_path / "video.mp4").mkdir()
    with pytest.raises(InputError, match=r"video\.mp4: a folder lies where the file is to be written"):
        run_scene(scene, tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "states").write_text("mine")
    with pytest.raises(InputError, match=r"states: a file lies where a folder is to be made"):
        run_scene(scene, tmp_path / "other")


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_read_only_place_is_named(monkeypatch, tmp_path, number):
    def refuse(*arguments, **options):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "access", lambda *a: False)
    with pytest.raises(InputError, match="is read-only"):
        io.output_folder(tmp_path)
    for name in ("write_bytes", "unlink"):
        monkeypatch.setattr(Path, name, refuse)
    with pytest.raises(InputError, match=rf"a\.json: cannot be written \({os.strerror(number)}\)"):
        io.write_json(tmp_path / "a.json", {})
    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(InputError, match=rf"cannot be made \({os.strerror(number)}\)"):
        io.output_folder(tmp_path / "new")


WRITERS = {
    "a.json": lambda path: io.write_json(path, {"a": 1}),
    "a.toml": lambda path: io.write_toml(path, {"a": 1}),
    "a.npz": lambda path: io.save_arrays(path, {"a": np.zeros(3)}),
    "table.csv": lambda path: table_of("a", [1.0]).save(path),
    "labels.npz": lambda path: io.save_labels(path, np.zeros(2, np.int32), np.zeros((2, 3)), np.zeros(2)),
    "history.npz": lambda path: history().save(path),
    "last.ckpt": lambda path: io.save_pytree(path, (np.zeros(3), np.ones(2)), parts={"format": "1"}),
}
DRAWERS = {
    "curve.png": lambda path: table_of("a", [1.0, 2.0]).curve(path, "a", "loss"),
    "history.png": lambda path: history().plot(path),
    "image.png": lambda path: io.write_image(path, np.zeros((4, 4, 3))),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_keeps_the_former_file_and_nothing_else(monkeypatch, tmp_path, name):
    WRITERS[name](tmp_path / name)
    former = (tmp_path / name).read_bytes()
    real = Path.write_bytes

    def fill_up(path, content):
        real(path, bytes(content)[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); make room"):
        WRITERS[name](tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == former


@pytest.mark.parametrize("name", [*WRITERS, *DRAWERS])
def test_links_are_replaced_and_not_followed(tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "target").write_text("mine")
    (tmp_path / "out" / name).symlink_to(tmp_path / "target")
    (WRITERS | DRAWERS)[name](tmp_path / "out" / name)
    assert (tmp_path / "target").read_text() == "mine"
    assert not (tmp_path / "out" / name).is_symlink()


def test_a_link_under_the_temporary_name_is_not_followed(tmp_path):
    (tmp_path / "target").write_text("mine")
    with io.writing(tmp_path / "a.txt") as partial:
        pass_by = partial
        partial.write_text("whole")
    pass_by.symlink_to(tmp_path / "target")
    io.write_text(tmp_path / "a.txt", "again")
    assert (tmp_path / "target").read_text() == "mine"


def test_paths_that_are_not_utf8_are_written(tmp_path):
    strange = os.fsdecode(b"caf\xe9")
    io.write_json(tmp_path / "a.json", {"files": {"video": Path(strange) / "x"}, strange: (strange, np.ones(2), 1.5)})
    content = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert content == {"files": {"video": "caf\ufffd/x"}, "caf\ufffd": ["caf\ufffd", [1.0, 1.0], 1.5]}
    with pytest.warns(UserWarning, match="not UTF-8"):
        io.write_toml(tmp_path / "a.toml", {"input": {"gaussians": strange}})
    assert io.read_toml(tmp_path / "a.toml") == {"input": {"gaussians": "caf\ufffd"}}


@pytest.mark.parametrize("path", ["", ".", "a\0b", "\ud800"])
def test_what_is_no_file_name_is_refused(path):
    with pytest.raises(InputError, match="is not the name of a file"), io.writing(path):
        pass


# kills and stops

WRITE_FOR_EVER = """
import sys, time
from pathlib import Path
from pigjax import io
out = Path(sys.argv[1])
with io.writing(out / "states/000013.npz") as state, io.writing(out / "video.mp4") as video:
    state.write_bytes(bytes(1000))
    video.write_bytes(bytes(1000))
    print("ready", flush=True)
    time.sleep(100)
"""


def killed(code, *arguments, signals, cwd=None, after=0.0):
    """Start Python, send it signals once it says "ready", and give its exit code and standard error."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    process = subprocess.Popen(
        [sys.executable, "-c", "import signal; signal.signal(2, signal.default_int_handler)\n" + code, *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=cwd,
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n", process.communicate()
    time.sleep(after)
    for number in signals:
        process.send_signal(number)
    _, said = process.communicate(timeout=60)
    return process.returncode, said


def test_leftovers_of_killed_writers_are_swept_and_nothing_else(tmp_path):
    mine = [".notes.2023.json", ".cache.4711", ".pigjax", ".video.mp4", "seen.1.npz", "video.mp4"]
    for name in mine:
        (tmp_path / name).write_text("mine")
    with io.writing(tmp_path / "of_a_living_process.npz") as living:
        living.write_text("half")
        code, _ = killed(WRITE_FOR_EVER, str(tmp_path), signals=[signal.SIGKILL])
        assert code == -signal.SIGKILL
        left = [path.name for path in (tmp_path / "states").iterdir()]
        assert len(left) == 1
        assert left[0].startswith(".")
        before = len(list(tmp_path.iterdir()))
        io.write_text(tmp_path / "video.mp4", "the next writer sweeps what was left of its file")
        assert len(list(tmp_path.iterdir())) == before - 1
        io.output_folder(tmp_path)
        assert list((tmp_path / "states").iterdir()) == []
        assert living.exists()
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == sorted(
        [*mine, "of_a_living_process.npz"]
    )


STOP_A_COMMAND = """
import sys, time
from pigjax import cli
from pigjax import io
from pigjax.cli import segmenting
def slow(path, **_):
    with io.writing(path) as partial:
        partial.write_text("half")
        print("ready", flush=True)
        time.sleep(100)
segmenting.describe_file = slow
sys.argv = ["pigjax", "info", sys.argv[1]]
cli.main()
"""
SENTENCE = "stopped; run the same command again to go on from the last saved state.\n"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_says_how_to_go_on_and_leaves_no_half_file(tmp_path, number, code):
    assert killed(STOP_A_COMMAND, str(tmp_path / "x"), signals=[number], after=0.2) == (code, SENTENCE)
    assert list(tmp_path.iterdir()) == []


def test_a_command_stopped_while_libraries_load_says_its_sentence(tmp_path):
    (tmp_path / "pigjax").mkdir()
    # short sleeps: a signal that comes just before a sleep is seen after it
    waits = "import time; print('ready', flush=True); [time.sleep(0.1) for _ in range(1000)]"
    (tmp_path / "pigjax" / "__init__.py").write_text(waits)
    code = "import pigjax_command; pigjax_command.main()"
    # the working folder comes first where modules are looked for
    assert killed(code, signals=[signal.SIGINT], cwd=tmp_path) == (130, SENTENCE)


def test_errors_of_the_system_are_one_line(command, monkeypatch):
    def fail(path, **_):
        raise OSError(errno.EIO, os.strerror(errno.EIO), "some.ply")

    monkeypatch.setattr(segmenting, "describe_file", fail)
    code, said = command("info", "some.ply")
    assert code == 2
    assert said.startswith("error: some.ply: Input/output error; check the path")
    assert len(said.splitlines()) == 1


# labels and tables


def table_of(name, values, errors=None):
    values = np.asarray(values)
    errors = errors or ("",) * len(values)
    return Table({name: values}, {"loss": values**2}, np.array([not error for error in errors]), tuple(errors))


def history():
    steps = np.arange(3.0)
    return History(steps, steps, steps > 0, {"a.b": steps}, {"loss": steps}, steps, "steps")


@pytest.fixture
def stored(tmp_path):
    io.save_labels(tmp_path / "labels.npz", np.array([0, -1, 3], np.int32), np.ones((3, 4)), np.array([0.5, 0, 1]))
    table_of("objects.duck.young", [1e5, 2e5, 3e5]).save(tmp_path / "table.npz")
    return tmp_path


def test_labels_and_tables_come_back(stored):
    labels = io.load_labels(stored / "labels.npz", 3)
    np.testing.assert_array_equal(labels.object_id, [0, -1, 3])
    assert labels.votes.shape == (3, 4)
    np.testing.assert_array_equal(load_table(stored / "table.npz")["loss"], np.array([1e5, 2e5, 3e5]) ** 2)


@pytest.mark.parametrize(("file", "load"), [("labels.npz", io.load_labels), ("table.npz", load_table)])
@settings(QUICK, max_examples=150)
@given(data=st.data())
def test_a_damaged_archive_is_named_or_read(stored, file, load, data):
    """Bytes changed, cut off or put in: the reader gives what was written, or the project's error."""
    content = bytearray((stored / file).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        kind = data.draw(st.sampled_from(["change", "cut", "insert"]))
        if kind == "change":
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            content = content[: at + 1]
        else:
            content[at:at] = data.draw(st.binary(max_size=8))
    (stored / "damaged.npz").write_bytes(content)
    refusal = None
    try:
        load(stored / "damaged.npz")
    except InputError as error:
        refusal = str(error)
    assert refusal is None or ("damaged.npz: " in refusal and "\n" not in refusal)


BAD_LABELS = {
    "text": {"object_id": np.array(["a", "b", "c"])},
    "dates": {"object_id": np.zeros(3, "datetime64[s]")},
    "no axis": {"object_id": np.array(1)},
    "too far": {"object_id": np.array([0, 1, 2**40])},
    "below": {"object_id": np.array([0, 1, -2])},
    "not finite": {"votes": np.full((3, 4), np.nan)},
    "negative": {"votes": np.full((3, 4), -1)},
    "no share": {"confidence": np.full(3, np.inf)},
    "complex": {"confidence": np.zeros(3, complex)},
    "lengths": {"confidence": np.zeros(2)},
    "no column": {"object_id": np.array([0, 1, 7])},
    "ids twice": {"ids": np.array([0, 1, 1, 2])},
    "ids too far": {"ids": np.array([0, 1, 2, 2**40])},
    "ids below": {"ids": np.array([-3, 0, 1, 2])},
}


@pytest.mark.parametrize("case", BAD_LABELS)
def test_labels_hold_what_labels_can_have(tmp_path, case):
    sound = {"object_id": np.zeros(3, int), "votes": np.ones((3, 4)), "confidence": np.zeros(3)}
    np.savez(tmp_path / "labels.npz", **sound | BAD_LABELS[case])
    with pytest.raises(InputError, match=r"labels\.npz: .*; segment the scene again"):
        io.load_labels(tmp_path / "labels.npz")


def test_archives_hold_no_python_objects(tmp_path):
    with pytest.raises(InputError, match="holds Python objects"):
        io.save_arrays(tmp_path / "a.npz", {"a": np.array([{}])})
    np.savez(tmp_path / "a.npz", a=np.array([{}], object))
    with pytest.raises(InputError, match="it holds Python objects"):
        io.load_arrays(tmp_path / "a.npz", "table", remedy="sweep again")
    np.save(tmp_path / "a.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(InputError, match="it holds Python objects"):
        io.load_array(tmp_path / "a.npy", "array")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_name_written_twice_is_refused(tmp_path):
    """In an archive and in JSON the second would hide the first."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for number in range(2):
            with archive.open("a.npy", "w") as file:
                np.lib.format.write_array(file, np.full(3, number))
    with pytest.raises(InputError, match="two of its arrays have one name"):
        io.load_arrays(tmp_path / "a.npz", "table", remedy="sweep again")
    (tmp_path / "names.json").write_text('{"1": "duck", "2": "table", "1": "ball"}')
    with pytest.raises(InputError, match=r"names\.json: .*the key '1' is written twice"):
        io.load_names(tmp_path / "names.json")


@pytest.mark.parametrize("breaks", ["\n", "\r", "\x85", "\u2028"])
def test_errors_are_one_line_whatever_the_name(tmp_path, breaks):
    with pytest.raises(InputError) as caught:
        io.read_json(tmp_path / f"a{breaks}b.json")
    assert len(str(caught.value).splitlines()) == 1


def test_a_folder_of_a_refused_command_is_free(segment_two, monkeypatch, tmp_path):
    def refuse(*arguments, **options):
        raise InputError("weighting = 'x'")

    with monkeypatch.context() as patched:
        patched.setattr(segmenting, "lift", refuse)
        with pytest.raises(InputError, match="weighting"):
            segment_two(tmp_path / "out", {1: "wrong"})
    segment_two(tmp_path / "out", {1: "duck"})
    assert (tmp_path / "out" / "labels.npz").is_file()


@pytest.mark.parametrize("name", ["file", "allow_pickle", "a/b", "../x", "é"])
def test_arrays_keep_any_name(tmp_path, name):
    io.save_arrays(tmp_path / "a.npz", {name: np.arange(3)})
    np.testing.assert_array_equal(io.load_arrays(tmp_path / "a.npz", "table", remedy="")[name], np.arange(3))
    with np.load(tmp_path / "a.npz") as archive:
        assert archive.files == [name]


def test_no_memory_is_asked_for_that_a_file_does_not_fill(tmp_path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with pytest.raises(InputError, match="tells of 8000000000000 bytes, and 0 follow"):
        io.load_array(path, "array")
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(path, "object_id.npy")
    with pytest.raises(InputError, match="tells of 8000000000000 bytes"):
        io.load_arrays(tmp_path / "a.npz", "table", remedy="")
