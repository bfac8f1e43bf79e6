"""Save and load models in the file format of diffusers without importing diffusers.

`ConfiguredModel` provides the methods of diffusers' `ModelMixin` and `ConfigMixin` that this project uses. A model
directory holds config.json and diffusion_pytorch_model.safetensors. Methods and files have the same names as in
diffusers.
"""

from __future__ import annotations

import inspect
import json
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from models.limits import require_within
from models.local_copy import make_local_copy
from models.options import show_value
from models.strict_json import parse_json

CONFIG_NAME = "config.json"
WEIGHTS_NAME = "diffusion_pytorch_model.safetensors"
MAX_CONFIG_BYTES = 2**20  # Largest accepted config; real configs have a few kilobytes.
MAX_HEADER_BYTES = 2**22  # Largest accepted header of a weights file; 1,000 tensors need about 100 kilobytes.
# Data types of stored weights, as safetensors names them. Loaded parameters are float32.
WEIGHT_TYPES = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}

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


def read_config(path: Path, kind: str = "") -> dict[str, Any]:
    """Read a config without the entries that diffusers adds.

    Args:
        path: JSON file written by `write_config` or by diffusers.
        kind: Expected name of the class, if the file states one. Empty: any class.

    Returns:
        Constructor arguments by name. The values are not checked.

    Raises:
        ValueError: The file is missing, is too large, is not a JSON object or describes another class.
    """
    try:
        size = path.stat().st_size
        if size > MAX_CONFIG_BYTES or not path.is_file():
            raise ValueError(f"{path}: {size:,} bytes, expected a regular file of at most {MAX_CONFIG_BYTES:,} bytes")
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    try:
        content = parse_json(content)
    except ValueError as error:
        raise ValueError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object, got a {type(content).__name__}")
    if kind and content.get("_class_name", kind) != kind:
        raise ValueError(f"{path}: _class_name is {show_value(content['_class_name'])}, expected {kind!r}")
    return {name: value for name, value in content.items() if not name.startswith("_")}


def read_weights(path: Path, model: nn.Module) -> dict[str, Tensor]:
    """Read the weights of a model, if the file holds exactly the tensors of the model.

    Names, shapes and data types are compared with the header of the file before any tensor is read.

    Args:
        path: Weights in safetensors format.
        model: Model, which may be on the meta device.

    Returns:
        Float32 tensors by name. The tensors are copies, so the file may be replaced later.

    Raises:
        ValueError: The file is missing or damaged, a tensor is missing, unexpected, of another shape or of another
            data type, or a value is not finite.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    expected = model.state_dict()
    state = {}
    try:
        with open(path, "rb") as file:
            start = file.read(8)
        header = struct.unpack("<Q", start)[0] if len(start) == 8 else 0
        if not 0 < header <= MAX_HEADER_BYTES:
            raise ValueError(
                f"{path}: the file is damaged: its header has {header:,} bytes, expected 1 to {MAX_HEADER_BYTES:,}"
            )
        with safe_open(path, "pt") as file:
            _compare_header(path, file, expected)
            for name in expected:
                state[name] = file.get_tensor(name).to(torch.float32, copy=True)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: the file is damaged: {error}") from error
    for name, value in state.items():
        if value.numel():
            low, high = torch.aminmax(value)  # Both are NaN if a value is NaN.
            if not torch.isfinite(high - low / 2):
                raise ValueError(f"{path}: {name} holds values from {low:g} to {high:g}, expected finite numbers")
    return state


def _compare_header(path: Path, file: Any, expected: Mapping[str, Tensor]) -> None:
    """Raise ValueError if a file opened by `safe_open` does not hold exactly the expected tensors."""
    names = set(file.keys())
    kinds = {}
    fault = ""
    if missing := sorted(set(expected) - names):
        fault = f"{len(missing)} of {len(expected)} tensors are missing, such as {missing[0]}"
    elif extra := sorted(names - set(expected)):
        fault = f"{len(extra)} tensors are not in the model, such as {show_value(extra[0])}"
    for name in () if fault else expected:
        part = file.get_slice(name)
        shape, kind = tuple(part.get_shape()), str(part.get_dtype())
        kinds[kind] = name
        if shape != tuple(expected[name].shape):
            fault = f"{name} has the shape {shape}, expected {tuple(expected[name].shape)}"
        elif kind not in WEIGHT_TYPES:
            fault = f"{name} has the data type {kind}, expected one of: {', '.join(WEIGHT_TYPES)}"
        elif len(kinds) > 1:
            fault = f"{' and '.join(kinds.values())} have the data types {' and '.join(kinds)}, expected one data type"
        if fault:
            break
    if fault:
        raise ValueError(f"{path}: the weights do not fit the {CONFIG_NAME} in the same directory: {fault}")


class SkipInitialValues(TorchFunctionMode):
    """Build networks on the meta device without initial values. Some random functions need seconds to import there."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call a function of torch, but return tensors without random values."""
        kwargs = kwargs or {}
        if func in (Tensor.normal_, Tensor.uniform_) or getattr(func, "__module__", "") == nn.init.__name__:
            return args[0] if args else kwargs["tensor"]
        return (torch.empty if func is torch.randn else func)(*args, **kwargs)


