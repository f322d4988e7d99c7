"""Checkpoints: own files of tensors and JSON values, without pickle, and files that authors publish."""

import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, load_file, save
from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.networks.settings import Release

MAX_RATIO = 16  # the largest number of parameters for each number in a published checkpoint, estimated
MAX_BYTES = 4 * 2**30  # the size of a published checkpoint; the largest known one has 0.5 GB
CONTAINERS = ("state_dict", "model_state_dict", "params", "model")
"""Keys under which authors put a network's tensors beside other values."""


def write(path: Path, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Write tensors and JSON values atomically."""
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    atomic_write(path, save(flat, {"memmlp": json.dumps(values)}))


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and values that `write` wrote.

    Raises:
        InputError: if the file is missing or damaged; the message names it.
    """
    try:
        content = path.read_bytes()  # opened once, since a training may replace the file meanwhile
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        return tensors, json.loads(header["__metadata__"]["memmlp"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a checkpoint of memmlp ({error})") from error


def collect_module_tensors(prefix: str, module: nn.Module) -> dict[str, Tensor]:
    """Return a module's parameters and buffers; each name begins with "PREFIX."."""
    return {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}


def load_module(prefix: str, module: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Load the tensors with names "PREFIX.…" into a module; see `collect_module_tensors`."""
    start = f"{prefix}."
    module.load_state_dict(
        {name.removeprefix(start): tensor for name, tensor in tensors.items() if name.startswith(start)}
    )


def collect_optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return the optimiser's state as tensors named "optimiser.PARAMETER_NUMBER.ENTRY"."""
    state = optimiser.state_dict()["state"]
    return {f"optimiser.{i}.{name}": tensor for i, entry in state.items() for name, tensor in entry.items()}


def load_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Load the optimiser's state; its parameter groups and learning rates stay unchanged."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimiser."):
            _, index, entry = name.split(".", 2)
            state.setdefault(int(index), {})[entry] = tensor
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})


def read_published(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint of torch or safetensors, without executing anything in it.

    Raises:
        InputError: if the file is not such a checkpoint, contains other objects, or has unusable tensors.
    """
    content = _load_safely(path)
    for key in CONTAINERS:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
    if isinstance(content, Mapping):  # SAGE-Net's parts are beside each other
        parts = {
            key: part
            for key, part in content.items()
            if str(key).endswith("_state_dict") and isinstance(part, Mapping)
        }
        if parts:
            content = {f"{key}.{name}": one for key, part in parts.items() for name, one in part.items()}
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content) or not content:
        raise InputError(f"{path}: must contain tensors by name")
    prefix = "module." if all(key.startswith("module.") for key in content) else ""
    tensors = {key.removeprefix(prefix): value for key, value in content.items()}
    for key, value in tensors.items():
        if problem := _find_tensor_problem(value):
            raise InputError(f"{path}: {key}: {problem}")
    return tensors


def read_published_statistics(paths: Iterable[Path], size: int) -> Tensor:
    """Read files with one vector of numbers each, such as mean and standard deviation: (files, size).

    Raises:
        InputError: if a file is not a safe checkpoint of such a vector.
    """
    found = []
    for path in paths:
        value = _load_safely(path)
        shape = tuple(getattr(value, "shape", ()))
        problem = f"has shape {shape}, expected ({size},)" if shape != (size,) else None
        if problem := problem or _find_tensor_problem(value):
            raise InputError(f"{path}: {problem}")
        found.append(value.float())
    return torch.stack(found)


def _load_safely(path: Path) -> Any:
    """Return the content of a file of torch or safetensors; raise InputError if it cannot be read safely."""
    expected = f"{path}: must be a file that torch.load(weights_only=True) can read"
    try:
        with open(path, "rb") as file:
            start = file.read(9)
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: must be at most {MAX_BYTES / 2**30:.0f} GiB")
        if start[8:] == b"{":
            return load_file(path)
        if zipfile.is_zipfile(path):
            _check_zip(path)
        return torch.load(path, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except Exception as error:  # torch raises errors of any type for a damaged file
        if isinstance(error, OSError) and error.strerror:
            raise InputError(f"{path}: {error.strerror}") from None
        found = re.search(r"(?:GLOBAL|global|class|function) [\w.]+", str(error))
        reason = found[0] if found else next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(f"{expected} ({reason[:100]})") from None


def _check_zip(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    if any(one.compress_type != zipfile.ZIP_STORED for one in members):
        raise InputError(f"{path}: must not be compressed, as torch.save writes it")
    if sum(one.file_size for one in members) > path.stat().st_size:
        raise InputError(f"{path}: its parts must not overlap")


def _find_tensor_problem(value: object) -> str | None:
    if not isinstance(value, Tensor):
        return f"must be a tensor, but is a {type(value).__name__}"
    if value.layout != torch.strided or value.device.type != "cpu" or value.is_quantized:
        return "must be a dense tensor with its numbers in the file"
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        return (
            f"has shape {tuple(value.shape)}, but the file has only {value.untyped_storage().nbytes()} bytes"
        )
    if value.is_complex() or not torch.isfinite(value).all():
        return "must have finite real numbers"
    return None


def find_published_sizes(tensors: Mapping[str, Tensor], release: Release) -> dict[str, int]:
    """Return the config keys and values that the shapes of published tensors determine.

    Raises:
        ValueError: if a tensor is missing; the text names it.
    """
    sizes = {}
    for key, where in release.sizes.items():
        name, axis = (where, -1) if isinstance(where, str) else where
        found = [one for one in tensors if _compile(name).fullmatch(one)]
        if not found:
            raise ValueError(f"{name}: is missing, so this is not a checkpoint of {release.source}")
        shape = tuple(tensors[found[0]].shape)
        if axis >= len(shape):
            raise ValueError(f"{name}: must have {axis + 1} axes, but has shape {shape}")
        sizes[key] = len(found) if axis < 0 else shape[axis]
    count = sum(tensor.numel() for tensor in tensors.values())
    depth = sizes.get("model.depth", 1)
    if depth * max(sizes.values()) ** 2 > MAX_RATIO * count:
        raise ValueError(f"{', '.join(f'{key}={size}' for key, size in sizes.items())}: too large for it")
    return sizes


def rename_published(
    tensors: Mapping[str, Tensor], release: Release, expected: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return published tensors under the names here.

    Args:
        tensors: the published tensors.
        release: the names.
        expected: the network's own tensors, whose shapes the result has. Axes of length 1 do not count.

    Raises:
        ValueError: for a missing or superfluous tensor, or another shape; the text names it.
    """
    patterns = [(_compile(ours), theirs) for ours, theirs in release.names.items()]
    unused = [_compile(name) for name in release.unused]
    renamed, seen = {}, set[str]()
    for key, own in expected.items():
        found = ((pattern.fullmatch(key), theirs) for pattern, theirs in patterns)
        match, theirs = next((one for one in found if one[0]), (None, ""))
        if match is None:
            raise ValueError(f"{key}: is not a part of the published network; change the overrides")
        name, part, parts = _split_name(theirs, match.groups())
        if name not in tensors:
            raise ValueError(f"{name}: is missing, expected shape {_join_parts(own.shape, parts)}")
        tensor = tensors[name]
        seen.add(name)
        if parts > 1 and tensor.dim() and tensor.shape[0] % parts == 0:
            tensor = tensor.chunk(parts)[part]
        if _squeeze(tensor.shape) != _squeeze(own.shape) or (parts > 1 and tensor is tensors[name]):
            expected_shape = _join_parts(own.shape, parts)
            raise ValueError(f"{name}: has shape {tuple(tensors[name].shape)}, expected {expected_shape}")
        renamed[key] = tensor.to(own.dtype).reshape(own.shape).clone()
    for name in tensors:
        if name not in seen and not any(one.fullmatch(name) for one in unused):
            raise ValueError(f"{name}: is not a tensor of {release.source}")
    return renamed


def _compile(pattern: str) -> re.Pattern[str]:
    """Compile a pattern of a Release: `**` is any text, and `*` any text without dots."""
    return re.compile(re.escape(pattern).replace(r"\*\*", ".*").replace(r"\*", r"([^.]+)"))


def _split_name(theirs: str, parts: Iterable[str]) -> tuple[str, int, int]:
    """Return the authors' name with its parts filled in, and the index and number of row parts."""
    name, _, rows = theirs.removesuffix("]").partition("[")
    index, _, count = rows.partition("/")
    for part in parts:
        name = name.replace("*", part, 1)
    return name, int(index or 0), int(count or 1)


def _squeeze(shape: Iterable[int]) -> list[int]:
    return [size for size in shape if size != 1]


def _join_parts(shape: torch.Size, parts: int) -> tuple[int, ...]:
    return (shape[0] * parts, *shape[1:]) if parts > 1 else tuple(shape)
