"""The docs keep their word: links, names and files exist, and every public name says how it is used."""

import ast
import importlib.util
import json
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *ROOT.glob("examples/**/*.md")])
PROSE = [page for page in PAGES if page.name != "CHANGELOG.md"]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))


def name_of(path):
    return str(path.relative_to(ROOT))


def text_of(path):
    """A page without its code blocks, or the Markdown cells of a notebook."""
    if path.suffix == ".ipynb":
        cells = json.loads(path.read_text("utf-8"))["cells"]
        return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    return re.sub(r"```.*?```", "", path.read_text("utf-8"), flags=re.S)


def anchors_of(page):
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_no_relative_link_is_broken(path):
    for target in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", text_of(path)):
        file, _, anchor = target.partition("#")
        page = (path.parent / file).resolve() if file else path
        assert page.exists(), f"{name_of(path)}: {target}"
        if DOCS in path.parents:
            assert DOCS in page.parents, f"{name_of(path)}: {target} leads out of the site; name the file in code marks"
        if anchor:
            assert anchor in anchors_of(page), f"{name_of(path)}: {target}"


HISTORY = r"\d+ (January|February|March|April|May|June|July|August|September|October|November|December)\b"
HISTORY += r"|\b(older|former|previous|earlier) (code|version)|\bused to be\b|\bno longer (needed|used)|\banew\b"


@pytest.mark.parametrize("path", [*PROSE, *NOTEBOOKS], ids=name_of)
def test_pages_tell_no_history(path):
    for line in text_of(path).splitlines():
        printed = line.startswith("|")  # messages of the program, as benchmarks quote them
        assert printed or not (found := re.search(HISTORY, line)), f"{found.group()!r} in: {line[:200]}"


