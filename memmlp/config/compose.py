"""Composes and checks configs from a command line's overrides; every error is explained in one line."""

from __future__ import annotations

import argparse
import functools
import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn, cast

from hydra import compose, version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.default_element import GroupDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from memmlp.common.errors import InputError
from memmlp.config import plugins
from memmlp.config.config_errors import explain
from memmlp.config.package_data import packaged
from memmlp.config.schema import check, register
from memmlp.runs.identity import flatten

VERSION_BASE = "1.3"
CONFIG = "train"
SEARCHPATH = "hydra.searchpath"
EXPERIMENT = "experiment"
"""The group whose options set groups and keys all over the config."""


def parse(argv: Sequence[str]) -> tuple[argparse.Namespace, argparse.ArgumentParser]:
    """Parse Hydra's command line, and import the packages that it names; flags may be among the overrides.

    Raises:
        InputError: for flags that Hydra does not know or that are not allowed here.
    """
    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]
    args = parser.parse_intermixed_args(list(argv))
    if args.experimental_rerun:
        raise InputError("--experimental-rerun: unpickles a file; allowed are overrides")
    plugins.activate(plugins.named(args.overrides))
    Plugins.instance().register(UserConfigs)
    return args, parser


class UserConfigs(SearchPathPlugin):
    """Makes Hydra search further folders of configs beside memmlp's, wherever it composes."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Add the folders after memmlp's own."""
        for provider, folder in plugins.folders():
            search_path.append(provider, f"file://{folder}")


def _refuse(message: str) -> NoReturn:
    raise InputError(f"train: {message} (see memmlp train --help)")


def composed(overrides: Sequence[str]) -> DictConfig:
    """Compose and check the config of one job from its overrides."""
    args, _ = parse(overrides)
    register()
    version.setbase(VERSION_BASE)
    (cfg,) = preflight(args)
    return cfg


def composed_plain(name: str, overrides: Sequence[str], folder: Path | None = None) -> dict[str, Any]:
    """Compose a config other than that of `memmlp train`, and return it as plain dictionaries.

    Args:
        name: the config's name.
        overrides: the command line's overrides.
        folder: a folder of the user's own configs, searched first.
    """
    args, _ = parse([*(["--config-dir", str(folder)] if folder else []), *overrides])
    version.setbase(VERSION_BASE)
    with _hydra(args), _explained(overrides):
        return cast(dict[str, Any], OmegaConf.to_container(compose(name, args.overrides), resolve=True))


def set_by_experiments(options: Sequence[str], overrides: Sequence[str] = ()) -> set[str]:
    """Return the groups and the dotted keys that options of the group `experiment` set.

    Those that an option sets by the configs in its defaults list, such as another experiment, are included.

    Args:
        options: the options; those that do not exist are left out.
        overrides: what else is chosen, of which only `hydra.searchpath` acts.
    """
    args, _ = parse([])
    register()
    version.setbase(VERSION_BASE)
    places = [word for word in overrides if word.lstrip("+").startswith(f"{SEARCHPATH}=")]
    found: set[str] = set()
    with _hydra(args):
        loader = GlobalHydra.instance().config_loader()
        assert isinstance(loader, ConfigLoaderImpl)
        for option in options:
            found |= _set_by(f"experiment/{option}", [*places, f"experiment={option}"], loader)
    return found


def _set_by(name: str, words: Sequence[str], loader: ConfigLoaderImpl) -> set[str]:
    """Return the groups and the dotted keys that a config, and those in its defaults list, set.

    Args:
        name: the config's name, such as "experiment/paper".
        words: overrides that choose it.
        loader: Hydra's loader.
    """
    _, files = loader._parse_overrides_and_create_caching_repo(CONFIG, list(words))
    parents, found = dict[str, str | None](), set[str]()
    with suppress(HydraException, RecursionError):  # composing says so
        every = loader.compute_defaults_list(CONFIG, list(words), RunMode.RUN).defaults
        parents = {str(one.config_path): one.parent for one in every}
    for config in {name, *(one for one in parents if name in _above(one, parents))}:
        if file := files.load_config(config):
            groups = [group for group in file.defaults_list or () if isinstance(group, GroupDefault)]
            found |= {str(group.group).lstrip("/") for group in groups if group.override}
            found |= flatten(cast(dict[str, Any], OmegaConf.to_container(file.config))).keys()
    return found


