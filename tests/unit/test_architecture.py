"""Tests of the imports: the order of imports is pritti, jobs, pipelines, models, without cycles."""

import ast
import os
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest
from helpers import ROOT

PACKAGES = ("pritti", "jobs", "pipelines", "models")
FORBIDDEN = {
    "models": {"ray", "pyarrow", "mlflow", "trimesh", "pipelines", "jobs", "tyro"},
    "pipelines": {"mlflow", "jobs", "tyro"},
}
ALLOWED = {  # Imports in functions, for URIs only.
    "models/uris.py": {"pyarrow"},
    "models/local_copy.py": {"pyarrow"},
}


def find_packages(path: Path) -> set[str]:
    """Return the top-level packages that a file imports, including imports in functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def list_modules(root: Path) -> dict[str, Path]:
    """Return the dotted names and files of all modules of PrITTI packages below a directory."""
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    return {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def find_imports(root: Path) -> dict[str, set[str]]:
    """Return the PrITTI modules that each module imports, including imports in functions and under TYPE_CHECKING."""
    modules = list_modules(root)
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        targets = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                members = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= members & modules.keys() or {node.module}
        graph[name] = (targets & modules.keys()) - {name}
    return graph


def group_imports(graph: dict[str, set[str]], package: str) -> dict[str, dict[str, str]]:
    """Return the imports between the direct children of a package, with one example for each pair of children."""
    edges: dict[str, dict[str, str]] = {}
    for module, targets in graph.items():
        for target in targets:
            if module.startswith(f"{package}.") and target.startswith(f"{package}."):
                here, there = (name.removeprefix(f"{package}.").split(".")[0] for name in (module, target))
                if here != there:
                    edges.setdefault(here, {})[there] = f"{module} imports {target}"
    return edges


def find_cycle(graph: dict[str, dict[str, str]]) -> list[str]:
    """Return the imports of one cycle of a graph in order, or an empty list if the graph has no cycle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        nodes = error.args[1][::-1]  # CycleError lists a predecessor before its successor
        return [graph[here][there] for here, there in pairwise(nodes)]
    return []


def find_cycles(root: Path) -> list[str]:
    """Return the import cycles between modules and between the children of a package; each cycle is one line."""
    graph = find_imports(root)
    modules = {name: {target: f"{name} imports {target}" for target in targets} for name, targets in graph.items()}
    found = [find_cycle(modules)]
    packages = {name[:end] for name in graph for end, character in enumerate(name) if character == "."}
    found += [find_cycle(group_imports(graph, package)) for package in sorted(packages)]
    return ["\n".join(lines) for lines in found if lines]


def test_architecture_has_no_import_cycle():
    assert len(find_imports(ROOT)) > 100
    cycles = find_cycles(ROOT)
    assert not cycles, "import cycles:\n" + "\n\n".join(cycles)


def test_architecture_names_edges_of_planted_cycles(tmp_path):
    sources = {
        "pipelines/a/one.py": "from pipelines.b.two import x",
        "pipelines/b/two.py": "x = 1",
        "pipelines/b/three.py": "def f():\n    from pipelines.a import four",
        "pipelines/a/four.py": "",
    }
    for package in PACKAGES:
        (tmp_path / package).mkdir()
    for name, source in sources.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(source)
    (folders,) = find_cycles(tmp_path)  # the folders have a cycle, but the modules have none
    assert "pipelines.a.one imports pipelines.b.two" in folders
    assert "pipelines.b.three imports pipelines.a.four" in folders
    (tmp_path / "pipelines/b/two.py").write_text("import pipelines.a.one")
    assert "pipelines.b.two imports pipelines.a.one" in find_cycles(tmp_path)[0]


def test_pipelines_modules_lie_in_folders():
    assert {path.name for path in (ROOT / "pipelines").glob("*.py")} == {"__init__.py"}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_architecture_imports_point_one_way(package):
    files = list((ROOT / package).rglob("*.py"))
    assert len(files) > 5
    wrong = {str(p.relative_to(ROOT)): find_packages(p) & FORBIDDEN[package] for p in files}
    assert not {name: found for name, found in wrong.items() if found - ALLOWED.get(name, set())}


def test_models_need_no_pyarrow_for_local_files():
    code = (
        "import sys; sys.modules['pyarrow'] = None; from models.pipeline import PrITTIPipeline;"
        " PrITTIPipeline.from_pretrained('town')"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_ingest_imports_no_torch():
    """An import of torch would delay each preprocessing process by one to two seconds."""
    code = "import sys, pipelines.preprocess.ingest; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


@pytest.mark.parametrize("package", ["models", "pipelines"])
def test_packages_stop_spinning_threads_before_torch_loads(package):
    code = f"import os, sys, {package}; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.stdout.split() == ["PASSIVE", "False"], done.stderr


def test_models_import_without_ray_or_pyarrow():
    code = (
        "import sys\n"
        "for name in ('ray', 'pyarrow', 'mlflow', 'trimesh', 'pandas'): sys.modules[name] = None\n"
        "import models.training, models.presets\n"
        "from models import DiT, LayoutVAE, PrITTIPipeline\n"
        "print(PrITTIPipeline.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "PrITTIPipeline", done.stderr


def test_architecture_has_no_pickle_or_unsafe_load():
    """No module reads pickles, because weights and data are stored as safetensors, JSON and Parquet."""
    for path in [p for folder in ("models", "pipelines", "jobs") for p in (ROOT / folder).rglob("*.py")]:
        text = path.read_text()
        assert "import pickle" not in text and "allow_pickle=True" not in text, path
        assert "torch.load(" not in text or "weights_only=True" in text, path
