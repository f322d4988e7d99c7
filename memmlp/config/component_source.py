"""Hydra's source of the options that components declare, in addition to the folders of YAML files."""

from __future__ import annotations

from typing import Any

from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import SLOTS, collect_attribute, find_component, list_component_names
from memmlp.common.settings import SIZES
from memmlp.config.schema import ONLY, SCHEMAS

SCHEME = "components"
SCHEMA = "schema"
GROUPS = (*SLOTS, "generator", "loggers")


def is_group(path: str) -> bool:
    """Return whether components have options in a group of the config."""
    return path in (*GROUPS, *ONLY)


class ComponentSource(ConfigSource):
    """Offers GROUP/NAME for each component, GROUP/default for groups of one option, and schema/NAME.

    An option is made only when it is loaded, so that no other component is read.
    """

    @staticmethod
    def scheme() -> str:
        """Return the scheme of the search path's entry."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the typed config of an option, with the options and keys that come with it."""
        group, _, name = config_path.removesuffix(".yaml").partition("/")
        package, node = _option(group, name)
        return ConfigResult(self.provider, f"{SCHEME}://", node, {"package": package})

    def available(self) -> bool:
        """Return true: the components are always there."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Return whether a path is a group of options."""
        return config_path.strip("/") == SCHEMA or is_group(config_path.strip("/"))

    def is_config(self, config_path: str) -> bool:
        """Return whether a path is an option of a group."""
        group, _, name = config_path.removesuffix(".yaml").partition("/")
        return name in self.list(group, ObjectType.CONFIG)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the options of a group, none where only groups are asked for."""
        group = config_path.strip("/")
        if results_filter == ObjectType.GROUP:
            return []
        return (
            sorted(SCHEMAS)
            if group == SCHEMA
            else ["default"]
            if group in ONLY
            else list_component_names(group)
        )


def _option(group: str, name: str) -> tuple[str | None, DictConfig]:
    """Return the package of an option, None for its group's own, and its config."""
    if group in (SCHEMA, *ONLY):
        return None, OmegaConf.structured(SCHEMAS[name] if group == SCHEMA else ONLY[group])
    settings = find_component(group, name).settings
    node: Any = OmegaConf.structured(settings)
    if group == "loggers":
        return f"loggers.{name}", node
    others, keys = collect_attribute(settings, "defaults"), collect_attribute(settings, "recipe")
    if not others and not keys:
        return None, node
    overrides = [{f"override /{slot}": option} for slot, option in others.items()]
    cfg = OmegaConf.create({"defaults": [*overrides, "_self_"], group: node})
    for key, value in keys.items():
        OmegaConf.update(cfg, key, value)
    return "_global_", cfg


def _size(tiny: Any, small: Any, paper: Any, width_fraction: float = 0, *, _root_: DictConfig) -> Any:
    if width_fraction and _root_.profile.width is not None:
        return round(width_fraction * _root_.profile.width)
    return (tiny, small, paper)[SIZES.index(_root_.profile.sizes)]


def _reading(default: Any, literal: Any, *, _root_: DictConfig) -> Any:
    return literal if _root_.profile.reading == "literal" else default


def _even_layers(depth: int) -> list[int]:
    return list(range(2, min(depth, 8) + 1, 2))  # of the first eight, also in deeper networks (Table 9)


def register() -> None:
    """Make the components known to Hydra, and the resolvers of their defaults to OmegaConf."""
    Plugins.instance().register(ComponentSource)
    OmegaConf.register_new_resolver("size", _size, replace=True)
    OmegaConf.register_new_resolver("reading", _reading, replace=True)
    OmegaConf.register_new_resolver("even_layers", _even_layers, replace=True)
