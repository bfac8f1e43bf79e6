"""The Markdown documents of the repository and their code blocks, for the tests of documents."""

import re
from dataclasses import dataclass
from pathlib import Path

from helpers import ROOT

GENERATED = {"models/weights/town/README.md"}  # written by jobs/publish_model.py
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/**/*.md", "models/weights/*/README.md")
    for path in ROOT.glob(pattern)
)
BLOCK = re.compile(
    r"(?:^<!-- (?P<marker>test|needs): (?P<text>.*?) -->\n)?^```(?P<language>\w*)\n(?P<code>.*?)^```", re.M | re.S
)


@dataclass(frozen=True)
class Block:
    """A fenced code block.

    Attributes:
        page: Path of the document in the repository.
        language: Info string of the fence.
        code: Text of the block as readers see it.
        needs: Reason why tests do not run the block, or an empty string. A shell block states the reason in its first
            line ("# Needs: ..."). Other blocks state it in a comment before the fence.
        replacements: Pairs (text, smaller text) that a test applies before it runs the block.
    """

    page: str
    language: str
    code: str
    needs: str
    replacements: tuple[tuple[str, str], ...]

    @property
    def code_to_run(self) -> str:
        """The block after the replacements.

        Raises:
            ValueError: The block does not contain one of the texts to replace.
        """
        code = self.code
        for old, new in self.replacements:
            if old not in code:
                raise ValueError(f"{self.page}: no {old!r} in the block to replace")
            code = code.replace(old, new)
        return code


def read_page(page: str) -> str:
    """Return the text of a document."""
    return Path(ROOT, page).read_text()


def list_blocks(page: str, *languages: str) -> list[Block]:
    """Return the code blocks of a document in order, for the given languages or for all languages."""
    blocks = []
    for match in BLOCK.finditer(read_page(page)):
        needs = match["text"] if match["marker"] == "needs" else ""
        if match["language"] == "sh" and match["code"].startswith("# Needs: "):
            needs = match["code"].split("\n", 1)[0].removeprefix("# Needs: ")
        pairs = re.findall(r"s/(.*?)/(.*?)/(?:\s|$)", match["text"]) if match["marker"] == "test" else []
        blocks.append(Block(page, match["language"], match["code"], needs, tuple(pairs)))
    return [block for block in blocks if not languages or block.language in languages]
