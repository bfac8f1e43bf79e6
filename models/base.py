"""Save and load models in the file format of diffusers without importing diffusers.

`ConfiguredModel` provides the methods of diffusers' `ModelMixin` and `ConfigMixin` that this project uses. A model
directory holds config.json and diffusion_pytorch_model.safetensors. Methods and files have the same names as in
diffusers.
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
from torch import Tensor, nn

CONFIG_NAME = "config.json"
WEIGHTS_NAME = "diffusion_pytorch_model.safetensors"

Model = TypeVar("Model", bound="ConfiguredModel")


class Config(dict):
    """Dictionary of the constructor arguments of a model; entries are also readable as attributes."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"config has no entry {name!r}, only: {', '.join(self)}") from None


def register_to_config(init: Callable[..., None]) -> Callable[..., None]:
    """Decorate `__init__` to store all its arguments, including defaults, in `self.config`.

    Args:
        init: Constructor of a `ConfiguredModel`. Dataclass arguments are stored as dictionaries.

    Returns:
        The decorated constructor.
    """
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
    """Write a config in the format of diffusers: sorted JSON with the class name and the version of diffusers.

    Args:
        kind: Name of the class.
        config: Constructor arguments; they must be JSON-serialisable.
        path: Output file.
    """
    content = {"_class_name": kind, "_diffusers_version": version("diffusers")} | dict(config)
    path.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def read_config(path: Path) -> dict[str, Any]:
    """Read a config without the entries that diffusers adds.

    Args:
        path: JSON file written by `write_config` or by diffusers.

    Returns:
        Constructor arguments by name.

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


def apply_in_float32(module: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a module in float32, also inside `torch.autocast`.

    bfloat16 has 8 bits of precision: a centre at x = 60 m would be rounded to a multiple of 25 cm. The layers that read
    coordinates and heights, or that output them, therefore compute in float32. The layers between them do not.

    Args:
        module: Layer or function whose parameters are float32 if autocast is enabled.
        x: Input, any floating-point type.

    Returns:
        Output of the module. Without autocast, the module is applied as it is.
    """
    if not torch.is_autocast_enabled(x.device.type):
        return module(x)
    with torch.autocast(x.device.type, enabled=False):
        return module(x.float())


class ConfiguredModel(nn.Module):
    """A network that is stored together with its constructor arguments.

    Subclasses decorate `__init__` with the function `register_to_config`.

    Attributes:
        config: All constructor arguments, including defaults.
    """

    config: Config

    @classmethod
    def upgrade_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Convert a config written by an earlier version to the current constructor arguments.

        Args:
            config: Entries of a stored config.

        Returns:
            Keyword arguments of the constructor. The base class returns `config` unchanged.
        """
        return config

    @classmethod
    def from_config(cls: type[Model], config: Mapping[str, Any]) -> Model:
        """Build a model with newly initialised weights from a config.

        Args:
            config: Constructor arguments by name; entries that begin with "_" are ignored.

        Returns:
            The model in training mode.

        Raises:
            ValueError: An entry is unknown or has an invalid value.
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
        """Load a model from a local directory written by `save_pretrained`.

        Args:
            directory: Directory with config.json and diffusion_pytorch_model.safetensors. Nothing is downloaded.
            torch_dtype: Data type of the parameters; None: the stored data type.

        Returns:
            The model in evaluation mode.

        Raises:
            ValueError: A file is missing or damaged, or the weights do not match the architecture in config.json.
        """
        path = Path(directory)
        model = cls.from_config(read_config(path / CONFIG_NAME))
        try:
            state = load_file(path / WEIGHTS_NAME)
        except FileNotFoundError as error:
            raise ValueError(f"{path / WEIGHTS_NAME}: no such file") from error
        except SafetensorError as error:
            raise ValueError(f"{path / WEIGHTS_NAME}: the file is damaged: {error}") from error
        try:
            model.load_state_dict(state)
        except RuntimeError as error:
            raise ValueError(
                f"{path / WEIGHTS_NAME}: the weights do not fit the {CONFIG_NAME} in the same directory: {error}"
            ) from error
        return (model if torch_dtype is None else model.to(torch_dtype)).eval()

    def save_pretrained(self, directory: str | os.PathLike) -> None:
        """Write config.json and diffusion_pytorch_model.safetensors into a directory.

        Args:
            directory: Output directory. The directory is created if it does not exist.
        """
        path = Path(directory)
        path.mkdir(parents=True, exist_ok=True)
        write_config(type(self).__name__, self.config, path / CONFIG_NAME)
        state = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        save_file(state, path / WEIGHTS_NAME, metadata={"format": "pt"})

    def register_to_config(self, **changes: Any) -> None:
        """Replace entries of the config.

        Args:
            **changes: New values by entry name.
        """
        self.config = Config(self.config | changes)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the parameters."""
        return next(self.parameters()).dtype

    def num_parameters(self, only_trainable: bool = False) -> int:
        """Return the number of parameters.

        Args:
            only_trainable: If True, count only parameters that require a gradient.

        Returns:
            Number of scalar parameters.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad or not only_trainable)
