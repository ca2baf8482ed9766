"""Imports point down only, importing is cheap and changes nothing."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PACKAGE = Path(__file__).parents[1] / "pigjax"

# A package may import its own modules and what stands on a lower layer.
LAYERS = [
    {"core"},
    {"io"},
    {"splatting", "mpm"},
    {"splat", "mls_mpm"},
    {"clamp", "segmentation"},
    {"reconstruction", "objects", "coupling"},
    {"scene"},
    {"study"},
    {"cli"},
    {"__main__"},
]
LAYER_OF = {package: layer for layer, packages in enumerate(LAYERS) for package in packages}


def imports_of(path):
    """Modules of pigjax that a file names at its top or within its functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "pigjax":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in NAMES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("pigjax."))


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def name_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path): path for path in MODULES}


def package_of(name):
    return name.split(".")[1]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_down(path):
    here = package_of(name_of(path))
    for other in {package_of(name) for name in imports_of(path)} - {here}:
        assert LAYER_OF[other] < LAYER_OF[here], f"{here} must not import {other}"


def test_no_module_imports_itself_by_way_of_others():
    below = {name: {other for other in imports_of(path) if other != name} for name, path in NAMES.items()}
    done: set[str] = set()

    def visit(name, path):
        assert name not in path, " imports ".join([*path[path.index(name) :], name])
        if name not in done:
            for other in below.get(name, ()):
                visit(other, [*path, name])
            done.add(name)

    for name in below:
        visit(name, [])


def test_the_top_of_the_package_has_fourteen_entries():
    entries = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert entries - {"__init__", "__main__"} == set(LAYER_OF) - {"__main__"}
    assert len(entries - {"__init__", "__main__"}) == 14


# what opens, writes, makes or removes files, as a function or method of any module
TOUCHES = {"open", "write_text", "write_bytes", "mkdir", "makedirs", "unlink", "rmdir", "rmtree", "rename"}
TOUCHES |= {"savefig", "savez", "savez_compressed", "savetxt", "tofile", "touch", "symlink_to", "copyfile", "move"}
TOUCHES_OF = {"np": {"save", "load", "loadtxt", "genfromtxt", "fromfile", "memmap"}, "os": {"replace", "remove"}}
TOUCHES_OF |= {"pickle": {"dump", "load"}, "json": {"dump", "load"}, "tomllib": {"load"}, "Image": {"open"}}


def test_only_io_touches_files():
    for path in MODULES:
        if package_of(name_of(path)) == "io":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            if isinstance(node.func, ast.Name):
                assert node.func.id not in TOUCHES, f"{path}:{node.lineno}: {ast.unparse(node.func)}; use pigjax.io"
            elif isinstance(node.func, ast.Attribute):
                if ast.unparse(node.func.value) == "io":
                    continue
                of = TOUCHES_OF.get(ast.unparse(node.func.value), set())
                written_by_door = (path.name, node.func.attr) == ("search.py", "write_bytes")  # inside `io.writing`
                if not written_by_door:
                    assert node.func.attr not in TOUCHES | of, (
                        f"{path}:{node.lineno}: {ast.unparse(node.func)}; use pigjax.io"
                    )


PAGE = PACKAGE.parent / "docs" / "ARCHITECTURE.md"


def layers_as_text():
    """The table of layers in docs/ARCHITECTURE.md: `python tests/test_architecture.py` writes it there."""
    rows = ["| layer | module | content |", "|---|---|---|"]
    for layer, modules in reversed(list(enumerate(LAYERS))):
        for module in sorted(modules):
            package = PACKAGE / module / "__init__.py"
            file = package if package.is_file() else PACKAGE / f"{module}.py"
            said = (ast.get_docstring(ast.parse(file.read_text())) or "").splitlines()[0]
            rows.append(f"| {layer} | `{module}{'/' if package.is_file() else ''}` | {said} |")
    return "\n".join(rows)


def test_the_page_on_architecture_prints_the_layers():
    assert layers_as_text() in PAGE.read_text(), "run python tests/test_architecture.py"


def test_products_keep_full_precision():
    host = {"pigjax.reconstruction.init", "pigjax.coupling.sdf_collider", "pigjax.coupling.solid"}  # float64 of NumPy
    host |= {"pigjax.objects.association", "pigjax.scene.draft", "pigjax.mpm.materials.energy"}
    rounded = {"matmul", "einsum", "dot", "vdot", "tensordot", "inner"}  # to TF32, on accelerators
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
                on_host = name_of(path) in host or package_of(name_of(path)) == "io"
                assert on_host, f"{path}:{node.lineno}: use arrays.matmul"
            if isinstance(node, ast.Attribute) and node.attr in rounded and ast.unparse(node.value) == "jnp":
                assert path.name == "arrays.py", f"{path}:{node.lineno}: use arrays.{node.attr}"


def test_modules_are_short():
    for path in MODULES:
        assert len(path.read_text().splitlines()) <= 600, f"{path.name}: one idea each, at most 600 lines"


ANNOTATED = ("mpm",)  # packages whose functions the type checker of the tests sees


def functions_of(node, name=""):
    """Functions of a module and methods of its classes; the inner ones of a function see what it has checked."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield from functions_of(child, f"{name}{child.name}.")
        elif isinstance(child, ast.FunctionDef):
            yield f"{name}{child.name}", child


@pytest.mark.parametrize("package", ANNOTATED)
def test_every_argument_and_result_is_annotated(package):
    bare = []
    for path in sorted((PACKAGE / package).rglob("*.py")):
        for name, function in functions_of(ast.parse(path.read_text())):
            own = function.args
            arguments = [*own.posonlyargs, *own.args, *own.kwonlyargs, own.vararg, own.kwarg]
            missing = [a.arg for a in arguments if a and a.annotation is None and a.arg not in ("self", "cls")]
            missing += ["the result"] if function.returns is None else []
            if missing:
                bare.append(f"{path.relative_to(PACKAGE)}:{function.lineno} {name}: {', '.join(missing)}")
    assert bare == []


def test_import_is_fast_and_changes_no_configuration():
    code = """
import time
begun = time.process_time()
import jax, jax.numpy, equinox, optax, msgspec, scipy.optimize, scipy.spatial, scipy.ndimage
libraries, before = time.process_time(), dict(jax.config.values)
import pigjax, sys
assert "warp" not in sys.modules, "Warp is imported where it is taken only"
print(libraries - begun, time.process_time() - libraries)
assert before.items() <= dict(jax.config.values).items(), "jax.config changed"
"""
    # processor time beside that of the libraries under it, as the machine may be busy with other things
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3)]
    libraries, own = np.min([[float(seconds) for seconds in run.stdout.split()] for run in runs], axis=0)
    print(f"import pigjax: {own:.2f} s beyond the {libraries:.2f} s of its libraries")
    assert own < 0.8 * libraries  # 0.4 on a quiet machine; jaxtyping makes a class of each shape


def test_every_public_name_has_a_docstring():
    import pigjax

    missing = [name for name in pigjax.__all__ if not (getattr(pigjax, name).__doc__ or "").strip()]
    assert missing == []


if __name__ == "__main__":
    before, _, rest = PAGE.read_text().partition("| layer |")
    PAGE.write_text(before + layers_as_text() + "\n" + rest[rest.index("\n\n") + 1 :])
