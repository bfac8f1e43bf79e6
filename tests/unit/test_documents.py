"""Tests that README and docs follow the rules of CONTRIBUTING: length, plain expressions, valid paths and links."""

import re
import sys
from pathlib import Path

import pytest
from documents import GENERATED, PAGES, list_blocks, read_page
from helpers import ROOT

WRITTEN = [page for page in PAGES if page not in GENERATED]
MAX_README_WORDS, MAX_COLUMNS, MAX_TABLE_COLUMNS = 1300, 120, 8
# Expressions that readers found unclear, and plain replacements.
UNCLEAR = {
    r"\banew\b": "again",
    r"\bgoes? on\b": "continues",
    r"\bat once\b": "concurrently, immediately",
    r"\bby hand\b": "in a one-off script",
    r"\bbeside\b": "next to, during",
    r"\bsurest|surer\b": "with the highest probability",
    r"\bwhatever\b": "any",
    r"\bso many\b": "N",
    r"\bof its own\b|\bof their own\b": "separate",
    r"\bdrawn to\b": "guided towards",
    r"\bcomes? out\b": "is returned",
    r"\bwhat (?:was|is) (?:made|drawn|known|given)\b": "the noun",
}


def strip_code(text: str) -> str:
    """The text without code blocks, code spans and comments."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return re.sub(r"<!--.*?-->|`[^`\n]*`", "", text, flags=re.S)


def test_readme_is_short():
    words = read_page("README.md").split()
    assert 500 < len(words) <= MAX_README_WORDS


@pytest.mark.parametrize("page", WRITTEN)
def test_document_lines_fit(page):
    """A row of a table cannot be wrapped, so the test limits the number of columns."""
    lines = read_page(page).splitlines()
    rows = [line for line in lines if line.startswith("|")]
    wide = [line for line in lines if len(line) > MAX_COLUMNS and line not in rows]
    assert not wide
    for row in rows:
        cells = re.split(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", row).strip().strip("|"))
        assert len(cells) <= MAX_TABLE_COLUMNS, row


@pytest.mark.parametrize("page", WRITTEN)
def test_document_has_no_unclear_expression(page):
    text = " ".join(strip_code(read_page(page)).split())
    found = {
        match[0]: plain for pattern, plain in UNCLEAR.items() for match in re.finditer(pattern, text, re.IGNORECASE)
    }
    assert not found


@pytest.mark.parametrize("page", PAGES)
def test_document_paths_exist(page):
    """Each repository path in a code span exists, except for patterns such as NAME or <name>."""
    pattern = r"`((?:pritti|models|pipelines|jobs|tests|docs|benchmarks|infra)/[\w/.*-]*)`"
    named = {match for match in re.findall(pattern, read_page(page)) if "NAME" not in match}
    missing = [path for path in named if not list(ROOT.glob(path.rstrip("/")))]
    assert not missing


@pytest.mark.parametrize("page", PAGES)
def test_document_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", strip_code(read_page(page))):
        if re.match(r"https?:", target) or "reference/api/" in target or "reference/cli/" in target:
            continue  # `make docs` generates these pages and checks links to them
        path, _, anchor = target.partition("#")
        file = Path(ROOT, page).parent / path if path else Path(ROOT, page)
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", file.read_text(), re.M)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, target


def test_every_page_is_in_the_navigation():
    """An index page lists the experiments. The site does not contain model cards and files of the repository root."""
    navigation, index = Path(ROOT, "mkdocs.yml").read_text(), read_page("docs/experiments/index.md")
    for page in PAGES:
        name = page.removeprefix("docs/")
        if name.startswith("experiments/") and name != "experiments/index.md":
            assert f"({name.removeprefix('experiments/')})" in index, page
        elif page.startswith("docs/"):
            assert name in navigation, page


def test_transcript_of_the_cluster_shows_every_job():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    from submit_jobs import JOBS

    jobs = {path.stem for path in (ROOT / "jobs").glob("[!_]*.py")}
    assert len(jobs) > 20 and {line.split()[0] for line in JOBS.strip().splitlines()} == jobs
    page = (ROOT / "docs/how_to/cluster.md").read_text()
    assert set(re.findall(r"ray job submit .*-- jobs/(\w+)\.py", page)) == jobs


def test_experiments_are_dated():
    for page in PAGES:
        if page.startswith("docs/experiments/") and not page.endswith("index.md"):
            assert re.search(r"^\*\*20\d\d-\d\d-\d\d", read_page(page), re.M), page


def test_list_blocks_reads_markers(tmp_path, monkeypatch):
    text = (
        "```sh\n# Needs: a GPU\nnvidia-smi\n```\n\n<!-- test: s/--steps 9/--steps 1/ -->\n```sh\ntrain --steps 9\n```\n"
    )
    text += "\n<!-- needs: DIR -->\n```python\nopen('DIR')\n```\n"
    monkeypatch.setattr("documents.ROOT", tmp_path)
    (tmp_path / "page.md").write_text(text)
    first, second, third = list_blocks("page.md")
    assert first.needs == "a GPU" and third.needs == "DIR" and not second.needs
    assert second.code_to_run == "train --steps 1\n"
    (tmp_path / "page.md").write_text(text.replace("train --steps 9", "train"))
    with pytest.raises(ValueError, match="no '--steps 9' in the block"):
        list_blocks("page.md")[1].code_to_run  # noqa: B018