def register_computed_buffers(module: nn.Module) -> None:
    """Compute the buffers that follow from the config, and register them in a module. They are not saved.

    On the meta device, the function does nothing. `from_pretrained` calls it again.

    Args:
        module: Module with a method `compute_buffers`, which returns tensors by name.

    Raises:
        LimitError: A buffer exceeds the limit model_buffers.
    """
    if torch.get_default_device().type != "meta":
        for name, value in cast(Any, module).compute_buffers().items():
            module.register_buffer(name, value, persistent=False)


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
        """Rename the entries of a config written by an earlier version. No entry has been checked.

        Args:
            config: Entries of a stored config.

        Returns:
            Entries with the names of the constructor arguments. The base class returns `config` unchanged.

        Raises:
            ValueError: Two entries contradict each other.
        """
        return config

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check type and range of all entries, and convert entries to dataclasses where the constructor needs them.

        Args:
            config: Value of every constructor argument: the entry of a stored config, or the default.

        Returns:
            Keyword arguments of the constructor. The base class returns `config` unchanged.

        Raises:
            ValueError: An entry is missing or has an invalid value.
        """
        return config

    @classmethod
    def parse_arguments(cls, config: Mapping[str, Any]) -> dict[str, Any]:
        """Convert a stored config to keyword arguments of the constructor.

        Args:
            config: Constructor arguments by name; entries that begin with "_" are ignored.

        Returns:
            Checked keyword arguments.

        Raises:
            ValueError: An entry is unknown, is missing or has an invalid value.
        """
        arguments = cls.upgrade_config({name: value for name, value in config.items() if not name.startswith("_")})
        known = dict(list(inspect.signature(cls.__init__).parameters.items())[1:])
        if unknown := sorted(set(arguments) - set(known)):
            shown = ", ".join(name[:60] for name in unknown[:5])
            raise ValueError(f"{cls.__name__} has no option {shown}; expected some of: {', '.join(known)}")
        arguments = {name: parameter.default for name, parameter in known.items()} | arguments
        try:
            for name, value in arguments.items():
                if value is inspect.Parameter.empty:
                    raise ValueError(f"{name} is missing")
            return cls.parse_config(arguments)
        except ValueError as error:
            raise ValueError(f"{cls.__name__}: {error}") from error

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
        return cls(**cls.parse_arguments(config))

    @classmethod
    def from_pretrained(
        cls: type[Model], directory: str | os.PathLike, torch_dtype: torch.dtype | None = None
    ) -> Model:
        """Load a model from a directory written by `save_pretrained`.

        The network is first built without memory (meta device). Memory is allocated after the size of the network and
        the header of the weights have been checked.

        Args:
            directory: Directory with config.json and diffusion_pytorch_model.safetensors: a path, or a URI such as
                s3://bucket/folder, which is copied to the local cache (models/local_copy.py). Model hubs are not asked.
            torch_dtype: Data type of the parameters; None: float32.

        Returns:
            The model in evaluation mode.

        Raises:
            ValueError: A file is missing or damaged, an entry of the config is invalid, the network exceeds a limit, or
                the weights do not match the architecture in config.json.
        """
        path = Path(make_local_copy(directory, (CONFIG_NAME, WEIGHTS_NAME).__contains__))
        config = read_config(path / CONFIG_NAME, cls.__name__)
        try:
            arguments = cls.parse_arguments(config)
            with torch.device("meta"), SkipInitialValues():
                model = cls(**arguments)
            require_within("model_parameters", model.num_parameters())
            for module in model.modules():
                if hasattr(module, "compute_buffers"):
                    register_computed_buffers(module)
        except ValueError as error:
            raise ValueError(f"{path / CONFIG_NAME}: {error}") from error
        model.load_state_dict(read_weights(path / WEIGHTS_NAME, model), assign=True)
        return (model if torch_dtype is None else model.to(torch_dtype)).eval()

    def save_pretrained(self, directory: str | os.PathLike) -> None:
        """Write config.json and diffusion_pytorch_model.safetensors into a directory.

        The file holds float16 values if they equal the weights (`round_to_float16`).

        Args:
            directory: Output directory. The directory is created if it does not exist.
        """
        path = Path(directory)
        path.mkdir(parents=True, exist_ok=True)
        write_config(type(self).__name__, self.config, path / CONFIG_NAME)
        state = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        if all(torch.equal(value.half().to(value.dtype), value) for value in state.values()):
            state = {name: value.half() for name, value in state.items()}
        save_file(state, path / WEIGHTS_NAME, metadata={"format": "pt"})

    @torch.no_grad()
    def round_to_float16(self) -> None:
        """Round the weights to values that float16 represents, so `save_pretrained` writes half as many bytes.

        Raises:
            ValueError: A weight exceeds the range of float16.
        """
        limit = torch.finfo(torch.float16).max
        for name, value in self.named_parameters():
            if value.abs().max() > limit:
                raise ValueError(f"{name} contains a weight of {float(value.abs().max()):g}; float16 ends at {limit:g}")
            value.copy_(value.half())

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