def _above(config: str, parents: Mapping[str, str | None]) -> Iterator[str]:
    """Yield the configs whose defaults lists lead to a config, the nearest first."""
    while above := parents.get(config):
        yield above
        config = above


def check_words(args: argparse.Namespace) -> None:
    """Raise InputError for what Hydra would leave out without a word: a hidden file, a second experiment."""
    _check_hidden(args)
    _jobs(args)  # refuses a second experiment


def preflight(args: argparse.Namespace) -> list[DictConfig]:
    """Compose and check the config of every job, so that a bad one is known before the first job starts."""
    configs = []
    with _hydra(args):
        for overrides in _jobs(args):
            with _explained(overrides):
                configs.append(_compose(args, overrides))
            check(configs[-1])
            _check_plugins(configs[-1])
            _check_fractions(configs[-1], overrides)
    _check_texts(configs[0], args.overrides)
    return configs


def _compose(args: argparse.Namespace, overrides: list[str]) -> DictConfig:
    """Compose the config of one job as Hydra does, but choose the options of groups only once for all jobs.

    A sweep has many configs that differ only in values, and reading and merging the files of groups takes
    nine tenths of the time. Users' own folders may change meanwhile, so they are read each time.
    """
    parsed = OverridesParser.create().parse_overrides(overrides)
    own = args.config_name or args.config_path or args.config_dir or any(plugins.folders())
    if own or any(override.is_hydra_override() for override in parsed):
        return compose(args.config_name or CONFIG, overrides)
    loader = GlobalHydra.instance().config_loader()
    assert isinstance(loader, ConfigLoaderImpl)
    loader.validate_sweep_overrides_legal(parsed, RunMode.RUN, from_shell=False)
    options = [override for override in parsed if _chooses_option(override, loader)]
    cfg = cast(DictConfig, pickle.loads(_with_options(*(str(override.input_line) for override in options))))
    loader._apply_overrides_to_config([override for override in parsed if override not in options], cfg)
    return cfg


def _chooses_option(override: Override, loader: ConfigLoaderImpl) -> bool:
    """Return whether an override chooses an option of a group, by Hydra's rule; others only set values."""
    return not isinstance(override.value(), dict) and loader.repository.group_exists(override.key_or_group)


@functools.lru_cache(maxsize=64)
def _with_options(*options: str) -> bytes:
    """Return the config of `memmlp train` with options of groups, pickled, as that is the fastest to copy."""
    return pickle.dumps(compose(CONFIG, list(options)))


def _check_plugins(cfg: DictConfig) -> None:
    """Check that users' packages were known before the config was composed."""
    for name in cfg.plugins:
        if name not in plugins.active():
            raise InputError(
                f"plugins=[{name}]: a config file tells it too late; allowed is on the command line, "
                f"in the base of a sweep or search, or {plugins.VARIABLE}={name}"
            )


def _check_fractions(cfg: DictConfig, overrides: Sequence[str]) -> None:
    """Raise InputError for a fraction of the split that changes nothing, as each source has its own."""
    sources = (cfg.data.get("sources") or {}).values()
    for word in overrides:
        key = word.partition("=")[0].lstrip("+")
        part = key.removeprefix("data.split.")
        own = [one.get(part) for one in sources] if key != part and part in ("test", "val") else [None]
        if own and None not in own:
            raise InputError(f"{word}: each source has its own; allowed is data.sources.NAME.{part}")


def _check_texts(cfg: DictConfig, words: Sequence[str]) -> None:
    """Raise InputError for a text that Hydra reads as a number or bool and writes in another way.

    A folder 2024_11 would be 202411, and 1e3 would be 1000.0.
    """
    for override in OverridesParser.create().parse_overrides(list(words)):
        value, kept = override.value(), OmegaConf.select(cfg, override.key_or_group)
        texts = list(kept) if OmegaConf.is_list(kept) else [kept]
        items = (
            value.list if isinstance(value, ChoiceSweep) else value if isinstance(value, list) else [value]
        )
        word = str(override.input_line)
        key, _, written = word.partition("=")
        for item in items if all(isinstance(text, str) for text in texts) else ():
            if isinstance(item, int | float) and str(item) not in re.split(r"[\[\],\s]+", written):
                raise InputError(f"{word}: would become {item}; allowed is in quotes, \"{key}='{written}'\"")


