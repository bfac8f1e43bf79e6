"""Public functions of the Python API have docstrings with Args, Returns and Raises."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import ROOT

DOCUMENTED = (  # files and folders of the public API; only the jobs use pipelines.evaluation, reporting and studio
    "models",
    "pipelines/editing",
    "pipelines/generation",
    "pipelines/geometry",
    "pipelines/io",
    "pipelines/metrics",
    "pipelines/preprocess/sources/argoverse2.py",
    "pipelines/preprocess/sources/custom.py",
    "pipelines/preprocess/sources/drive.py",
    "pipelines/preprocess/sources/kitti360.py",
    "pipelines/rendering",
    "pipelines/schema",
)
MODULES = sorted(
    str(path.relative_to(ROOT))
    for name in DOCUMENTED
    for path in ((ROOT / name).rglob("[!_]*.py") if (ROOT / name).is_dir() else [ROOT / name])
)


def list_public_functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """List the public functions and methods of a module with their names."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for part in node.body:
                if isinstance(part, ast.FunctionDef) and not part.name.startswith("_"):
                    yield f"{node.name}.{part.name}", part


def list_entries(docstring: str, heading: str) -> list[str]:
    """List the names that a section of a Google-style docstring describes."""
    section = re.search(rf"^{heading}:\n((?:[ ]+.*\n|\n)+)", docstring + "\n", re.M)
    names = re.findall(r"^    (\*{0,2}\w+(?:, \*{0,2}\w+)*):", section[1], re.M) if section else []
    return [name.strip("* ") for entry in names for name in entry.split(",")]


def list_raised(function: ast.FunctionDef) -> set[str]:
    """List the names of the exceptions that the function itself raises."""
    raised, nodes = set(), list(function.body)
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            raised.add(node.exc.func.id)
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Lambda)):
            nodes += ast.iter_child_nodes(node)
    return {name for name in raised if name[0].isupper()}


def find_gaps(function: ast.FunctionDef) -> list[str]:
    """List the entries that the docstring of a function lacks, and the entries that it must not have."""
    docstring = ast.get_docstring(function)
    if not docstring:
        return ["no docstring"]
    decorators = " ".join(map(ast.unparse, function.decorator_list))
    signature = function.args
    parameters = [a.arg for a in (*signature.posonlyargs, *signature.args, *signature.kwonlyargs)]
    parameters += [a.arg for a in (signature.vararg, signature.kwarg) if a]
    parameters = [name for name in parameters if name not in ("self", "cls")]
    described = list_entries(docstring, "Args") if parameters else []
    gaps = [f"Args lacks {name}" for name in parameters if name not in described]
    gaps += [f"Args names {name}, which is no parameter" for name in described if name not in parameters]
    returns = function.returns is not None and ast.unparse(function.returns) not in ("None", "NoReturn")
    if returns and parameters and not re.search(r"property|contextmanager", decorators):
        gaps += [] if re.search(r"^(Returns|Yields):$", docstring, re.M) else ["no Returns"]
    gaps += [f"Raises lacks {name}" for name in list_raised(function) - set(list_entries(docstring, "Raises"))]
    return gaps


@pytest.mark.parametrize("module", MODULES)
def test_public_functions_are_documented(module):
    tree = ast.parse(Path(ROOT, module).read_text())
    assert ast.get_docstring(tree), f"{module} has no docstring"
    gaps = {name: gap for name, function in list_public_functions(tree) if (gap := find_gaps(function))}
    assert not gaps


def test_find_gaps_names_each_kind():
    code = '''
def f(a, b) -> int:
    """Return a.

    Args:
        a: Number.
        c: Nothing.
    """
    if b:
        raise ValueError("b")
    return a
'''
    (function,) = ast.parse(code).body
    assert isinstance(function, ast.FunctionDef)
    expected = ["Args lacks b", "Args names c, which is no parameter", "no Returns", "Raises lacks ValueError"]
    assert find_gaps(function) == expected