@cache
def defined_in(file):
    """Names that a module defines at its top, and `Class.member`."""
    names = set()
    for node in ast.parse((ROOT / file).read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            members = [child for child in node.body if isinstance(child, ast.FunctionDef | ast.AnnAssign)]
            names |= {f"{node.name}.{getattr(m, 'name', None) or m.target.id}" for m in members}
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            if isinstance(target, ast.Name):
                names.add(target.id)
    return names


def rows_of(page, heading):
    """Cells of the table under a heading."""
    section = re.split(rf"^#+ {re.escape(heading)}$", page.read_text("utf-8"), maxsplit=1, flags=re.M)[1]
    table = re.search(r"^\|.*?(?=^[^|]|\Z)", section, re.M | re.S).group()
    return [re.split(r"(?<!\\)\|", line.strip()[1:-1]) for line in table.strip().splitlines()[2:]]


def test_the_table_where_is_names_files_and_functions():
    rows = rows_of(DOCS / "ARCHITECTURE.md", "Where is ...")
    assert len(rows) >= 20
    missing = []
    for question, file, names in rows:
        path = file.strip().strip("`")
        if not (ROOT / path).is_file():
            missing.append(f"{question.strip()} {path}")
            continue
        missing += [f"{path}: {name}" for name in re.findall(r"`([^`]+)`", names) if name not in defined_in(path)]
    assert missing == []


@pytest.mark.parametrize(("page", "package"), [("MPM.md", "mpm"), ("RENDERING.md", "splatting")])
def test_equations_name_functions(page, package):
    """`module.function` and `folder/module.py` of the two pages of equations."""
    text = text_of(DOCS / page)
    modules = {path.stem: path for path in (ROOT / "pigjax" / package).glob("*.py")}
    modules |= {path.stem: path for path in (ROOT / "pigjax" / package).glob("materials/*.py")}
    missing = []
    for module, name in re.findall(r"`([a-z]\w*)\.(\w+)`", text):
        if name == "py" or module in ("core", "jax", "lax", "jnp"):
            continue
        if module not in modules or name not in defined_in(modules[module].relative_to(ROOT)):
            missing.append(f"{module}.{name}")
    for file in re.findall(r"`([\w/]+\.py)`", text):
        found = [ROOT / file, ROOT / "pigjax" / package / file, ROOT / "pigjax" / file]
        missing += [] if any(path.is_file() for path in found) else [file]
    assert missing == []


def test_glossary_has_files_and_sources():
    terms, sources = rows_of(DOCS / "GLOSSARY.md", "Glossary"), rows_of(DOCS / "GLOSSARY.md", "Sources")
    known = [short.strip() for short, _ in sources] + ["this project", "common usage", "JAX documentation", "linear"]
    missing = []
    for term, meaning, file, source in terms:
        path = ROOT / "pigjax" / file.strip().strip("`")
        missing += [] if path.is_file() else [f"{term.strip()}: {file}"]
        missing += [] if any(short in source for short in known) else [f"{term.strip()}: {source}"]
        assert meaning.strip()
    assert missing == []
    names = [term.strip().lower().replace("_", " ") for term, *_ in terms]
    assert names == sorted(names)
    # the words by which a reader of the literature searches
    words = {"p2g", "g2p", "rasterize", "binning", "adjoint", "penalty", "active grid", "affine momentum"}
    assert words <= set(names)


def test_docs_name_benchmarks_that_exist():
    folder = ROOT / "benchmarks"
    for path in [*PROSE, *NOTEBOOKS]:
        for name in re.findall(r"python -m benchmarks (\w+)", text_of(path)):
            known = (folder / f"{name}.py").is_file() or (folder / name / "parts.py").is_file()
            assert known or name == "NAME", f"{name_of(path)}: {name}"


# ---- docstrings of public names, which make the API reference

PACKAGE = ROOT / "pigjax"
COMMENTS = importlib.util.spec_from_file_location("field_comments", ROOT / ".ci" / "field_comments.py")
comment_of = (module := importlib.util.module_from_spec(COMMENTS), COMMENTS.loader.exec_module(module))[0].comment_of

ALGORITHMS = {
    "BodyContact",
    "ClampParams",
    "associate_masks",
    "boundary_iou",
    "collider_from_gaussians",
    "contributions",
}
ALGORITHMS |= {"eigen_clamp", "evaluate_labels", "lift_masks", "reconstruct", "render", "rollout", "search", "ssim"}
ALGORITHMS |= {"seed_particles", "stable_dt", "step", "surface_depth"}
SOURCE = r"\(.*\b(19|20)\d\d\b|arXiv|doi|paper \d|\bPIG\b|section \d|et al\."
UNITS = {"dt": "[s]", "frame_dt": "[s]", "gravity": "[m/s²]", "spacing": "[m]", "margin": "[m]", "max_speed": "[m/s]"}
UNITS |= {"volume": "[m³]", "velocity": "[m/s]", "velocities": "[m/s]", "dx": "[m]", "x": "[m]", "radius": "[m]"}
RAISED = ("check_fields", "raise")


def resolved(name, file=PACKAGE / "__init__.py"):
    """Module and definition of a name that a module defines or imports."""
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return file, node
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("pigjax"):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    path = ROOT / Path(*node.module.split("."))
                    return resolved(alias.name, path / "__init__.py" if path.is_dir() else path.with_suffix(".py"))
    raise LookupError(f"{name} in {file}")


def public_names():
    for node in ast.parse((PACKAGE / "__init__.py").read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "__all__":
            return ast.literal_eval(node.value)
    raise LookupError("pigjax.__all__")


def lacks_of(name):
    """What the docstring of a public name does not say."""
    file, node = resolved(name)
    doc = ast.get_docstring(node) or ""
    lacks = set() if doc else {"docstring"}
    lacks |= lacks_of_class(file, node, doc) if isinstance(node, ast.ClassDef) else lacks_of_function(node, doc)
    said = doc + (ast.get_docstring(ast.parse(file.read_text("utf-8"))) or "")
    if name in ALGORITHMS and not re.search(SOURCE, said):
        lacks.add("source")
    return lacks


def lacks_of_function(node, doc):
    given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    listed = set(re.findall(r"^ {4}(\w+): ", doc.partition("Args:\n")[2], re.M))
    names = {argument.arg for argument in given}
    # a docstring of a line or two may name one or two arguments in its sentence
    told = {argument for argument in names if len(names) <= 2 and re.search(rf"\b{argument}\b", doc)}
    lacks = names - listed - told
    lacks |= {f"{n} {unit}" for n, unit in UNITS.items() if n in names - lacks and unit not in doc}
    if any(isinstance(child, ast.Raise) and child.exc for child in ast.walk(node)) and "Raises:" not in doc:
        lacks.add("Raises")
    return lacks


def lacks_of_class(file, node, doc):
    lines, lacks = file.read_text("utf-8").splitlines(), set()
    for field in node.body:
        if isinstance(field, ast.AnnAssign) and not field.target.id.startswith("_"):
            said = comment_of(lines, field.lineno, field.end_lineno) or re.search(rf"\b{field.target.id}\b", doc)
            lacks |= set() if said else {field.target.id}
    checks = [m for m in node.body if getattr(m, "name", "") in ("__check_init__", "__post_init__")]
    if any(word in ast.unparse(check) for check in checks for word in RAISED) and "Raises:" not in doc:
        lacks.add("Raises")
    return lacks


def test_public_names_say_how_they_are_used():
    assert {name: lacks for name in public_names() if (lacks := lacks_of(name))} == {}


def test_the_api_reference_has_every_public_name_once():
    shown = [
        name for page in DOCS.glob("api/*.md") for name in re.findall(r"^::: pigjax\.(\w+)$", page.read_text(), re.M)
    ]
    assert sorted(shown) == sorted(public_names())
