"""Files of a voxel method: baseline.json and one directory per stage."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from models.base import ConfiguredModel, read_config, write_config
from models.baselines.base import Networks, Stage, VoxelPipeline
from models.local_copy import make_local_copy
from models.options import Choice, Rule, Text, check_entries
from models.uris import join_uri

INDEX_NAME = "baseline.json"
METHODS = ("semcity", "pdd", "xcube")
RULES: dict[str, Rule] = {"method": Choice(METHODS), "preset": Text()}


def find_stages(method: str, preset: str) -> tuple[Stage, ...]:
    """Return the stages of a preset.

    Args:
        method: Name of a method.
        preset: Name of one of its presets.

    Returns:
        Stages in the order of their training.

    Raises:
        ValueError: The method or the preset is unknown.
    """
    presets = _import_method(method).PRESETS
    if preset not in presets:
        raise ValueError(f"{method} has no preset {preset!r}, expected one of: {', '.join(presets)}")
    return presets[preset]


def find_stage(method: str, preset: str, name: str) -> Stage:
    """Return a stage of a preset.

    Args:
        method: Name of a method.
        preset: Name of one of its presets.
        name: Name of a stage.

    Returns:
        The stage.

    Raises:
        ValueError: The method, the preset or the stage is unknown.
    """
    stages = {stage.name: stage for stage in find_stages(method, preset)}
    if name not in stages:
        raise ValueError(f"{method} has no stage {name!r}, expected one of: {', '.join(stages)}")
    return stages[name]


def _import_method(method: str) -> Any:
    if method not in METHODS:
        raise ValueError(f"method is {method!r}, expected one of: {', '.join(METHODS)}")
    return import_module(f"models.baselines.{method}")


def write_index(directory: str | os.PathLike, method: str, preset: str) -> None:
    """Write baseline.json.

    Args:
        directory: Existing directory of the networks.
        method: Name of the method.
        preset: Name of the preset.
    """
    write_config("VoxelPipeline", {"method": method, "preset": preset}, Path(directory) / INDEX_NAME)


def read_index(directory: str | os.PathLike) -> tuple[str, str]:
    """Read baseline.json.

    Args:
        directory: Directory or URI of the networks.

    Returns:
        Names of the method and of the preset.

    Raises:
        ValueError: The file is missing or damaged, or belongs to no known method.
    """
    path = Path(make_local_copy(directory, INDEX_NAME.__eq__)) / INDEX_NAME
    try:
        index = read_config(path, "VoxelPipeline")
        check_entries(index, RULES, required=tuple(RULES))
    except ValueError as error:
        raise ValueError(
            f"{os.fspath(directory)}: no voxel method here ({error}); pass a directory of jobs/train_baseline.py"
        ) from error
    return index["method"], index["preset"]


def load_networks(directory: str | os.PathLike, method: str, stages: Sequence[Stage]) -> Networks:
    """Load the networks of stages.

    Args:
        directory: Directory or URI of the networks.
        method: Name of the method, for messages.
        stages: Stages to load.

    Returns:
        Networks by the name of their stage, in evaluation mode.

    Raises:
        ValueError: A network is missing, is damaged or belongs to another method.
    """
    networks: dict[str, ConfiguredModel] = {}
    for stage in stages:
        try:
            networks[stage.name] = stage.model.from_pretrained(join_uri(os.fspath(directory), stage.name))
        except (ValueError, OSError) as error:
            raise ValueError(
                f"{os.fspath(directory)}: no trained stage {stage.name} of {method} ({error}); run"
                f" jobs/train_baseline.py {method} --stage {stage.name} first"
            ) from error
    return networks


def load_baseline(directory: str | os.PathLike) -> VoxelPipeline:
    """Load all networks of a method.

    Args:
        directory: Directory or URI written by jobs/train_baseline.py.

    Returns:
        The pipeline on the CPU.

    Raises:
        ValueError: A file is missing or damaged, or a network belongs to another method.
    """
    method, preset = read_index(directory)
    networks = load_networks(directory, method, find_stages(method, preset))
    try:
        return cast(type[VoxelPipeline], _import_method(method).Pipeline)(networks)
    except ValueError as error:
        raise ValueError(f"{os.fspath(directory)}: {error}") from error
