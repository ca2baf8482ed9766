"""The manual's pages that are written from the code are complete and up to date; what is printed is readable."""

import importlib.util
import json
import re
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from msgspec.structs import fields

import pigjax as pj
from pigjax.mpm.materials import PRESETS

ROOT = Path(__file__).parents[1]


def _module(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = before
    return module


reference = _module("reference")


PAGES = reference.pages()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_are_as_the_code_says(path):
    assert path.read_text("utf-8") == PAGES[path], "run python .ci/reference.py"


FILES = [reference.Scene, reference.Study, *reference.OPTIONS.values()]
SECTIONS = {kind for file in FILES for kind in (file, *(own for _, own in reference.sections(file)))}


@pytest.mark.parametrize("kind", sorted(SECTIONS, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__)
def test_every_field_of_a_file_says_its_meaning_and_default(kind):
    rows = list(reference.rows_of(kind))
    hidden = {*reference.FROM_OUTSIDE, *reference.refused(kind)}
    assert {row.name for row in rows} == {field.name for field in fields(kind)} - hidden
    lacking = [row.name for row in rows if len(row.meaning) < 3 or not row.default or not row.type]
    assert lacking == []


def test_every_number_with_a_unit_tells_it():
    lacking = []
    for kind in SECTIONS:
        units = {name: limit.unit for name, _, limit in reference.numbers_of(kind) if limit.unit}
        lacking += [row.name for row in reference.rows_of(kind) if row.unit != units.get(row.name, row.unit)]
    assert lacking == []
    told = {row.name: row for row in reference.rows_of(reference.ObjectSpec)}
    assert (told["young"].unit, told["young"].range, told["poisson"].range) == ("Pa", "> 0", "in (-1, 0.5)")


def test_every_section_of_the_package_is_on_a_page():
    section = reference.Section
    made = {kind for base in section.__subclasses__() for kind in (base, *base.__subclasses__())}
    bases = {kind for kind in made if kind.__subclasses__()}
    own = {kind for kind in made - bases if kind.__module__.startswith("pigjax.")}
    assert own - SECTIONS == set()


def test_every_option_of_a_command_says_its_meaning():
    told = reference.commands()
    assert {"", "demo", "run", "new", "export", "view", "doctor", "materials"} <= set(told)
    lacking = [f"{name} {o.name}" for name, (_, help, options) in told.items() for o in options if not o.meaning]
    assert lacking == []
    assert [name for name, (_, help, _) in told.items() if not help] == []
    names = {option.name for option in told["run"][2]}
    assert {"`SCENE`", "`--out, -o`", "`--set`", "`--quiet, -q`", "`--overwrite`"} <= names


def test_every_preset_stands_beside_real_matter():
    assert set(reference.REAL) == set(PRESETS)
    for name, (what, density, stiffness, _) in reference.REAL.items():
        assert what
        assert name == "stationary" or (density and stiffness), name


# ---- what is printed


def test_a_material_prints_its_numbers_with_units():
    lines = str(pj.preset("jelly")).splitlines()
    assert lines[0] == "Material of model 'fixed_corotated'"
    assert [line.split() for line in lines[1:]] == [
        ["density", "1000", "kg/m³"], ["young", "20000", "Pa"], ["poisson", "0.4"]
    ]  # fmt: skip
    assert all(len(repr(pj.preset(name)).splitlines()) <= 8 for name in PRESETS)


def test_a_material_of_arrays_or_traced_numbers_prints():
    many = pj.Material("fluid", density=np.ones(3), bulk_modulus=1e5)
    assert "array of shape (3,)" in str(many)
    said = []
    jax.jit(lambda young: said.append(str(pj.Material("stvk_hencky", density=1.0, young=young, poisson=0.3))))(1.0)
    assert re.search(r"young +traced Pa", said[0])


def test_help_of_a_material_tells_units():
    assert "young: Young's modulus, > 0 Pa" in pj.Material.__doc__
    assert pj.Material.__doc__.startswith("One material")


def test_dir_shows_the_public_names_alone():
    assert dir(pj) == sorted(pj.__all__)


# ---- the package


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "pigjax" / "py.typed").is_file()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert "Typing :: Typed" in project["classifiers"]


def test_the_readme_of_an_index_has_no_relative_link_or_picture():
    readme = (ROOT / "README.md").read_text("utf-8")
    hook = _module("package_readme")
    alone = hook.for_index(readme, "")
    assert "](docs/" not in alone
    assert "![" not in alone
    assert "docs/GPU.md" in alone  # still named
    assert re.findall(r"\]\((?!https?:|#)[^)]*\)", alone) == []
    linked = hook.for_index(readme, "https://example.org/pigjax/blob/main")
    assert "](https://example.org/pigjax/blob/main/docs/GPU.md)" in linked
    assert re.findall(r"\]\((?!https?:|#)[^)]*\)", linked) == []


NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_need_nothing_but_the_package(path):
    cells = json.loads(path.read_text("utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for word in ("benchmarks", "sys.path", "PIGJAX_SHORT", "../", "SHORT"):
        assert word not in code, word
    assert len({cell["id"] for cell in cells}) == len(cells)
