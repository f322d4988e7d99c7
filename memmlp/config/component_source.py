"""A Hydra config source with the options that components declare, in addition to YAML files."""

import re
from collections.abc import Callable
from typing import Any

from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import (
    SLOTS,
    collect_attribute,
    find_chosen_settings,
    find_component,
    list_component_names,
)
from memmlp.common.settings import SIZES
from memmlp.config.schema import ONLY, SCHEMAS, make_typed

SCHEME = "components"
SCHEMA = "schema"
WIDTHS = re.compile(r"(model|memory)\.(width|code_width|feedforward)")
GROUPS = (*SLOTS, "generator", "loggers")


def is_group(path: str) -> bool:
    """Return whether components have options in a group of the config."""
    return path in (*GROUPS, *ONLY)


class ComponentSource(ConfigSource):
    """Provides GROUP/NAME for each component, GROUP/default for groups with one option, and schema/NAME. An
    option is created only when Hydra loads it, so other components are not read."""

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """Return an option's typed config, with the defaults and keys that its component declares."""
        group, _, name = config_path.removesuffix(".yaml").partition("/")
        package, node = _load_option(group, name)
        return ConfigResult(self.provider, f"{SCHEME}://", node, {"package": package})

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.strip("/") == SCHEMA or is_group(config_path.strip("/"))

    def is_config(self, config_path: str) -> bool:
        group, _, name = config_path.removesuffix(".yaml").partition("/")
        return name in self.list(group, ObjectType.CONFIG)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the options of a group; an empty list if Hydra asks for groups."""
        group = config_path.strip("/")
        if results_filter == ObjectType.GROUP:
            return []
        if group == SCHEMA:
            return sorted(SCHEMAS)
        return ["default"] if group in ONLY else list_component_names(group)


def _load_option(group: str, name: str) -> tuple[str | None, DictConfig]:
    """Return an option's Hydra package, None for the package of its group, and its config."""
    if group in (SCHEMA, *ONLY):
        return None, make_typed(SCHEMAS[name] if group == SCHEMA else ONLY[group])
    settings = find_component(group, name).settings
    node: Any = make_typed(settings)
    if group == "loggers":
        return f"loggers.{name}", node
    others, recipe = collect_attribute(settings, "defaults"), collect_attribute(settings, "recipe")
    if not others and not recipe:
        return None, node
    overrides = [{f"override /{slot}": option} for slot, option in others.items()]
    cfg = OmegaConf.create({"defaults": [*overrides, "_self_"], group: node})
    for key, value in recipe.items():
        OmegaConf.update(cfg, key, value)
    return "_global_", cfg


def _choose_size(
    tiny: Any, small: Any, paper: Any, width_fraction: float = 0, *, _root_: DictConfig, _node_: Any
) -> Any:
    chosen = (tiny, small, paper)[SIZES.index(_root_.profile.sizes)]
    if width_fraction and _root_.profile.width is not None:
        chosen = width_fraction * _root_.profile.width
    if WIDTHS.fullmatch(_node_._get_full_key(None)):
        return round(chosen * _root_.profile.scale)
    return chosen


def _choose_movement(weight: float, *, _root_: DictConfig) -> float | None:
    one_frame = getattr(find_chosen_settings(_root_, "model"), "learns_newest_frame", False)
    return None if one_frame else weight


def register_components() -> None:
    """Register the components with Hydra, and the resolvers of their defaults with OmegaConf."""
    Plugins.instance().register(ComponentSource)
    resolvers: dict[str, Callable[..., Any]] = {
        "size": _choose_size,
        "reading": lambda default, literal, *, _root_: (
            literal if _root_.profile.reading == "literal" else default
        ),
        "movement": _choose_movement,
        # only the first eight layers, also in deeper networks (Table 9)
        "even_layers": lambda depth: list(range(2, min(depth, 8) + 1, 2)),
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)
