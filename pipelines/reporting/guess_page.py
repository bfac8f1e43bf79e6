"""Render a page with real and generated scenes in random order, on which a reader guesses which scenes are generated.

The page reveals the source of a scene after the guess. It shows the number of right guesses next to the number that
random guesses give.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Sequence
from html import escape

import numpy as np
from PIL import Image

from models.scene import Scene
from pipelines.rendering.render import render_3d
from pipelines.reporting.report_style import STYLE

WIDTH_PX, HEIGHT_PX, JPEG_QUALITY = 360, 270, 85


def render_guess_html(
    real: Sequence[Scene],
    generated: Sequence[Scene],
    title: str,
    seed: int = 0,
    on_scene: Callable[[], None] = lambda: None,
) -> str:
    """Render the page. It is one file of about 20 kB per scene and needs no download.

    Args:
        real: Real scenes.
        generated: Generated scenes.
        title: Heading.
        seed: Seed of the order.
        on_scene: Called after each scene.

    Returns:
        The page as HTML.

    Raises:
        ValueError: A side has no scene.
    """
    if not real or not generated:
        raise ValueError(f"guessing needs scenes of both sides, got {len(real)} real and {len(generated)} generated")
    scenes = [*((scene, 0) for scene in real), *((scene, 1) for scene in generated)]
    figures, answers = [], ""
    for number, k in enumerate(np.random.default_rng(seed).permutation(len(scenes)), 1):
        scene, is_generated = scenes[k]
        answers += str(is_generated)
        figures.append(
            f'<figure><img src="{_encode_jpeg(render_3d(scene, WIDTH_PX, HEIGHT_PX))}" alt="scene {number}" '
            f'width="{WIDTH_PX}" height="{HEIGHT_PX}"><figcaption><b>{number}</b> '
            '<button type="button" data-guess="0">real</button> '
            '<button type="button" data-guess="1">generated</button> <span></span></figcaption></figure>'
        )
        on_scene()
    hidden = base64.b64encode(answers.encode()).decode()  # Encoded, so that nobody reads the answers by accident.
    words = f"{len(real)} real and {len(generated)} generated scenes in random order. Which ones are generated?"
    return _PAGE.format(
        style=STYLE, title=escape(title), words=words, figures="".join(figures), answers=json.dumps(hidden)
    )


def _encode_jpeg(image: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{style}
.guess button {{ padding: 2px 10px; border: 1px solid var(--line); border-radius: 999px; background: none;
  color: inherit; font: inherit; cursor: pointer; }}
.guess button[aria-pressed="true"] {{ border-color: var(--accent); color: var(--accent); font-weight: 600; }}
.guess .right span {{ color: var(--yes); }} .guess .wrong span {{ color: var(--no); }}
#result {{ position: sticky; top: 0; padding: 12px 0; background: var(--page); z-index: 1; }}
</style></head><body><header><h1>{title}</h1><p>{words}</p></header>
<main><p id="result" role="status"></p><section><div class="pictures guess">{figures}</div></section></main>
<script>
const answers = atob({answers}), figures = [...document.querySelectorAll(".guess figure")];
const guesses = new Map(), result = document.getElementById("result");
function show() {{
  const known = guesses.size, right = [...guesses].filter(([k, g]) => answers[k] === g).length;
  const spread = 1.96 * Math.sqrt(known) / 2;
  result.textContent = known
    ? `${{right}} of ${{known}} right. Without looking: ${{(known / 2).toFixed(1)}} ± ${{spread.toFixed(1)}} (95 %).`
    : "Choose an answer below a scene. The first answer counts.";
}}
figures.forEach((figure, k) => figure.addEventListener("click", (event) => {{
  const guess = event.target.dataset.guess;
  if (guess === undefined || guesses.has(k)) return;
  guesses.set(k, guess);
  event.target.setAttribute("aria-pressed", "true");
  figure.classList.add(answers[k] === guess ? "right" : "wrong");
  figure.querySelector("span").textContent =
    (answers[k] === guess ? "right: " : "wrong: ") + (answers[k] === "1" ? "generated" : "real");
  show();
}}));
show();
</script></body></html>
"""
