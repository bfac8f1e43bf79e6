"""Tests of the command line: options, renamed options, `pritti`, the facade and imports."""

import ast
import importlib
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
import tyro

from jobs.support.cli import expand_flags
from jobs.support.renames import JOB_OPTIONS, OPTIONS, VALUES, find_renamed

ROOT = Path(__file__).parents[2]
JOBS = sorted(path.stem for path in (ROOT / "jobs").glob("*.py") if path.stem != "__init__")


def run_python(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=60)


def list_option_types(job: str) -> dict[str, object]:
    """Return the type of each option of a job, including the options of its subcommands."""
    module = importlib.import_module(f"jobs.{job}")
    classes = [value for value in vars(module).values() if is_dataclass(value) and isinstance(value, type)]
    return {
        field.name.replace("_", "-"): get_type_hints(cls)[field.name]
        for cls in classes
        if cls.__module__ == module.__name__
        for field in fields(cls)
    }


@pytest.mark.parametrize("job", JOBS)
def test_renames_name_existing_options(job):
    options = set(list_option_types(job))
    assert not options & (set(OPTIONS) - set(JOB_OPTIONS.get(job, {})))
    for old, new in JOB_OPTIONS.get(job, {}).items():
        assert new.removeprefix("no-") in options
        shared = {"edit_scenes": {"label"}, "preprocess_scenes": set()}.get(job, set())
        assert old not in options - shared


@pytest.mark.parametrize(("job", "option"), VALUES, ids=lambda word: word)
def test_renames_name_existing_values(job, option):
    choices = list_option_types(job)[option]
    literals = [choices] if get_origin(choices) is Literal else get_args(choices)
    values = {value for literal in literals for value in get_args(literal)}
    assert set(VALUES[job, option].values()) <= values and not set(VALUES[job, option]) & values


@pytest.mark.parametrize(
    ("job", "words", "message"),
    [
        ("sample_scenes", ["--guidance", "4"], "--guidance was renamed to --guidance-scale"),
        ("sample_scenes", ["--num-scenes", "2", "--steps=20"], "--steps was renamed to --num-inference-steps"),
        ("evaluate_scenes", ["--limit", "20"], "--limit was renamed to --max-reconstructed-scenes"),
        ("evaluate_scenes", ["--no-balance"], "--no-balance was renamed to --no-balance-labels"),
        ("evaluate_scenes", ["--reference", "apart"], "--reference apart was renamed to --reference min-distance"),
        ("train_dit", ["demo", "--prediction=velocity"], "--prediction was renamed to --prediction-type"),
        (
            "train_dit",
            ["--prediction_type", "noise"],
            "--prediction-type noise was renamed to --prediction-type epsilon",
        ),
        ("train_dit", ["demo", "--steps", "20"], None),
        ("export_scenes", ["--limit", "20"], "--limit was renamed to --max-scenes"),
    ],
)
def test_find_renamed_names_present_option_or_value(job, words, message):
    assert find_renamed(job, words) == message


def test_job_exits_with_code_2_for_renamed_option():
    done = run_python("jobs/sample_scenes.py", "--guidance", "4")
    assert (done.returncode, done.stderr) == (2, "error: --guidance was renamed to --guidance-scale\n")


def test_option_modules_import_nothing_heavy():
    """The modules with options import no heavy packages, because `--help` must import these modules quickly."""
    names = ", ".join(f"jobs.{job}" for job in JOBS)
    done = run_python("-c", f"import sys, {names}, pritti.cli; print(*sorted(sys.modules))")
    heavy = {"torch", "ray", "numpy", "pyarrow", "mlflow", "diffusers", "trimesh", "models", "pipelines"}
    assert done.returncode == 0 and not heavy & set(done.stdout.split()), done.stderr


SHARED = (
    "AddDatasetsOption",
    "ConstraintsOption",
    "DatasetWeightsOption",
    "ModelOption",
    "PagScaleOption",
    "IfBusyOption",
    "GpusOption",
    "WaitForResourcesOption",
    "LogFormatOption",
)  # Their help is in jobs/support/options.py.


@pytest.mark.parametrize("job", JOBS)
def test_options_have_help_lines(job):
    tree = ast.parse((ROOT / "jobs" / f"{job}.py").read_text())
    for cls in [node for node in tree.body if isinstance(node, ast.ClassDef)]:
        for field, following in zip(cls.body, [*cls.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and ast.unparse(field.annotation) not in SHARED:
                documented = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                assert documented, f"{cls.name}.{field.target.id}"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), None),
        (("--constraints",), True),
        (("--no-constraints", "--seed", "3"), False),
        (("--constraints", "True"), True),
        (("--constraints", "False"), False),
        (("--constraints", "None"), None),
    ],
)
def test_flags_without_value_select_true_or_false(words, expected):
    for name in ("sample_scenes", "inpaint_scenes", "outpaint_scenes", "sweep_samplers", "sweep_seams", "serve_studio"):
        config = importlib.import_module(f"jobs.{name}").Config
        given = [word for word in words if name != "serve_studio" or word not in ("--seed", "3")]
        assert tyro.cli(config, args=expand_flags(config, given)).constraints is expected


def test_pritti_lists_all_jobs_with_one_line_each():
    done = run_python("-m", "pritti.cli", "--help")
    lines = [line.split(maxsplit=1) for line in done.stdout.partition("jobs:\n")[2].splitlines()]
    assert done.returncode == 0 and [name.replace("-", "_") for name, _ in lines] == JOBS
    assert all(10 < len(summary) <= 90 and summary.endswith(".") for _, summary in lines)


def test_pritti_runs_job_as_its_file_does():
    script, file = (
        run_python("-m", "pritti.cli", "sample-scenes", "--help"),
        run_python("jobs/sample_scenes.py", "--help"),
    )
    assert script.stdout.replace("pritti sample-scenes", "jobs/sample_scenes.py", 1) == file.stdout
    done = run_python("-m", "pritti.cli", "sample-scenes", "--num-scenes", "0")
    assert done.returncode == 2 and done.stderr == "error: --num-scenes is 0, expected at least 1\n"


def test_pritti_suggests_jobs_with_similar_names():
    done = run_python("-m", "pritti.cli", "sampel-scenes")
    assert done.returncode == 2 and "error: unknown job 'sampel-scenes'; did you mean sample-scenes" in done.stderr


def test_pritti_facade_is_lazy():
    code = "import sys, pritti; assert 'torch' not in sys.modules; from pritti import *; print(PrITTIPipeline, Scene)"
    assert "models.pipeline.PrITTIPipeline" in run_python("-c", code).stdout
    import pritti

    assert set(pritti.__all__) <= set(dir(pritti)) and pritti.__version__
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = pritti.Nothing


def find_imported_names(path: Path) -> set[str]:
    """Return the dotted names that a file imports, including imports in functions.

    The statement `from a import b` adds the name `a.b`.
    """
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def test_jobs_import_one_way():
    """Executables import only jobs.support. The modules of jobs.support import no executables and no
    implementations."""
    support = tuple(f"jobs.support.{path.stem}" for path in (ROOT / "jobs/support").glob("*.py")) + ("jobs.support.",)
    for folder in ("jobs", "jobs/support"):
        for path in (ROOT / folder).glob("*.py"):
            ours = {name for name in find_imported_names(path) if name.split(".")[0] == "jobs"}
            assert all(name.startswith(support) for name in ours), path
            assert folder != "jobs" or not {
                n for n in find_imported_names(path) if n.startswith(("models", "pipelines"))
            }
