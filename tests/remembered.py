"""What two libraries would work out anew at every call is kept for all tests of a process."""

from __future__ import annotations

import copy
import functools
import sys
from pathlib import Path
from typing import Any


def remember() -> None:
    """Do so from now on with what is imported by now; to import it for this would cost more than it saves."""
    if "torch.onnx._internal.exporter._registration" in sys.modules:
        _remember_exporter(sys.modules["torch.onnx._internal.exporter._registration"])
    if "hydra._internal.config_repository" in sys.modules:
        _remember_configs(sys.modules["hydra._internal.config_repository"].ConfigRepository)


def _remember_exporter(module: Any) -> None:
    """Of torch's exporter: the functions that it knows, half a second of each export."""
    if not hasattr(module.onnxscript_apis.get_torchlib_ops, "cache_info"):
        module.onnxscript_apis.get_torchlib_ops = functools.cache(module.onnxscript_apis.get_torchlib_ops)


def _remember_configs(repository: Any) -> None:
    """Of Hydra: what it read of each file for as long as the file is the same, a quarter of a composition."""
    if hasattr(repository.load_config, "__wrapped__"):
        return
    known: dict[tuple[Any, ...], Any] = {}

    @functools.wraps(repository.load_config)
    def load_config(self: Any, config_path: str) -> Any:
        places = tuple((type(source), source.path) for source in self.sources)
        key = (config_path, places, *(_stamp(place, config_path) for _, place in places))
        if key not in known:
            known[key] = load_config.__wrapped__(self, config_path)
        return copy.deepcopy(known[key])  # a composition changes what it loaded

    repository.load_config = load_config


def _stamp(folder: str, name: str) -> tuple[int, int] | None:
    """When a config's file was written, and its size; None of what is no file."""
    file = Path(folder) / f"{name.removesuffix('.yaml')}.yaml"
    return (file.stat().st_mtime_ns, file.stat().st_size) if file.is_file() else None
