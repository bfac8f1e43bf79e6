"""mkdocs hooks that add pages generated from the code.

* `reference/cli/<job>.md`: the `--help` of each job and of its subcommands.
* `reference/api/<package>.md`: the public modules of a package, from their docstrings.
* `tutorials/<name>.md`: each notebook, executed from the start, with its outputs. All notebooks use one Ray cluster.

Set PRITTI_DOCS_EXECUTE=0 to show the notebooks without executing them, for example while you write prose.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
EXECUTE = os.environ.get("PRITTI_DOCS_EXECUTE") != "0"
JOBS = sorted((ROOT / "jobs").glob("[!_]*.py"))
TUTORIALS = sorted((ROOT / "docs/tutorials").glob("*.ipynb"))
API = {  # page: folders of its modules
    "pritti": ("pritti",),
    "models": ("models",),
    "models.composition": ("models/composition",),
    "models.geometry": ("models/geometry", "models/studies"),
    "models.sampling": ("models/sampling",),
    "models.vae": ("models/vae",),
    "pipelines.schema": ("pipelines/schema", "pipelines/runtime"),
    "pipelines.preprocess": ("pipelines/preprocess", "pipelines/preprocess/sources"),
    "pipelines.training": ("pipelines/training",),
    "pipelines.generation": ("pipelines/generation",),
    "pipelines.geometry": ("pipelines/geometry",),
    "pipelines.io": ("pipelines/io",),
    "pipelines.editing": ("pipelines/editing",),
    "pipelines.rendering": ("pipelines/rendering",),
    "pipelines.metrics": ("pipelines/metrics",),
    "pipelines.evaluation": ("pipelines/evaluation",),
}


def read_summary(path: Path) -> str:
    """Return the first paragraph of a module's docstring as one line."""
    docstring = ast.get_docstring(ast.parse(path.read_text())) or ""
    return " ".join(docstring.split("\n\n")[0].split())


def list_modules(packages: tuple[str, ...]) -> list[Path]:
    """Return the files of the public modules of some folders; the facade `pritti` has only `__init__`."""
    if packages == ("pritti",):
        return [ROOT / "pritti/__init__.py"]
    return [path for package in packages for path in sorted((ROOT / package).glob("[!_]*.py"))]


def write_api_page(page: str, packages: tuple[str, ...]) -> str:
    """Return the Markdown of one page of the Python reference."""
    summaries, sections = [], []
    for path in list_modules(packages):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        summaries.append(f"* [`{module}`][{module}]: {read_summary(path)}")
        sections.append(f"::: {module}\n    options: {{heading_level: 2}}\n")
    return "\n".join([f"# {page}\n", *summaries, "", *sections])


def read_help(job: Path, *words: str) -> str:
    """Return the `--help` of a job or of one of its subcommands."""
    environment = os.environ | {"COLUMNS": "86", "NO_COLOR": "1"}
    command = [sys.executable, str(job.relative_to(ROOT)), *words, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=True)
    return done.stdout.rstrip()


def write_cli_page(job: Path) -> str:
    """Return the Markdown of a job's page: its summary, its help and the help of its subcommands."""
    text = read_help(job)
    commands = re.search(r"usage: \S+ \[-h\] \[?\{([\w,-]+)\}", text)
    parts = [f"# {job.stem}\n\n{read_summary(job)}\n\n```text\n{text}\n```"]
    for word in commands[1].split(",") if commands else ():
        parts.append(f"## {job.stem} {word}\n\n```text\n{read_help(job, word)}\n```")
    return "\n\n".join(parts) + "\n"


def execute_notebook(path: Path, environment: dict[str, str]) -> tuple[str, dict[str, bytes]]:
    """Run a notebook from the start and return its Markdown and the pictures of its outputs by file name.

    Output to stderr (progress, warnings) is left out.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell fails. The message holds its code and its traceback.
    """
    import nbformat
    from nbclient import NotebookClient
    from nbconvert import MarkdownExporter

    notebook = nbformat.read(path, as_version=4)
    if EXECUTE:
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            client = NotebookClient(notebook, timeout=180, coalesce_streams=True, resources=resources)
            client.execute(env=os.environ | environment)
    for cell in notebook.cells:
        if cell["cell_type"] == "code":
            cell["outputs"] = [output for output in cell["outputs"] if output.get("name") != "stderr"]
    resources = {"unique_key": path.stem, "output_files_dir": path.stem}
    text, resources = MarkdownExporter().from_notebook_node(notebook, resources=resources)
    text = re.sub(r"<style scoped>.*?</style>\n", "", re.sub(r"\x1b\[[0-9;]*m", "", text), flags=re.DOTALL)
    return re.sub(r"```\w+\n%%bash\n", "```sh\n", text), resources["outputs"]


