"""Functions of the rasterizer have annotated shapes, which the hook of conftest.py checks, and settings have limits."""

import ast
from pathlib import Path

import pytest

import pigjax.splatting
from pigjax.core.errors import InputError
from pigjax.splatting.types import RenderConfig

MODULES = sorted(Path(pigjax.splatting.__file__).parent.glob("*.py"))


def functions_of(tree):
    """Functions and methods of a module. Functions inside of functions are left to the shapes that these declare."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node
        elif isinstance(node, ast.ClassDef):
            yield from (inner for inner in node.body if isinstance(inner, ast.FunctionDef))


def unannotated(path):
    """Functions with an argument or a result without annotation, and arrays without shape."""
    for function in functions_of(ast.parse(path.read_text())):
        arguments = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
        hints = [argument.annotation for argument in arguments if argument.arg != "self"]
        if not function.name.startswith("__"):
            hints.append(function.returns)
        if None in hints or any(hint is not None and ast.unparse(hint) == "Array" for hint in hints):
            yield f"{path.name}:{function.name}"


def test_every_function_has_annotated_shapes():
    assert [name for path in MODULES for name in unannotated(path)] == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tile_size": 0}, r"RenderConfig\.tile_size = 0: must be 1 px or more"),
        ({"alpha_max": 1.5}, r"RenderConfig\.alpha_max = 1.5: must be"),
        ({"transmittance_min": 1.0}, r"RenderConfig\.transmittance_min = 1.0: must be < 1"),
        ({"alpha_min": 0.5, "alpha_max": 0.4}, r"RenderConfig\.alpha_min = 0.5: must be < alpha_max = 0.4"),
        ({"near": float("nan")}, r"RenderConfig\.near = nan: must be"),
        ({"sh_degree": 4}, r"RenderConfig\.sh_degree = 4: must be 3 or less"),
        ({"differentiation": "both"}, r"RenderConfig\.differentiation = 'both'"),
    ],
)
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(InputError, match=message):
        RenderConfig(**settings)
