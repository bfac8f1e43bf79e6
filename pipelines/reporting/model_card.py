"""Write the card of a published model in Markdown: description, training, scores and failures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

from models.tensors import EXISTENCE_THRESHOLD
from pipelines.reporting.chart import Chart
from pipelines.reporting.evaluation_report import VALIDITY, format_value, list_headlines

HIDDEN = ("stage", "dataset", "lvae")  # options of a run that are paths and digests, reported elsewhere

Points = Sequence[Sequence[float]]  # steps and values


@dataclass(frozen=True)
class TrainingRecord:
    """One run of training, as recorded by MLflow or in the training.json of a published model."""

    name: str  # lvae, dit; dit-2 where a second run began with the first one's weights
    stage: str
    weights: str  # digest of what it made
    parameters: int | None  # numbers in the network; None where they are not known
    steps: int
    hours: float  # of training steps, without start-up and validation
    options: Mapping[str, str]
    origin: Mapping[str, str]  # command, commit, machine, versions
    curves: Mapping[str, Points]
    data: Mapping | None = None  # options of the dataset, as its dataset.json has them

    @property
    def picture(self) -> str:
        return f"curves-{self.name}.svg"

    def record(self, data: Mapping) -> dict:
        """Return the content of training.json, without paths of this machine and with the options of the dataset."""
        known = {key: value for key, value in self.options.items() if key not in HIDDEN}
        return asdict(self) | {"options": known, "data": self.data or dict(data)}

    def chart(self) -> Chart:
        series = {name: (steps, values) for name, (steps, values) in self.curves.items()}
        return Chart(f"{self.stage}: losses", series, "training step", "loss", log_y=True)

    def rows(self) -> Iterator[tuple[str, str]]:
        if self.parameters is not None:
            yield "parameters", f"{self.parameters:,}"
        yield "steps done", f"{self.steps:,}"
        yield "hours of steps", f"{self.hours:.1f}"
        yield from self.origin.items()
        yield "options", ", ".join(f"{key} {value}" for key, value in self.options.items() if key not in HIDDEN)


@dataclass(frozen=True)
class ModelCard:
    """Content of a card. `scores` are those of metrics.json, `dataset` is dataset.json, `sampling` holds options."""

    name: str
    version: str
    label: str
    labels: Sequence[str]
    trainings: Sequence[TrainingRecord]
    dataset: Mapping
    sampling: Mapping
    real_split: str  # what generated scenes were scored against
    scores: Mapping
    checksums: Mapping[str, str]

    def markdown(self) -> str:
        return "\n".join([*self._head(), *self._training(), *self._scores(), *self._limits(), *self._files()]) + "\n"

    def _head(self) -> Iterator[str]:
        yield "---\nlicense: apache-2.0\nlibrary_name: diffusers"
        yield "tags: [3d, urban-scenes, primitives, layout, diffusion]\n---\n"
        yield f"# PrITTI on Ray: {self.name}\n"
        yield (
            "Layout VAE and diffusion transformer that generate 3D semantic urban scenes of 64 m x 64 m as "
            f"primitives on a rasterised ground. Version {self.version}, written by `jobs/publish_model.py`.\n"
        )
        yield "```python\nfrom models import PrITTIPipeline\n"
        yield f'pipeline = PrITTIPipeline.from_pretrained("{self.name}")'
        yield (
            f'pipeline.use_sampler("dpm++")\nscenes = pipeline.generate(["{self.labels[0]}"], seed=0, '
            "num_inference_steps=20)\n```\n"
        )
        yield (
            f"![The first scenes, not chosen](samples.png)\n\n*The first scenes of seed {self.sampling['seed']}, not "
            f"chosen; labels in turn: {', '.join(self.sampling['labels'])}. Sampler {self.sampling['sampler']}, "
            f"{self.sampling['num_inference_steps']} steps, guidance {self.sampling['guidance_scale']:g}, the "
            f"network's noise divided by {self.sampling.get('noise_scaling', 1):g}, primitives of an existence above "
            f"{self.sampling.get('existence_threshold', EXISTENCE_THRESHOLD):g}.*\n"
        )
        yield f"Conditioned on: {self.label} ({', '.join(self.labels)}).\n"

    def _training(self) -> Iterator[str]:
        scenes = ", ".join(f"{count:,} {split}" for split, count in sorted(self.dataset["scenes"].items()))
        yield (
            f"## Data\n\n{self.dataset['source']}, {scenes}. Trained on the train split; scored against the "
            f"{self.real_split} split. Options of `jobs/preprocess_scenes.py`:\n"
        )
        yield f"```json\n{json.dumps({k: v for k, v in self.dataset['options'].items() if k != 'input'})}\n```\n"
        for training in self.trainings:
            yield f"## Training: {training.stage}\n\n![Losses by step]({training.picture})\n"
            yield from render_table(("", ""), training.rows())

    def _scores(self) -> Iterator[str]:
        generation = self.scores["generation"]
        sides = generation["scenes"]
        yield (
            f"## Scores\n\n{sides['generated']:,} generated scenes against {sides['real']:,} real ones of split "
            f"{self.real_split}, and the layout VAE's reconstructions of "
            f"{self.scores['reconstruction']['scenes']:,}. In brackets: 95 % intervals over scenes. `metrics.json` "
            "has every figure; docs/evaluation.md says what each is.\n"
        )
        yield from render_table(
            ("score", "value"), ((name, format_value(value)) for name, value in list_headlines(self.scores))
        )

    def _limits(self) -> Iterator[str]:
        validity = self.scores["generation"]["validity"]
        yield (
            "## Failures\n\n![Those of the generated scenes with most faults](failures.png)\n\n*Those with most "
            "faults among the first scenes that were scored.*\n"
        )
        rows = [
            (VALIDITY[k], *(format_value(v[side]) or "–" for side in ("generated", "real")))
            for k, v in validity.items()
        ]
        yield from render_table(("share of", "generated", "real"), rows)
        yield "## Use and limits\n"
        yield (
            "Meant for research on layouts, for trying the tools, and as a start for training on other data. It "
            "knows nothing but the data named above: a procedural town is no survey of any real place, and scenes "
            "must not be taken for one. Nothing here was tested for the safety of vehicles. Repair faults with "
            "`jobs/edit_scenes.py repair`.\n"
        )
        yield "Licence: Apache-2.0, weights and code.\n"

    def _files(self) -> Iterator[str]:
        yield "## SHA-256\n"
        yield from render_table(("file", "SHA-256"), self.checksums.items())


def render_table(head: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Iterator[str]:
    """Yield the lines of a Markdown table and an empty line."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
    yield ""
