"""Write the card of a published model in Markdown: description, training, scores and failures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

from models.scene import DENSITIES
from models.tensors import EXISTENCE_THRESHOLD
from pipelines.metrics.controls import CONTROLS, list_headline_scores
from pipelines.reporting.chart import Chart, format_number
from pipelines.reporting.evaluation_report import (
    NEIGHBOURHOOD,
    VALIDITY,
    build_neighbourhood_table,
    format_value,
    list_headlines,
)

# Options that are paths or digests; other parts of the card contain them.
HIDDEN = ("stage", "dataset", "added_datasets", "added_notices", "lvae")

Points = Sequence[Sequence[float]]  # Training steps and loss values.


@dataclass(frozen=True)
class TrainingRecord:
    """One training run, read from MLflow or from the training.json of a published model.

    Attributes:
        name: lvae or dit. dit-2 is a second run that starts with the weights of the first run.
        stage: Training stage.
        weights: Digest of the resulting weights.
        parameters: Number of weights of the network. None: unknown.
        steps: Number of training steps.
        hours: Duration of all training steps, without start-up and validation (h).
        options: Options of the run.
        origin: Command, commit, machine and versions.
        curves: Training steps and values of each loss, by the name of the loss.
        data: Options of the dataset, from dataset.json.
    """

    name: str
    stage: str
    weights: str
    parameters: int | None
    steps: int
    hours: float
    options: Mapping[str, str]
    origin: Mapping[str, str]
    curves: Mapping[str, Points]
    data: Mapping | None = None

    @property
    def picture(self) -> str:
        return f"curves-{self.name}.svg"

    def record(self, data: Mapping) -> dict:
        """Return the content of training.json: options of the run and of the dataset, without local paths."""
        known = {key: value for key, value in self.options.items() if key not in HIDDEN}
        return asdict(self) | {"options": known, "data": self.data or dict(data)}

    def chart(self) -> Chart:
        series = {name: (steps, values) for name, (steps, values) in self.curves.items()}
        return Chart(f"{self.stage}: losses", series, "training step", "loss", log_y=True)

    def rows(self, data: Mapping) -> Iterator[tuple[str, str]]:
        """Return the rows of the card. `data` holds the options of the dataset of the evaluation."""
        if self.parameters is not None:
            yield "parameters", f"{self.parameters:,}"
        yield "training steps", f"{self.steps:,}"
        scenes = self.data.get("num_train") if self.data else None
        if scenes is not None and scenes != data.get("num_train"):
            yield "training scenes", f"{scenes:,}"
        yield (
            ("training time, h", f"{self.hours:.1f}")
            if self.hours >= 0.1
            else ("training time, s", f"{3600 * self.hours:.0f}")
        )
        yield from self.origin.items()
        yield "options", ", ".join(f"{key} {value}" for key, value in self.options.items() if key not in HIDDEN)


@dataclass(frozen=True)
class ModelCard:
    """Content of a model card.

    Attributes:
        name: Name of the model.
        version: Version of the model.
        label: Kind of label that the model is conditioned on.
        labels: Labels of this kind.
        trainings: Runs of training.
        dataset: Content of dataset.json.
        sampling: Options of sampling.
        real_split: Split of the real scenes that generated scenes are compared with.
        scores: Content of metrics.json.
        checksums: SHA-256 by file name.
    """

    name: str
    version: str
    label: str
    labels: Sequence[str]
    trainings: Sequence[TrainingRecord]
    dataset: Mapping
    sampling: Mapping
    real_split: str
    scores: Mapping
    checksums: Mapping[str, str]

    def markdown(self) -> str:
        return "\n".join([*self._head(), *self._training(), *self._scores(), *self._limits(), *self._files()]) + "\n"

    def _head(self) -> Iterator[str]:
        yield f"---\nlicense: {'other' if self._list_notices() else 'apache-2.0'}\nlibrary_name: diffusers"
        yield "tags: [3d, urban-scenes, primitives, layout, diffusion]\n---\n"
        yield f"# PrITTI on Ray: {self.name}\n"
        yield (
            "This model consists of a layout VAE and a diffusion transformer. It generates 3D semantic urban scenes of "
            "64 m x 64 m, each with primitives and a rasterised ground. "
            f"`jobs/publish_model.py` wrote this card for version {self.version}.\n"
        )
        yield "```python\nfrom pritti import PrITTIPipeline\n"
        yield f'pipeline = PrITTIPipeline.from_pretrained("{self.name}")'
        yield f'scenes = pipeline.generate(["{self.labels[0]}"], seed=0)\n```\n'
        yield (
            f"![First scenes without selection](samples.png)\n\n*First scenes of seed {self.sampling['seed']}, without "
            f"selection. {self._describe_labels()} Sampler {self.sampling['sampler']}, "
            f"{self.sampling['num_inference_steps']} steps, guidance scale {self.sampling['guidance_scale']:g}, "
            f"PAG scale {self.sampling.get('pag_scale', 0):g}"
            f"{' without label' if self.sampling.get('pag_drops_label') else ''}, "
            f"{'with' if self.sampling.get('constraints') else 'without'} constraints, "
            f"noise scaling {self.sampling.get('noise_scaling', 1):g}, existence threshold "
            f"{self.sampling.get('existence_threshold', EXISTENCE_THRESHOLD):g}.*\n"
        )
        kinds = f"{self.label} density"
        if self.label == "partial":
            kinds = (
                "the density of vegetation, then that of vehicles. `any` in place of a density leaves it open, and "
                "`-free` at the end selects crops at any place and heading"
            )
        yield f"Labels ({kinds}): {', '.join(self.labels)}.\n"

    def _describe_labels(self) -> str:
        """Return the sequence of labels of the judged scenes, or how often each label occurs if there are many."""
        labels = self.sampling["labels"]
        if len(labels) <= len(self.labels):
            return f"Labels alternate: {', '.join(labels)}."
        shares = ", ".join(f"{label} ({count})" for label, count in Counter(labels).most_common())
        return f"They have the first of {len(labels)} labels that alternate: {shares}."

    def _training(self) -> Iterator[str]:
        scenes = ", ".join(f"{count:,} {split}" for split, count in sorted(self.dataset["scenes"].items()))
        yield (
            f"## Data\n\nThe dataset is {self.dataset['source']} ({scenes} scenes). The model is trained on the train "
            f"split, unless a run states another number of training scenes, and compared with the {self.real_split} "
            f"split. Options of `jobs/preprocess_scenes.py`:\n"
        )
        yield f"```json\n{json.dumps({k: v for k, v in self.dataset['options'].items() if k != 'input'})}\n```\n"
        for training in self.trainings:
            yield f"## Training: {training.stage}\n\n![Losses by step]({training.picture})\n"
            yield from render_table(("", ""), training.rows(self.dataset["options"]))

    def _scores(self) -> Iterator[str]:
        generation = self.scores["generation"]
        sides = generation["scenes"]
        yield (
            f"## Scores\n\nThe table compares {sides['generated']:,} generated scenes with {sides['real']:,} real "
            f"scenes of split {self.real_split}. The table also contains scores of the layout VAE, "
            f"which reconstructed {self.scores['reconstruction']['scenes']:,} scenes. "
            "Brackets contain 95 % intervals over scenes. The ceiling is the score of the same number of other real "
            "scenes. `metrics.json` contains all scores, and docs/concepts/evaluation.md explains them. Nearest "
            f"distances are to the scenes of split {self.real_split}; copies are generated scenes at distance 0. The "
            "distances test memorisation only if this split is the training split.\n"
        )
        ceiling = generation.get("sets", {}).get("ceiling", {})
        left_out = (".memory_bytes.", ".validity.", ".label_", *(f"{name}_k" for name in NEIGHBOURHOOD))
        rows = [
            (name, format_value(value), format_value(ceiling.get(name.removeprefix("generation."))) or "–")
            for name, value in list_headlines(self.scores)
            if not any(part in name for part in left_out)
        ]
        yield from render_table(("score", "value", "other real scenes (ceiling)"), rows)
        neighbourhoods = build_neighbourhood_table(generation)
        yield from render_table(neighbourhoods.columns, [tuple(map(str, row)) for row in neighbourhoods.rows])
        reconstruction = self.scores["reconstruction"]
        ceiling, threshold = reconstruction["label_fidelity"], reconstruction["label_existence_threshold"]
        rows = [
            (name.replace("_", " "), format_value(value), format_value(ceiling[name]))
            for name, value in generation["label_fidelity"].items()
            if value is not None
        ]
        yield from render_table(
            ("density label as requested", "generated", f"reconstructions, existence > {threshold:g} (for comparison)"),
            rows,
        )
        yield from self._controls()

    def _controls(self) -> Iterator[str]:
        """Yield the headline scores of other real scenes, of generated scenes and of damaged scenes."""
        generation = self.scores["generation"]
        if "sensitive" not in generation:
            return
        sets, sensitive = generation["sets"], generation["sensitive"]
        names = list_headline_scores(sets["ceiling"])
        yield (
            "The next table shows whether the scores notice damage. A star marks damaged real scenes that score worse "
            "than other real scenes, with disjoint 95 % intervals.\n"
        )
        rows = []
        for label, values in (("generated", generation), *sets.items()):
            cells = [f"{format_number(values[n]['value'])}{' *' if label in sensitive[n] else ''}" for n in names]
            rows.append((CONTROLS.get(label, {"ceiling": "other real scenes"}.get(label, label)), *cells))
        yield from render_table(("scenes", *(name.replace("_", " ") for name in names)), rows)

    def _limits(self) -> Iterator[str]:
        validity = self.scores["generation"]["validity"]
        yield (
            "## Failures\n\n![Generated scenes with the most faults](failures.png)\n\n*Scenes with the most faults "
            "among the first generated scenes.*\n"
        )
        rows = [
            (VALIDITY[k], *(format_value(v[side]) or "–" for side in ("generated", "real")))
            for k, v in validity.items()
        ]
        yield from render_table(("share of", "generated", "real"), rows)
        yield "## Use and limits\n"
        yield from self._describe_deviations()
        yield (
            "The model is intended for research on layouts, for tests of the tools, and as initial weights for "
            f"training on other data. {self._describe_data()} If the dataset above is a procedural "
            "town, the generated scenes do not represent real places. The model is not tested for vehicle safety. "
            "`jobs/edit_scenes.py repair` repairs faults.\n"
        )
        if not (notices := self._list_notices()):
            yield "The licence of weights and code is Apache-2.0.\n"
            return
        yield (
            "The licence of the code is Apache-2.0. The licences of the training data can limit the use of weights: "
            f"{'; '.join(notices)}.\n"
        )

    def _list_added_sources(self) -> list[str]:
        """Return the sources of the datasets that were mixed with the dataset of the evaluation."""
        given = [training.options.get("added_sources", "") for training in self.trainings]
        return list(dict.fromkeys(source for text in given for source in text.split(", ") if source))

    def _list_notices(self) -> list[str]:
        """Return the licence notices of all training data."""
        added = [training.options.get("added_notices", "") for training in self.trainings]
        notices = [self.dataset.get("attribution"), *(notice for text in added for notice in text.split("; "))]
        return list(dict.fromkeys(notice for notice in notices if notice))

    def _describe_data(self) -> str:
        if added := self._list_added_sources():
            return f"The model is trained on the dataset above, mixed with scenes of the sources {', '.join(added)}."
        return "The model is trained only on the dataset above."

    def _describe_deviations(self) -> Iterator[str]:
        """Yield the categories whose counts differ from the data's by more than 15 %, and the worst label."""
        means = {
            name.removeprefix("num_"): (value["generated"]["value"], value["real"]["value"])
            for name, value in self.scores["generation"]["statistics"].items()
            if name.startswith("num_")
        }
        ratios = {name: made / real for name, (made, real) in means.items() if real and abs(made / real - 1) > 0.15}
        if ratios:
            listed = ", ".join(f"{name} {ratio:.2f}" for name, ratio in sorted(ratios.items(), key=lambda one: one[1]))
            yield f"Objects per generated scene, divided by those per real scene, where not within 15 %: {listed}.\n"
        known = self.scores["generation"].get("label_fidelity") or {}
        shares = {name: value["value"] for name, value in known.items() if value and name.endswith(DENSITIES)}
        if shares and min(shares.values()) < 0.9:
            name = min(shares, key=shares.__getitem__)
            yield (
                f"Only {shares[name]:.2f} of the scenes with the label {name.rsplit('_', 1)[1]} "
                f"({name.split('_')[0]}) have the requested density. A guidance scale above 1 raises this share, and "
                "moves scenes away from the data.\n"
            )

    def _files(self) -> Iterator[str]:
        yield "## SHA-256\n"
        yield from render_table(("file", "SHA-256"), self.checksums.items())


def render_table(head: Sequence[str], rows: Iterable[Sequence[str | None]]) -> Iterator[str]:
    """Yield the lines of a Markdown table, followed by an empty line."""
    yield "| " + " | ".join(head) + " |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |"
    yield ""
