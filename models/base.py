"""Configured models in diffusers' file format, without importing diffusers (two to three seconds per process).

`ConfiguredModel` has the part of diffusers' `ModelMixin` and `ConfigMixin` that this project uses: a directory holds
config.json and diffusion_pytorch_model.safetensors, and diffusers' names of methods and files are kept.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

CONFIG_NAME = "config.json"
WEIGHTS_NAME = "diffusion_pytorch_model.safetensors"

Model = TypeVar("Model", bound="ConfiguredModel")


class Config(dict):
    """Constructor arguments, readable as attributes; `register_to_config` replaces the whole."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"config has no entry {name!r}, only: {', '.join(self)}") from None


def register_to_config(init: Callable[..., None]) -> Callable[..., None]:
    """Decorator of `__init__`: keep its arguments, defaults included, as `self.config`; dataclasses become dicts."""
    signature = inspect.signature(init)

    @wraps(init)
    def configured(self: ConfiguredModel, *args: Any, **kwargs: Any) -> None:
        bound = signature.bind(self, *args, **kwargs)
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        init(self, *args, **kwargs)
        self.config = Config({name: _plain(value) for name, value in arguments.items()})

    return configured


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def write_config(kind: str, config: Mapping[str, Any], path: Path) -> None:
    """Write a config as diffusers does: sorted JSON with the class and diffusers' version."""
    content = {"_class_name": kind, "_diffusers_version": version("diffusers")} | dict(config)
    path.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def read_config(path: Path) -> dict[str, Any]:
    """Read a config without the entries that diffusers adds.

    Raises:
        ValueError: The file is missing or is not a JSON object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, got a {type(content).__name__}")
    return {name: value for name, value in content.items() if not name.startswith("_")}


class ConfiguredModel(nn.Module):
    """A network that is stored with the arguments of its constructor, which `register_to_config` decorates."""

    config: Config

    @classmethod
    def upgrade_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Constructor arguments from the entries of a config that an earlier version wrote."""
        return config

    @classmethod
    def from_config(cls: type[Model], config: Mapping[str, Any]) -> Model:
        """A model with new weights.

        Raises:
            ValueError: An entry is unknown or does not fit.
        """
        arguments = cls.upgrade_config({name: value for name, value in config.items() if not name.startswith("_")})
        known = inspect.signature(cls.__init__).parameters
        if unknown := sorted(set(arguments) - set(known)):
            raise ValueError(f"{cls.__name__} has no option {', '.join(unknown)}; expected some of: {', '.join(known)}")
        return cls(**arguments)

    @classmethod
    def from_pretrained(
        cls: type[Model], directory: str | os.PathLike, torch_dtype: torch.dtype | None = None
    ) -> Model:
        """The model that `save_pretrained` wrote into a local directory, in evaluation mode.

        Args:
            directory: Holds config.json and diffusion_pytorch_model.safetensors. Nothing is downloaded.
            torch_dtype: Data type of the parameters (default: as stored).

        Raises:
            ValueError: A file is missing or damaged, or its weights are not those of the config's architecture.
        """
        path = Path(directory)
        model = cls.from_config(read_config(path / CONFIG_NAME))
        try:
            state = load_file(path / WEIGHTS_NAME)
        except FileNotFoundError as error:
            raise ValueError(f"{path / WEIGHTS_NAME}: no such file") from error
        except SafetensorError as error:
            raise ValueError(f"{path / WEIGHTS_NAME}: damaged: {error}") from error
        try:
            model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(f"{path / WEIGHTS_NAME}: not the weights of its {CONFIG_NAME}: {error}") from error
        return (model if torch_dtype is None else model.to(torch_dtype)).eval()

    def save_pretrained(self, directory: str | os.PathLike) -> None:
        """Write config.json and diffusion_pytorch_model.safetensors into a directory, which is made if missing."""
        path = Path(directory)
        path.mkdir(parents=True, exist_ok=True)
        write_config(type(self).__name__, self.config, path / CONFIG_NAME)
        state = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        save_file(state, path / WEIGHTS_NAME, metadata={"format": "pt"})

    def register_to_config(self, **changes: Any) -> None:
        """Replace entries of the config."""
        self.config = Config(self.config | changes)

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def dtype(self) -> torch.dtype:
        return next(self.parameters()).dtype

    def num_parameters(self, only_trainable: bool = False) -> int:
        """Number of parameters, or of those that are trained."""
        return sum(p.numel() for p in self.parameters() if p.requires_grad or not only_trainable)
