"""Named evaluation protocols: the options that each protocol fixes, and the scenes that it compares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jobs.evaluate_scenes import Config

# Values of options that are not given, without a protocol. The parser leaves these options empty, so a protocol can
# distinguish an option that is given from one that is not.
DEFAULTS: Mapping[str, Any] = {"max_scenes": 1000, "reference": "farthest-point", "k": (3,)}


@dataclass(frozen=True)
class Protocol:
    """The definition of one protocol.

    Attributes:
        summary: One sentence for the report.
        values: Value of each option that the protocol fixes.
        unused: Options that the protocol does not use, with the reason. To give one is an error.
        choices: Allowed values of options that the protocol leaves to the user; the first value is the default.
        num_generated: Number of generated scenes; None means as many as reference scenes.
        is_exact: Whether fewer scenes on a side are an error.
        only_nearest: Whether only distances to the nearest real scene are computed, with VGG16 and without a ceiling.
        is_streamed: Whether only Frechet distances and the Inception score are computed, part by part.
        drops_blank: Whether white pictures and pictures with a black pixel are dropped on both sides.
    """

    summary: str
    values: Mapping[str, Any] = field(default_factory=dict)
    unused: Mapping[str, str] = field(default_factory=dict)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    num_generated: int | None = None
    is_exact: bool = True
    only_nearest: bool = False
    is_streamed: bool = False
    drops_blank: bool = False


# Options that are the same in all protocols (paper, Sec. 4.1 and supplement, Precision and Recall Metrics).
COMMON = {"real_split": "train", "supersample": 1}
ALL_SCENES = "uses all scenes of the training split"
ONLY_MOMENTS = "computes only Frechet distances and the Inception score"
ONLY_NEAREST = "computes only distances to the nearest real scene"
PROTOCOLS: dict[str, Protocol] = {
    "paper-pr": Protocol(
        "precision and recall as in the paper: 1,000 farthest training poses, 1,000 generated scenes, k = 3",
        COMMON | {"max_scenes": 1000, "reference": "farthest-point", "k": (3,)},
        num_generated=1000,
    ),
    "paper-fid": Protocol(
        "FID, sFID and Inception score as in the paper: all scenes of the training split, as many generated scenes",
        COMMON,
        {"max_scenes": ALL_SCENES, "reference": ALL_SCENES} | dict.fromkeys(("k", "peers", "vgg16"), ONLY_MOMENTS),
        is_streamed=True,
    ),
    "paper-nearest": Protocol(
        "distances to the nearest training scene as in the paper's supplement G: 50,000 training scenes, evenly spread,"
        " and 50,000 generated scenes, or all if there are fewer",
        COMMON | {"max_scenes": 50_000, "reference": "uniform"},
        dict.fromkeys(("k", "peers", "inception", "ceiling_split", "controls"), ONLY_NEAREST),
        num_generated=50_000,
        is_exact=False,
        only_nearest=True,
    ),
    "pdd": Protocol(
        "the variant of the PDD fork: at most 50,000 generated scenes, training poses by --reference, without white"
        " pictures and pictures with a black pixel",
        COMMON,
        choices={"reference": ("farthest-point", "min-distance")},
        num_generated=50_000,
        is_exact=False,
        drops_blank=True,
    ),
}


def apply_protocol(config: Config) -> Config:
    """Return the options with the values that the protocol fixes, and with the defaults of the others.

    After this function, `max_scenes` is the maximum number of reference scenes; None means all.

    Args:
        config: Options of jobs/evaluate_scenes.py.

    Returns:
        Options of which `max_scenes`, `reference` and `k` are set.

    Raises:
        ValueError: An option conflicts with the protocol. The message names both.
    """
    if not config.protocol:
        return replace(config, **{name: given for name in DEFAULTS if (given := _get_or_default(config, name))})
    protocol = PROTOCOLS[config.protocol]
    for name, value in protocol.values.items():
        given = getattr(config, name)
        if given not in (None, (), value):
            _reject(config, name, f"which fixes {_spell(name)} {_format(value)}")
    for name, reason in protocol.unused.items():
        if getattr(config, name) not in (None, (), "", False):
            _reject(config, name, f"which {reason}")
    for name, allowed in protocol.choices.items():
        if getattr(config, name) not in (None, *allowed):
            _reject(config, name, f"which allows {' and '.join(allowed)}")
    if config.lvae and not (config.generated or config.run or config.generated_source):
        raise ValueError(f"--protocol {config.protocol} needs generated scenes: give --generated, or omit --protocol")
    if config.real.endswith(".npz"):
        _reject(config, "real", "which selects training scenes and needs a dataset directory")
    if config.ceiling_split == "halves":
        _reject(config, "ceiling_split", "which uses the whole training split as reference")
    if protocol.only_nearest and not config.vgg16:
        raise ValueError(f"--protocol {config.protocol} needs VGG16 weights; add --vgg16 FILE")
    if protocol.is_streamed and config.inception and config.lite0:
        _reject(config, "lite0", "which computes features of EfficientNet-Lite0 only without --inception")
    values = {name: _get_or_default(config, name) for name in DEFAULTS} | dict(protocol.values)
    if "max_scenes" in protocol.unused:
        values |= {"max_scenes": None, "reference": "uniform"}  # All scenes.
    if not protocol.is_exact and values["reference"] == "min-distance":
        if config.max_scenes is not None:
            _reject(config, "max_scenes", "which uses all poses that --reference min-distance selects")
        values["max_scenes"] = None
    return replace(config, **values)


def _get_or_default(config: Config, name: str) -> Any:
    given = getattr(config, name)
    return DEFAULTS[name] if given in (None, ()) else given


def _reject(config: Config, name: str, reason: str) -> None:
    given = _format(getattr(config, name))
    raise ValueError(f"{_spell(name)} {given} conflicts with --protocol {config.protocol}, {reason}")


def _spell(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _format(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
