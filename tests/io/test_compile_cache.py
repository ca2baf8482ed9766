"""The folder of compiled programs: where it is, when there is none, and its size."""

import os

import jax
import pytest

from pigjax.io.compile_cache import SWITCH, cache_folder, trim, use_compile_cache


@pytest.fixture
def no_switches(monkeypatch):
    for name in (SWITCH, "CI", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


def test_programs_lie_in_the_users_cache_or_the_given_folder(no_switches, tmp_path):
    no_switches.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder().parent == tmp_path / "pigjax"
    no_switches.setenv(SWITCH, str(tmp_path / "own"))
    assert cache_folder().parent == tmp_path / "own"
    no_switches.setenv("CI", "true")
    assert cache_folder().parent == tmp_path / "own", "asked for"


@pytest.mark.parametrize(("name", "value"), [(SWITCH, "off"), (SWITCH, "0"), ("CI", "true"), ("CI", "1")])
def test_nothing_is_kept_where_that_is_said(no_switches, name, value):
    no_switches.setenv(name, value)
    assert cache_folder() is None


def test_another_processor_has_another_folder(no_switches, tmp_path):
    no_switches.setenv(SWITCH, str(tmp_path))
    here = cache_folder()
    no_switches.setattr("pigjax.io.compile_cache._processor", lambda: "another")
    assert cache_folder() != here


def test_the_longest_unused_programs_leave_first(tmp_path):
    for age in range(5):
        path = tmp_path / f"program{age}"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    assert trim(tmp_path, 300) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"program0", "program1", "program2"}
    assert trim(tmp_path, 300) == 0


def test_a_folder_that_the_user_gave_jax_is_kept(no_switches, tmp_path):
    no_switches.setenv(SWITCH, str(tmp_path / "unused"))
    given = jax.config.jax_compilation_cache_dir
    assert given, "tests/conftest.py gives one"
    use_compile_cache()
    assert jax.config.jax_compilation_cache_dir == given
    assert not (tmp_path / "unused").exists()


def test_a_folder_that_cannot_be_made_keeps_nothing(no_switches, tmp_path):
    (tmp_path / "file").write_text("")
    no_switches.setenv(SWITCH, str(tmp_path / "file" / "below"))
    given = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        use_compile_cache()
        assert jax.config.jax_compilation_cache_dir is None
    finally:
        jax.config.update("jax_compilation_cache_dir", given)
