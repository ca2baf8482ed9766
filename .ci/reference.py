"""Pages written from the code: `python .ci/reference.py` writes them, `tests/test_reference_pages.py` compares.

Fields of scene and study files come from the structs that decode them: types, choices, ranges and units from their
annotations, meanings from the comments beside them (as the API reference takes them), defaults from the values.
Commands come from the parser of the command line, materials from the presets.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))

import msgspec
import numpy as np
from field_comments import comment_of
from msgspec.structs import fields
from typer.models import ArgumentInfo, ParameterInfo

from pigjax.cli import app
from pigjax.core.checks import Limits
from pigjax.mpm.materials import LAWS, PRESETS, Parameters, material_table, preset
from pigjax.mpm.materials.table import LIMITS
from pigjax.scene.decode import Section, numbers_of, sections_of, wanted
from pigjax.scene.schema import ObjectSpec, Scene, SimulationSpec, VolumeSpec
from pigjax.study.schema import OPTIONS, Study

ROOT = Path(__file__).parents[1]

FROM_OUTSIDE = {"folder"}  # set by the reader of a file, and not a field of it
CELL, CFL = 0.01, SimulationSpec().cfl  # of the steps on the page of materials [m], [-]


class Row(NamedTuple):
    """One field of a table."""

    name: str
    type: str
    default: str
    unit: str
    range: str
    meaning: str


@cache
def comments_of(kind: type) -> dict[str, str]:
    """Comments of a class's own fields."""
    text = Path(inspect.getfile(kind)).read_text("utf-8")
    own = next(n for n in ast.parse(text).body if isinstance(n, ast.ClassDef) and n.name == kind.__name__)
    found = {}
    for field in own.body:
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            found[field.target.id] = comment_of(text.splitlines(), field.lineno, field.end_lineno or field.lineno)
    return found


def meaning_of(kind: type, name: str) -> str:
    """Comment of a field where the class or the nearest base defines it; of a material's number that of the laws."""
    if issubclass(kind, ObjectSpec) and name in LIMITS:
        kind = Parameters
    told = next((own[name] for base in kind.__mro__ if Section in base.__mro__ or base is Parameters
                 if name in (own := comments_of(base))), "")  # fmt: skip
    return told.replace("None:", "left out:")


def rows_of(kind: type[Section]) -> Iterator[Row]:
    """Fields of a section that hold values, in the order of the code."""
    limits = {name: limit for name, _, limit in numbers_of(kind)}
    if issubclass(kind, ObjectSpec):
        limits |= {name: limit for name, (_, limit) in LIMITS.items() if name in limits}
    for field in fields(kind):
        if field.name in FROM_OUTSIDE or field.name in refused(kind):
            continue
        limit = limits.get(field.name)
        meaning = meaning_of(kind, field.name)
        unit, bounds = ("", "") if limit is None else (limit.unit, _range(limit))
        if not unit and meaning.endswith("]") and "[" in meaning:  # "[m]" at the end of a comment
            meaning, _, unit = meaning[:-1].rpartition(" [")
        if issubclass(kind, ObjectSpec) and field.name in LIMITS and meaning.endswith(f" [{unit}]"):
            meaning = meaning.removesuffix(f" [{unit}]")
        default = "of the material" if issubclass(kind, ObjectSpec) and field.name in LIMITS else _default(field)
        yield Row(field.name, _type(field.type), default, unit, bounds, meaning)


def refused(kind: type[Section]) -> tuple[str, ...]:
    """Fields that a volume inherits and refuses."""
    return (*kind.of_captured, "splats") if issubclass(kind, VolumeSpec) else ()


def _range(limit: Limits) -> str:
    told = str(limit).removesuffix(f" {limit.unit}").removesuffix(" in") if limit.unit else str(limit)
    return "" if told.startswith("a finite") else told


def _type(kind: Any) -> str:
    told = wanted(kind)
    if get_origin(kind) is dict:
        return "a table" if get_args(kind)[1] is Any else f"a table (each {wanted(get_args(kind)[1])})"
    return re.sub(r"^one of (\w+)$", r'`"\1"`', told)


