"""The one command of all benchmarks, its pages and its timer."""

import sys
import time
from types import SimpleNamespace

import jax
import pytest

from benchmarks.common import command
from benchmarks.common.pages import MEDIA, PAGES, head, picture, replaced, row
from benchmarks.common.timing import frames_of, in_turn

NAMES = command.names()


def test_without_a_name_all_benchmarks_are_listed_with_a_line_each(capsys):
    command.main([])
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split()[0] for line in lines] == sorted(NAMES)
    assert all(len(line.split()) > 3 and line.endswith(".") for line in lines)


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_has_parts_and_an_own_page(name):
    module = command.load(name)
    assert module.PARTS
    for title, study in module.PARTS.values():
        assert title
        assert callable(study)
    options = command.parser_of(name, module).parse_args([*module.PARTS, "--write"])
    assert options.parts == list(module.PARTS)
    assert options.write == PAGES / f"{name.upper()}.md"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing"], "no benchmark nothing: choose from ablation"),
        (["linalg", "nothing"], "no part nothing: choose from matrices"),
        (["linalg", "--write", "matrices"], "a page ends in .md"),
    ],
)
def test_unknown_names_are_refused_with_those_that_there_are(arguments, said, capsys):
    with pytest.raises(SystemExit) as ended:
        command.main(arguments)
    assert said in f"{ended.value}{capsys.readouterr().err}"


def test_a_part_is_printed_with_its_command_and_written_into_its_section(tmp_path, capsys, monkeypatch):
    module = SimpleNamespace(
        PARTS={"twice": ("Twice", lambda options: print(2 * options.count)), "text": ("Text", lambda _: "given")},
        OPTIONS={"count": {"type": int, "default": 3}, "forward-only": {"action": "store_true"}},
    )
    monkeypatch.setattr(command, "load", lambda _: module)
    page = tmp_path / "PAGE.md"
    page.write_text("# Own heading\n\nProse.\n")
    for count in ("4", "5"):
        arguments = ["--count", count, "--forward-only", "--write", str(page), "--media", str(tmp_path)]
        command.main(["linalg", "twice", *arguments])
    command.main(["linalg", "text", "--write", str(page), "--media", str(tmp_path)])
    shown, written = capsys.readouterr().out, page.read_text()
    assert "`python -m benchmarks linalg twice --count 5 --forward-only`, " in shown
    assert "; load " in shown
    assert written.startswith("# Own heading\n\nProse.\n\n## Twice\n\n<!-- Twice: printed -->\n")
    assert "\n10\n" in written
    assert "\n8\n" not in written
    assert "\ngiven\n" in written


def test_a_section_is_replaced_between_its_marks_and_keeps_its_prose():
    page = replaced("# Page\n\n## One\n\nProse.\n", "Two", "first")
    again = replaced(page, "Two", "a \\1 second")
    assert again == page.replace("first", "a \\1 second")
    assert again.startswith("# Page\n\n## One\n\nProse.\n\n## Two\n")


def test_tables_and_links_are_markdown():
    assert f"{head('a', 'b')}\n{row(1, 'x')}" == "| a | b |\n|---|---|\n| 1 | x |"
    name = picture("a.png", "told").partition("(")[2].rstrip(")")
    assert (PAGES / name).resolve() == MEDIA / "a.png"


def test_runs_are_timed_in_turn_after_one_call_that_compiles():
    calls, first = [], {"a": 0.2, "b": 0.0}

    def run(name):
        calls.append(name)
        time.sleep(first.pop(name, 0.01))
        return name

    found = in_turn({name: (lambda name=name: run(name)) for name in "ab"}, windows=4)
    assert calls == list("ab" * 5)
    assert len(found["a"].windows) == 4
    assert found["a"].result == "a"
    assert found["a"].compile_seconds > 0.1 > found["b"].compile_seconds
    assert found["a"].over(found["a"]) == 1


def test_time_that_is_up_leaves_three_windows():
    assert len(in_turn({"a": lambda: time.sleep(0.01)}, windows=9, seconds=0.0)["a"].windows) == 3


def test_steps_give_all_states_and_a_window_each():
    found = frames_of(lambda x: x + 1, 0, 5)
    assert found.result == list(range(6))
    assert len(found.windows) == 5


def test_no_benchmark_patches_the_library():
    files = [
        path for path in command.HERE.rglob("*.py") if "mock" in path.read_text() or "setattr(" in path.read_text()
    ]
    assert not files


def test_a_reconstruction_is_shared_by_the_devices_that_there_are(monkeypatch):
    """And by no others: a machine with one accelerator and 16 cores has one."""
    module, asked = command.load("reconstruct"), []
    monkeypatch.setattr(module, "reconstruct", lambda views, config, **_: asked.append(config) or sys.exit())
    for given in ([], ["--devices", "1"]):
        options = command.parser_of("reconstruct", module).parse_args(given)
        with pytest.raises(SystemExit):
            module.train(options)
    assert [config.render.bands for config in asked] == [jax.local_device_count()] * 2
