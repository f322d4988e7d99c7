"""What libraries would work out anew at every call is kept for all tests of a process, or of all."""

from __future__ import annotations

import functools
import pickle
import sys
from pathlib import Path
from typing import Any


def remember() -> None:
    """Do so from now on with what is imported by now; to import it for this would cost more than it saves."""
    for name, patch in PATCHES.items():
        if name in sys.modules:
            patch(sys.modules[name])


def keep_exports(folder: Path) -> None:
    """Keep what torch's exporter makes in a folder from now on (kept_exports.py)."""
    import torch.onnx

    export = torch.onnx.export

    @functools.wraps(export)
    def kept(*arguments: Any, **options: Any) -> Any:
        # Imported here, since it takes half a second that most test processes need not spend.
        from kept_exports import kept

        return kept(export, folder)(*arguments, **options)

    torch.onnx.export = kept


def _remember_exporter(module: Any) -> None:
    """Of torch's exporter: the functions that it knows, half a second of each export."""
    if not hasattr(module.onnxscript_apis.get_torchlib_ops, "cache_info"):
        module.onnxscript_apis.get_torchlib_ops = functools.cache(module.onnxscript_apis.get_torchlib_ops)


def _remember_interpolations(module: Any) -> None:
    """Of OmegaConf: the parts of an interpolation such as ${seed}, which it only reads."""
    if not hasattr(module.parse, "cache_info"):
        module.parse = functools.lru_cache(maxsize=1000)(module.parse)


def _remember_configs(module: Any) -> None:
    """Of Hydra: what it read of each file for as long as the file is the same, a quarter of a composition."""
    repository = module.ConfigRepository
    if hasattr(repository.load_config, "__wrapped__"):
        return
    known: dict[tuple[Any, ...], bytes] = {}

    @functools.wraps(repository.load_config)
    def load_config(self: Any, config_path: str) -> Any:
        places = tuple((type(source), source.path) for source in self.sources)
        key = (config_path, places, *(_stamp(place, config_path) for _, place in places))
        if key not in known:
            known[key] = pickle.dumps(load_config.__wrapped__(self, config_path))
        return pickle.loads(known[key])  # a copy, since a composition changes what it loaded

    repository.load_config = load_config


def _stamp(folder: str, name: str) -> tuple[int, int] | None:
    """When a config's file was written, and its size; None of what is no file."""
    file = Path(folder) / f"{name.removesuffix('.yaml')}.yaml"
    return (file.stat().st_mtime_ns, file.stat().st_size) if file.is_file() else None


PATCHES = {
    "torch.onnx._internal.exporter._registration": _remember_exporter,
    "omegaconf.base": _remember_interpolations,
    "hydra._internal.config_repository": _remember_configs,
}