def _default(field: Any) -> str:
    if field.required:
        return "**must be given**"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "left out"
    if isinstance(value, Section) or value in ({}, []):
        return "its defaults" if isinstance(value, Section) else "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{list(value)}`" if isinstance(value, list | tuple) else f"`{value:.6g}`"


def sections(kind: type[Section], above: str = "") -> Iterator[tuple[str, type[Section]]]:
    """Tables of a file as they are headed, `[objects.NAME]`, and their structs; tables within tables after them."""
    for field in fields(kind):
        if field.name in refused(kind):
            continue
        own, name = field.type, f"{above}{field.name}"
        if get_origin(own) is dict:
            own, name = get_args(own)[1], f"{name}.NAME"
        kinds = [own] if isinstance(own, type) and issubclass(own, Section) else sections_of(own)
        for one in kinds:
            which = next((get_args(f.type)[0] for f in fields(one) if f.name == "kind"), None)
            yield f"[{name}]" + (f' kind = "{which}"' if which else ""), one
            if which is None:
                yield from sections(one, f"{name}.")


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown; columns without a single entry are left out."""
    kept = [k for k in range(len(head)) if k == 0 or any(row[k] for row in rows)]
    lines = [[head[k] for k in kept], ["---"] * len(kept)]
    lines += [[row[k].replace("|", "\\|").replace("\n", " ") for k in kept] for row in rows]
    return "\n".join("|" + "|".join(f" {cell} " if cell else " " for cell in line) + "|" for line in lines)


def _fields_as_table(kind: type[Section]) -> str:
    rows = [(f"`{r.name}`", *r[1:]) for r in rows_of(kind)]
    return _table(("field", "type", "default", "unit", "range", "meaning"), rows)


def _section(heading: str, kind: type[Section], level: str = "##") -> str:
    parts = [f"{level} {heading}", inspect.cleandoc(kind.__doc__ or "").replace("None:", "left out:")]
    own_rules = kind.rules is not Section.rules
    table = _fields_as_table(kind) if list(rows_of(kind)) else ""
    rules = f"Checked: {_lowered(inspect.cleandoc(kind.rules.__doc__ or ''))}" if own_rules else ""
    return "\n\n".join(part for part in (*parts, table, rules) if part)


def _lowered(text: str) -> str:
    return text[:1].lower() + text[1:]


NOTE = "<!-- Written by .ci/reference.py from the code: change the comments there, and run it again. -->"


def scene_page() -> str:
    """docs/reference/scene.md."""
    told: dict[type, str] = {}
    parts = []
    for heading, kind in sections(Scene):
        if kind in told:
            parts.append(f"## `{heading}`\n\nThe fields of `{told[kind]}`.")
        else:
            told[kind] = heading
            parts.append(_section(f"`{heading}`", kind))
    top = _section("At the top of the file", Scene)
    return "\n\n".join([
        "# Fields of a scene file", NOTE,
        "A scene file is TOML. Only `input.gaussians` and one object with a material must be given: "
        "[a plant in ten lines](../SCENES.md#a-potted-plant-in-ten-lines). Lengths are in metres, times in seconds, "
        "angles as the tables say. A field that is unknown, of another type or out of range is refused in one line "
        "that names it, its value and the remedy. Any of them can be changed for one run: "
        "`--set simulation.frames=8`. \"Left out\" as a default means that the field has no value of its own, and "
        "its meaning says what holds then.",
        top, *parts,
    ]) + "\n"  # fmt: skip


def study_page() -> str:
    """docs/reference/study.md."""
    parts = [_section(f"`{heading}`", kind) for heading, kind in sections(Study)]
    options = [_section(f"`[objective.options]` of `{name}`", kind) for name, kind in OPTIONS.items()]
    return "\n\n".join([
        "# Fields of a study file", NOTE,
        "A study file names a [scene file](scene.md), the parameters of it that vary, and the score: "
        "[what studies are for](../STUDIES.md).",
        _section("At the top of the file", Study), *parts, *options,
    ]) + "\n"  # fmt: skip


class Option(NamedTuple):
    """One argument or option of a command."""

    name: str
    value: str
    default: str
    range: str
    meaning: str


def commands() -> dict[str, tuple[str, str, list[Option]]]:
    """Usage, help and options of each command; the options of the program itself are under ""."""
    main = app.registered_callback
    assert main is not None
    called = {"": main.callback} | {
        command.name or command.callback.__name__.replace("_", "-"): command.callback
        for command in sorted(app.registered_commands, key=lambda c: c.name or c.callback.__name__)
    }
    found = {}
    for name, function in called.items():
        hints, parameters = get_type_hints(function, include_extras=True), inspect.signature(function).parameters
        options = [_option(key, hints[key], parameter.default) for key, parameter in parameters.items()]
        arguments = [option.name.strip("`") for option in options if not option.name.startswith("`-")]
        rest = ["[OPTIONS]"] if len(options) > len(arguments) else []
        usage = " ".join(["pigjax", name, *arguments, *rest]) if name else "pigjax COMMAND"
        found[name] = usage, inspect.getdoc(function) or "", options
    return found


def _option(name: str, hint: Any, default: Any) -> Option:
    kind, *notes = get_args(hint)
    (info,) = (note for note in notes if isinstance(note, ParameterInfo))
    parts = [part for part in get_args(kind) if part is not type(None)] or [kind]
    listed = get_origin(kind) is list or list in {get_origin(part) for part in parts}
    kind = parts[0] if get_origin(kind) is not tuple else kind
    told = "" if default in (None, False, inspect.Parameter.empty) else f"`{default}`"
    if default is inspect.Parameter.empty:
        told = "**must be given**"
    if isinstance(info, ArgumentInfo):
        shown = name.upper() if default is inspect.Parameter.empty else f"[{name.upper()}]"
        return Option(f"`{shown}`", "", told, "", info.help or "")
    switch = kind is bool
    declared = [text for text in (info.default, *(info.param_decls or ())) if isinstance(text, str)]
    names = tuple(part for text in declared or ["--" + name.replace("_", "-")] for part in text.split("/"))
    if switch:
        told = f"`{names[0]}`" if default else ""
        names += (f"--no-{names[0][2:]}",) if not declared else ()
    value = "" if switch else info.metavar or _VALUES.get(kind, "TEXT")
    ends = {"low": info.min, "high": info.max}
    given = {name: end for name, end in ends.items() if end is not None}
    bounds = _range(Limits(**{n: int(e) if kind is int else e for n, e in given.items()})) if given else ""
    return Option(f"`{', '.join(names)}`", (f"`{value}`" if value else "") + (", repeated" if listed else ""), told,
                  bounds, info.help or "")  # fmt: skip


_VALUES: dict[Any, str] = {int: "WHOLE NUMBER", float: "NUMBER", Path: "PATH"}


def commands_page() -> str:
    """docs/reference/commands.md."""
    parts = []
    for name, (usage, told, options) in commands().items():
        table = _table(("option", "value", "default", "range", "meaning"), [tuple(option) for option in options])
        lines = [f"## pigjax {name}".rstrip(), f"`{usage}`", told, table if options else "It has no options."]
        parts.append("\n\n".join(lines))
    return "\n\n".join([
        "# Commands", NOTE,
        "Every command has `-h` and `--help`. Exit codes: 0 done, 1 a check found a fault, 2 bad input (one line names "
        "file or field, value and remedy), 3 the simulation failed, 130 and 143 stopped by Ctrl-C and SIGTERM.",
        *parts,
    ]) + "\n"  # fmt: skip


# What the real matter has, beside a preset: the kind, its density [kg/m³], its stiffness, and what else is told.
REAL = {
    "jelly": ("gelatin dessert", "1000 to 1050", "E 5 to 50 kPa", ""),
    "rubber": ("soft silicone; tyres are ten times as stiff", "930 to 1200", "E 0.1 to 10 MPa", "ν 0.49 to 0.5"),
    "muscle": ("skeletal muscle, stretched passively", "1060", "E 5 to 50 kPa across, 20 to 300 kPa along", ""),
    "metal": ("aluminium", "2700", "E 69 GPa", "yields at 30 to 300 MPa"),
    "steel": ("structural steel", "7850", "E 200 GPa", "yields at 250 MPa and more; the preset does not yield"),
    "stone": ("granite", "2600 to 2700", "E 40 to 70 GPa", "breaks; the preset does not, but see `tearing_stretch`"),
    "plasticine": ("play dough; plasticine at 20 °C yields at 50 kPa and more", "1200 to 1800", "E 0.1 to 5 MPa",
                   "yields at a few kPa"),
    "sand": ("dry sand", "1500 to 1700", "E 10 to 80 MPa", "friction angle 30° to 40°"),
    "wet_sand": ("moist sand", "1700 to 2000", "E 10 to 80 MPa", "cohesion 1 to 5 kPa"),
    "snow": ("seasonal snow, packed", "200 to 500", "E 0.2 to 100 MPa", "numbers of Stomakhin et al. 2013"),
    "foam": ("shaving foam", "60 to 100", "E 0.3 to 1 kPa", "yields at 20 to 100 Pa"),
    "cream": ("whipped cream", "400 to 500", "E 1 to 10 kPa", "yields at 50 to 150 Pa"),
    "mud": ("mud flow", "1300 to 1900", "E 1 to 100 kPa", "yields at 10 to 1000 Pa"),
    "water": ("water at 20 °C", "998", "K 2.2 GPa", "viscosity 1 mPa s"),
    "oil": ("olive oil at 20 °C", "910 to 920", "K 1.6 GPa", "viscosity 80 mPa s"),
    "honey": ("honey at 20 °C", "1400 to 1450", "K about 5 GPa", "viscosity 2 to 20 Pa s"),
    "stationary": ("anything that does not move", "", "", ""),
}  # fmt: skip


def _pascal(value: float) -> str:
    """As 20 kPa."""
    power = min(3, max(0, int(np.log10(abs(value)) // 3)))
    return f"{value / 1000**power:.4g} {('Pa', 'kPa', 'MPa', 'GPa')[power]}"


# How the page tells a preset's numbers beside density and stiffness: a mark, and the unit if it is no pressure.
OTHERS = {
    "fibre_stiffness": ("E of fibres", "Pa"),
    "yield_stress": ("yields at", "Pa"),
    "hardening_modulus": ("hardening modulus", "Pa"),
    "residual_stress": ("softens to", "Pa"),
    "friction_angle": ("friction angle", "°"),
    "cohesion": ("cohesion", "Pa"),
    "viscosity": ("viscosity", "Pa s"),
    "flow_exponent": ("exponent", ""),
    "hardening_coefficient": ("ξ", ""),
    "critical_compression": ("packs at", ""),
    "critical_stretch": ("breaks at", ""),
    "poisson": ("ν", ""),
}


def _others(numbers: dict[str, Any]) -> str:
    """Numbers of a preset beside density and stiffness, as "ν 0.4, yields at 8 kPa"."""
    told = []
    for name in ("poisson", *(key for key in numbers if key in OTHERS and key != "poisson")):
        if name in numbers:
            mark, unit = OTHERS[name]
            value = math.degrees(numbers[name]) if unit == "°" else numbers[name]
            if unit == "Pa s" and value < 0.1:
                value, unit = 1000 * value, "mPa s"
            told.append(f"{mark} {_pascal(value)}" if unit == "Pa" else f"{mark} {value:.4g} {unit}".rstrip())
    return ", ".join(told).replace(" °", "°")


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def materials_page() -> str:
    """docs/MATERIALS.md."""
    speeds = np.asarray(material_table([preset(name) for name in PRESETS]).wave_speed, float)
    rows = []
    for (name, numbers), speed in zip(PRESETS.items(), speeds):
        stiff = [f"{mark} {_pascal(numbers[key])}" for key, mark in (("young", "E"), ("bulk_modulus", "K"))
                 if key in numbers]  # fmt: skip
        what, density, stiffness, more = REAL[name]
        step = _two_digits(CFL * CELL / speed * 1e6) if speed > 0 else ""
        rows.append((f"`{name}`", what, f"{numbers['density']:.5g}", density, ", ".join(stiff), stiffness,
                     _others(numbers), more, _two_digits(speed) if speed > 0 else "", step))  # fmt: skip
    head = ("preset", "real matter", "density [kg/m³]", "real density", "stiffness", "real stiffness", "other numbers",
            "real ones", "pressure waves [m/s]", "step [µs]")  # fmt: skip
    laws = [(f"`{name}`", ", ".join(f"`{n}`" for n in ("density", *law.needs)),
             ", ".join(f"`{key}`" for key, numbers in PRESETS.items() if numbers["model"] == name))
            for name, law in LAWS.items()]  # fmt: skip
    numbers = [
        (f"`{name}`", limit.unit, _range(limit), meaning_of(ObjectSpec, name).removesuffix(f" [{limit.unit}]"))
        for name, (_, limit) in LIMITS.items()
        if name in {f.name for f in fields(ObjectSpec)}
    ]
    return "\n\n".join([
        "# Materials", NOTE, TEXT_OF_MATERIALS, "## Presets beside real matter",
        _table(head, rows),
        f"The last column is the longest explicit step on a grid of {100 * CELL:g} cm at `cfl` {CFL:g}, of matter that "
        "moves slowly: cfl · dx / c, with the speed c of pressure waves. Real numbers are common ranges of handbooks; "
        "matter of one name may differ by more than that.",
        TEXT_OF_SOFTENING, "## Laws", "The stress and the flow rule of each are in [MPM.md](MPM.md).",
        _table(("`model`", "numbers that it needs", "presets"), laws), "## Numbers",
        _table(("field", "unit", "range", "meaning"), numbers),
    ]) + "\n"  # fmt: skip


TEXT_OF_MATERIALS = """A material is a law with its parameters, in SI units. A preset is a material with an everyday name; its parameters can be replaced one by one:

