"""Turns recorded configs into typed ones, such that runs of earlier versions keep their meaning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from memmlp.config.schema.config import DATA, GROUPS, SCHEMAS, Config, LoggerConfig
from memmlp.config.schema.config_checks import WITHOUT_STREAM
from memmlp.config.schema.data import SynthDataConfig
from memmlp.runs.former_keys import with_present_names
from memmlp.runs.identity import option_in_slot


def restored(config: Mapping[str, Any]) -> DictConfig:
    """Turn the config that a run recorded back into a typed one, with the classes of this version.

    Raises:
        OmegaConfBaseException, KeyError: if the record does not fit this version's schema. (A value of the
            wrong kind may also raise TypeError or ValueError.)
    """
    cfg = OmegaConf.structured(Config)
    for group, content in with_present_names(config).items():
        cfg[group] = _restored(group, content) if isinstance(content, Mapping) else content
    if cfg.export.graph in WITHOUT_STREAM:
        cfg.export.precision = "fp32"  # until version 0.2 another was allowed, and no file was made of it
    return cfg


def _restored(group: str, content: Mapping[str, Any]) -> Any:
    """Return one group as a typed config.

    A component that is not part of this package keeps the path of its class.
    """
    if group == "loggers":
        return _loggers(content)
    option = SCHEMAS.get(f"{group}_{option_in_slot({group: content}, group)}")
    ours = option is None or option.__module__.startswith("memmlp.")
    if group == "data" and ours:
        schema = SynthDataConfig if content["synth"] else DATA[content["split"]["name"]]
        return OmegaConf.merge(OmegaConf.structured(schema), _bare(content))
    return OmegaConf.merge(OmegaConf.structured(option or GROUPS[group]), _content(option, content))


def _loggers(content: Mapping[str, Any]) -> Any:
    """Return the loggers as typed configs. Up to version 0.2 the group was itself the single logger."""
    every = {str(content["name"]): content} if "name" in content else content
    return {name: _restored_logger(name, node) for name, node in every.items() if name != "none"}


def _restored_logger(name: str, content: Mapping[str, Any]) -> Any:
    option = SCHEMAS.get(f"loggers_{name}")
    return OmegaConf.merge(OmegaConf.structured(option or LoggerConfig), _content(option, content))


def _content(option: type | None, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content for a typed config.

    The classes of memmlp's options may have moved; those of other packages are checked to be the option's.
    """
    return _bare(content) if option and option.__module__.startswith("memmlp.") else dict(content)


def _bare(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a group without the paths of its classes, which the schema provides."""
    bare = {key: _bare(value) if isinstance(value, Mapping) else value for key, value in content.items()}
    return {key: value for key, value in bare.items() if key != "_target_"}
