"""Imports point one way: jobs -> pipelines -> models. models runs without Ray."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import ROOT

FORBIDDEN = {
    "models": {"ray", "pyarrow", "mlflow", "trimesh", "pipelines", "jobs", "tyro"},
    "pipelines": {"mlflow", "jobs", "tyro"},
}


def imported(path: Path) -> set[str]:
    """Top-level packages that a file imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("package", FORBIDDEN)
def test_architecture_imports_point_one_way(package):
    files = list((ROOT / package).rglob("*.py"))
    assert len(files) > 5
    wrong = {str(p.relative_to(ROOT)): imported(p) & FORBIDDEN[package] for p in files}
    assert not {name: found for name, found in wrong.items() if found}


def test_ingest_imports_no_torch():
    """Importing torch would cost every preprocessing process one to two seconds."""
    code = "import sys, pipelines.preprocess.ingest; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


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
    """Nothing unpickles: safetensors, JSON and Parquet only."""
    for path in [p for folder in ("models", "pipelines", "jobs") for p in (ROOT / folder).rglob("*.py")]:
        text = path.read_text()
        assert "import pickle" not in text and "allow_pickle=True" not in text, path
        assert "torch.load(" not in text or "weights_only=True" in text, path