```toml
[objects.duck]
material = "jelly"
young = 8e3        # softer than the preset's 20 kPa
```

`pigjax materials` prints the presets, `pigjax materials jelly` one of them; in Python `print(pj.preset("jelly"))` and `pj.Material("fixed_corotated", density=1000, young=8e3, poisson=0.4)`."""  # noqa: E501

TEXT_OF_SOFTENING = """## Why metal is soft here

Young's modulus of real aluminium is 69 GPa and of real steel 200 GPa; that of the preset `metal` is 5 MPa. `rubber` and `sand` are softer than most real ones, and `water` is ten thousand times more compressible. The reason is the explicit step: a pressure wave may cross less than a cell per step, so the step is proportional to dx / √(E/ρ). For real steel on a grid of a centimetre it is a microsecond, hence some 40,000 steps a frame. A stiff body whose waves are a hundred times slower still looks rigid in a video, as long as its own weight and its impacts deform it little: ρ g h ≪ E and ρ v² ≪ E. The preset keeps the density of aluminium, so that it pushes other objects as aluminium does. Its yield stress is lowered with its stiffness: it dents where the stress of an impact, ρ c v, reaches 100 kPa, from about 0.7 m/s; soft aluminium dents from about 2 m/s.

Consequences:

- Weight, friction, flow and shape at rest are those of the named matter. The pitch of vibrations, the duration of an impact and the depth of a dent in `metal` are not: do not use it to predict forces or stresses of a real part.
- `steel` and `stone` have the real moduli. They need `simulation.integrator = "implicit"` or slow motion. An object that need not deform is cheaper with `rigid = true`, which uses only its density, or with `fixed = true` if it does not move.
- The `bulk_modulus` of water only has to prevent visible compression: waves should be ten times as fast as the flow (Monaghan 1994). The preset's 14 m/s suffice for flows up to about 1.4 m/s, that is falls of 10 cm. For higher falls raise `bulk_modulus` with the square of the speed.
- To fit parameters to a real object, tune them against its video: [studies](STUDIES.md). Without known forces a video determines only E/ρ."""  # noqa: E501


def pages() -> dict[Path, str]:
    """All pages that are written from the code."""
    docs = ROOT / "docs"
    return {
        docs / "reference" / "scene.md": scene_page(),
        docs / "reference" / "study.md": study_page(),
        docs / "reference" / "commands.md": commands_page(),
        docs / "MATERIALS.md": materials_page(),
    }


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, "utf-8")