def execute_tutorials() -> dict[str, str | bytes]:
    """Execute all notebooks and return their pages and pictures by path within the site.

    The notebooks share one Ray cluster, which ends with this process.
    """
    environment = {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    if EXECUTE:
        import ray

        ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        environment["RAY_ADDRESS"] = ray.get_runtime_context().gcs_address
    found: dict[str, str | bytes] = {}
    with ThreadPoolExecutor(2) as pool:
        done = pool.map(execute_notebook, TUTORIALS, [environment] * len(TUTORIALS))
        for path, (text, pictures) in zip(TUTORIALS, done, strict=True):
            found[f"tutorials/{path.stem}.md"] = text
            found |= {f"tutorials/{name}": content for name, content in pictures.items()}
    return found


def write_index(title: str, introduction: str, pages: dict[str, str]) -> str:
    """Return the Markdown of a page that lists other pages with their summaries."""
    entries = [f"* [{name}]({name}.md): {text}" for name, text in pages.items()]
    return "\n".join([f"# {title}\n\n{introduction}\n", *entries])


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace the entries "jobs" and "api" of the navigation by the generated pages."""
    generated = {
        "jobs": ["reference/cli/index.md", *(f"reference/cli/{job.stem}.md" for job in JOBS)],
        "api": ["reference/api/index.md", *(f"reference/api/{page}.md" for page in API)],
    }
    for section in config.nav or []:
        for entries in section.values():
            for entry in entries if isinstance(entries, list) else ():
                for title, value in entry.items() if isinstance(entry, dict) else ():
                    entry[title] = generated.get(value, value) if isinstance(value, str) else value
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    with ThreadPoolExecutor() as pool:
        pages: dict[str, str | bytes] = {
            f"reference/cli/{job.stem}.md": text for job, text in zip(JOBS, pool.map(write_cli_page, JOBS), strict=True)
        }
    pages |= {f"reference/api/{page}.md": write_api_page(page, packages) for page, packages in API.items()}
    pages["reference/cli/index.md"] = write_index(
        "Jobs",
        "Each job is an executable in `jobs/`. `pritti sample-scenes` is the same command as `jobs/sample_scenes.py`.",
        {job.stem: read_summary(job) for job in JOBS},
    )
    pages["reference/api/index.md"] = write_index(
        "Python API",
        "The pages are generated from the docstrings. `models` needs no Ray.",
        {page: ", ".join(f"`{path.stem}`" for path in list_modules(packages)) for page, packages in API.items()},
    )
    # Links in files of the repository root are relative to it.
    for name in ("CONTRIBUTING", "CHANGELOG", "SECURITY"):
        text = (ROOT / f"{name}.md").read_text().replace("](docs/", "](")
        pages[f"{name.lower()}.md"] = text.replace("](CHANGELOG.md", "](changelog.md")
    pages |= execute_tutorials()
    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    return files


def find_line(name: str) -> str:
    """Return file and line of a module, class, function or method, such as models/lvae.py:40.

    Raises:
        ValueError: The package has no such name.
    """
    words = name.split(".")
    count = next((k for k in range(len(words), 0, -1) if (ROOT / "/".join(words[:k])).with_suffix(".py").exists()), 0)
    path = (ROOT / "/".join(words[:count])).with_suffix(".py")
    if not count:
        raise ValueError(f"{name}: no such module")
    body, line = ast.parse(path.read_text()).body, 1
    for word in words[count:]:
        found = next((node for node in body if getattr(node, "name", None) == word), None)
        if not isinstance(found, ast.FunctionDef | ast.ClassDef):
            raise ValueError(f"{name}: {path.relative_to(ROOT)} has no {word}")
        body, line = found.body, found.lineno
    return f"{path.relative_to(ROOT)}:{line}"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Link to the executed page of a notebook, drop the comments that tests read, and add lines of code to paper.md."""
    if page.file.src_uri == "reference/paper.md":
        markdown = re.sub(r"\[`([\w.]+)`\]\[\]", lambda m: f"{m[0]} ({find_line(m[1])})", markdown)
    return re.sub(r"^<!-- (test|needs): .*-->\n", "", markdown.replace(".ipynb)", ".md)"), flags=re.MULTILINE)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Check that all references to the Python API were resolved, because mkdocs leaves unresolved ones in the text.

    Raises:
        ValueError: The page refers to a module, class or function that the reference does not have.
    """
    if unresolved := re.findall(r"\[<code>([\w.]+)</code>\]\[\]", output):
        raise ValueError(f"{page.file.src_uri}: unknown references {', '.join(unresolved)}")
    return output