HELP = """memmlp train trains, evaluates, exports and times one configuration.

== Configuration groups ==
Compose your configuration from those groups (group=option)

{groups}
== Config ==
Override anything in the config (foo.bar=value)

{config}
memmlp train --hydra-help tells the flags, such as -m for several runs and --config-dir for your own configs.
"""
NOT_HERE = ("hydra", "schema", "search")  # Hydra's groups, the types of ours, and what memmlp tune searches


def help_text(args: argparse.Namespace) -> str:
    """Return the groups with their options, and the config that the arguments compose."""
    with _hydra(args), _explained(args.overrides):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        groups = hydra.format_config_groups(lambda group: group.split("/")[0] not in NOT_HERE)
        config = OmegaConf.to_yaml(compose(args.config_name or CONFIG, args.overrides), resolve=args.resolve)
    return HELP.format(groups=groups, config=config)


@contextmanager
def _hydra(args: argparse.Namespace) -> Iterator[None]:
    """Initialise Hydra with the search path that the arguments ask for, as when the jobs run."""
    _check_hidden(args)
    path = create_config_search_path(str(_folder(args.config_path or packaged("conf"), "--config-path")))
    if args.config_dir:
        own = f"file://{_folder(args.config_dir, '--config-dir')}"
        path.prepend(provider="command-line", path=own, anchor=SearchPathQuery(provider="schema"))
    Hydra.create_main_hydra2(task_name="train", config_search_path=path)
    try:
        yield
    finally:
        GlobalHydra.instance().clear()


def _check_hidden(args: argparse.Namespace) -> None:
    """Raise InputError for a file of the user's that Hydra ignores: an earlier folder has one of its name."""
    main = _folder(args.config_path or packaged("conf"), "--config-path")
    before = [main, *(folder for provider, folder in plugins.folders() if provider != plugins.OWN)]
    for folder in _own_folders(args):
        for other in before:
            for path in sorted(other.rglob("*.yaml")):
                own = folder / path.relative_to(other)
                if own.is_file() and own.read_bytes() != path.read_bytes():
                    raise InputError(f"{own}: {path} is used in its place; allowed is a name of its own")
        before.append(folder)


def _own_folders(args: argparse.Namespace) -> Iterator[Path]:
    """Yield the folders of configs that a command line names, in the order in which Hydra searches them."""
    if args.config_dir:
        yield _folder(args.config_dir, "--config-dir")
    yield from (folder for provider, folder in plugins.folders() if provider == plugins.OWN)
    words = (word.lstrip("+").partition("=") for word in args.overrides)
    for value in (value for key, _, value in words if key == SEARCHPATH):
        for place in value.strip("[] ").split(","):
            name = place.strip(" '\"")
            if "://" not in name or name.startswith("file://"):
                yield Path(name.removeprefix("file://")).absolute()


def _folder(name: str | Path, option: str) -> Path:
    """Return the absolute path of the folder that an option names. Raises InputError if it does not exist."""
    if not Path(name).is_dir():
        raise InputError(f"{option} {name}: allowed is an existing folder")
    return Path(name).absolute()


def _jobs(args: argparse.Namespace) -> list[list[str]]:
    """Return the overrides of each job: of the single one, or of all jobs of a multirun."""
    with _explained(args.overrides):
        overrides = OverridesParser.create().parse_overrides(args.overrides)
        _check_experiments([one for one in overrides if one.key_or_group == EXPERIMENT])
        if not args.multirun and "hydra.mode=MULTIRUN" not in args.overrides:
            return [args.overrides]
        return BasicSweeper.split_arguments(overrides, None)[0]


def _check_experiments(chosen: Sequence[Override]) -> None:
    """Raise InputError for more than one word that chooses experiments: Hydra takes the last one alone."""
    words = [str(one.input_line) for one in chosen]
    if len(set(words)) > 1:
        raise InputError(f"{words[-1]}: would replace {words[0]}; allowed is one word, {EXPERIMENT}=[A,B]")


@contextmanager
def _explained(overrides: Sequence[str]) -> Iterator[None]:
    """Turn any error while composing into an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(explain(error, overrides)) from error
