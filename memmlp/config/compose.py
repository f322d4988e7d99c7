"""Composes and checks configs from overrides. Every error becomes an InputError of one line."""

import argparse
import dataclasses
import functools
import itertools
import os
import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NoReturn, cast

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, OverrideType
from hydra.core.override_parser.types import Override as HydraOverride
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.components import list_component_names
from memmlp.common.errors import InputError
from memmlp.common.files import find_packaged_folder
from memmlp.common.overrides import Override, flatten, parse_overrides
from memmlp.common.schema import parse_config_yaml
from memmlp.common.text_formats import join_command, keep_text, make_override
from memmlp.config import plugins
from memmlp.config.check import CheckedConfig, check, describe_unknown_key, explain_error
from memmlp.config.component_source import GROUPS, ONLY, SCHEME, is_group, register_components
from memmlp.config.schema import Config

VERSION_BASE = "1.3"
CONFIG = "train"
EXPERIMENT = "experiment"
"""The config group with options that override other groups and keys."""

SWITCHES = {
    "--help": "-h", "--hydra-help": None, "--resolve": None, "--run": "-r", "--multirun": "-m",
    "--shell-completion": "-sc",
}  # fmt: skip
VALUES = {
    "--cfg": "-c", "--package": "-p", "--config-path": "-cp", "--config-name": "-cn", "--config-dir": "-cd",
}  # fmt: skip
"""Hydra's flags with their short forms. SWITCHES have no value; VALUES have one."""


def parse_hydra_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Parse Hydra's command line, with flags and overrides in any order, and activate its plugins. Raises
    InputError for an unknown flag, flags that exclude each other, or a plugin that cannot be used."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.error = _raise_input_error  # type: ignore[method-assign]
    for flag, short in SWITCHES.items():
        parser.add_argument(*filter(None, (flag, short)), action="store_true")
    for flag, short in VALUES.items():
        parser.add_argument(flag, short, choices=("job", "hydra", "all") if flag == "--cfg" else None)
    parser.add_argument("--info", "-i", nargs="?", const="all")
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_intermixed_args(list(argv))
    if sum(map(bool, (args.run, args.multirun, args.cfg, args.info, args.shell_completion))) > 1:
        _raise_input_error("--run, --multirun, --cfg, --info, --shell-completion: expected only one of them")
    args.overrides = list(map(keep_text, args.overrides))
    if any(one.lstrip("+").startswith("hydra.searchpath") for one in args.overrides):
        raise InputError("hydra.searchpath: use --config-dir")  # whose files are checked
    for name in ("config_dir", "config_path"):
        if folder := getattr(args, name):
            setattr(args, name, os.path.expanduser(folder))
    plugins.activate(plugins.find_named_packages(args.overrides))
    Plugins.instance().register(UserConfigs)
    register_components()
    return args


def _raise_input_error(message: str) -> NoReturn:
    raise InputError(f"train: {message} (see memmlp train --help)")


def format_hydra_arguments(args: argparse.Namespace) -> list[str]:
    """Return parsed arguments in the order that Hydra's parser expects: flags before overrides."""
    flags = {flag: getattr(args, flag[2:].replace("-", "_")) for flag in (*SWITCHES, *VALUES, "--info")}
    switches = [flag for flag, value in flags.items() if value is True]
    values = [f"{flag}={value}" for flag, value in flags.items() if isinstance(value, str)]
    return [*switches, *values, *args.overrides]


class UserConfigs(SearchPathPlugin):
    """Adds users' config folders and the components to Hydra's search path, after memmlp's folder."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for provider, folder in plugins.list_config_folders():
            search_path.append(provider, f"file://{folder}")
        search_path.append(SCHEME, f"{SCHEME}://")


def compose_config(overrides: Sequence[str]) -> DictConfig:
    """Compose and check a single job's config."""
    return compose_checked(overrides).cfg


def compose_checked(overrides: Sequence[str]) -> CheckedConfig:
    """Compose and check a single job's config, and resolve it."""
    (job,) = _compose_jobs(parse_hydra_arguments(overrides))
    return job


def compose_unchecked(overrides: Sequence[str]) -> DictConfig:
    """Compose a single job's config without checks."""
    args = parse_hydra_arguments(overrides)
    with _initialize_hydra(args):
        return _compose_job(args, list(overrides))


def compose_plain(name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Compose another config than `train`, and return it as plain dictionaries. It is not checked."""
    args = parse_hydra_arguments(overrides)
    with _initialize_hydra(args), convert_errors(overrides):
        return cast(dict[str, Any], OmegaConf.to_container(compose(name, args.overrides), resolve=True))


def find_experiment_keys(options: Sequence[str]) -> set[str]:
    """Return the groups and dotted keys that options of the group `experiment`, and those in their defaults
    lists, set. Unknown options are ignored."""
    folders = [find_packaged_folder("conf"), *(folder for _, folder in plugins.list_config_folders())]
    keys, pending, seen = set[str](), list(options), set[str]()
    while pending:
        name = pending.pop().removeprefix(f"/{EXPERIMENT}/")
        paths = (folder / EXPERIMENT / f"{name}.yaml" for folder in folders)
        if name in seen or (path := next(filter(Path.is_file, paths), None)) is None:
            continue
        seen.add(name)
        content = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        for entry in content.pop("defaults", ()):
            for group, option in entry.items() if isinstance(entry, dict) else [(EXPERIMENT, entry)]:
                sign, _, target = str(group).partition("@")[0].rpartition(" ")
                if sign == "override":
                    keys.add(target.lstrip("/"))
                elif target.lstrip("/") == EXPERIMENT:
                    pending += option if isinstance(option, list) else [str(option)]
        keys |= flatten(content).keys()
    return keys


def check_overrides(args: argparse.Namespace) -> None:
    """Raise InputError for a hidden config file or a second experiment, which Hydra ignores silently."""
    _check_hidden(args)
    _list_jobs(args)  # rejects a second experiment


def compose_jobs(args: argparse.Namespace) -> list[DictConfig]:
    """Compose and check the configs of all jobs, before any job starts."""
    return [job.cfg for job in _compose_jobs(args)]


def _compose_jobs(args: argparse.Namespace) -> list[CheckedConfig]:
    _check_first_key_parts(args)
    jobs = []
    with _initialize_hydra(args):
        for overrides in _list_jobs(args):
            with convert_errors(overrides):
                cfg = _compose_job(args, overrides)
            jobs.append(check(cfg))
            _reject_overrides_without_effect(jobs[-1].resolved, overrides)
    _check_texts(jobs[0].resolved, args.overrides)
    return jobs


def _check_first_key_parts(args: argparse.Namespace) -> None:
    if args.config_name or args.config_path:
        return
    keys = [spec.name for spec in dataclasses.fields(Config)]
    for override in parse_overrides(args.overrides):
        first = re.split(r"[./@]", override.key)[0]
        if first.isidentifier() and override.value is not None and first not in (*keys, "hydra", EXPERIMENT):
            raise InputError(describe_unknown_key(first, keys))


def _compose_job(args: argparse.Namespace, overrides: list[str]) -> DictConfig:
    """Compose a job's config; the result is identical to Hydra's. Group options are composed once for all
    jobs, since this takes 90 % of the time. With custom folders, Hydra composes each config."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    options = [
        override
        for override in parsed
        if not isinstance(override.value(), dict) and is_any_group(override.key_or_group)
    ]
    values = [override for override in parsed if override not in options]
    special = args.config_name or args.config_path or args.config_dir or any(plugins.list_config_folders())
    for one in values:
        special = special or one.type != OverrideType.CHANGE or one.package
        special = special or one.is_sweep_override() or one.is_hydra_override()
    if special:
        return compose(args.config_name or CONFIG, overrides)
    cfg: DictConfig = pickle.loads(_compose_options(*(str(override.input_line) for override in options)))
    for override in values:
        merge_override(cfg, override)
    return cfg


def merge_override(cfg: DictConfig, override: HydraOverride) -> None:
    """Set the key of an override in a config, with Hydra's error for a wrong key or value."""
    try:
        OmegaConf.update(cfg, override.key_or_group, override.value(), merge=True)
    except OmegaConfBaseException as error:
        raise ConfigCompositionException(f"Error merging override {override.input_line}") from error


@functools.lru_cache(maxsize=128)
def _compose_options(*options: str) -> bytes:
    return pickle.dumps(compose(CONFIG, list(options)))


def _reject_overrides_without_effect(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    for name in config["plugins"]:
        if name not in plugins.list_active():
            raise InputError(
                f"plugins=[{name}]: cannot be set in a config file; set it on the command line, in the base "
                f"of a sweep or search, or with {plugins.VARIABLE}={name}"
            )
    sources = (config["data"].get("sources") or {}).values()
    for override in parse_overrides(overrides):
        if override.key == "profile.lr" and config["optim"]["lr"] != config["profile"]["lr"]:
            model = config["model"]["name"]
            raise InputError(f"{override}: has no effect: model={model} sets optim.lr; set that")
        part = override.key.removeprefix("data.split.")
        own = [one.get(part) for one in sources] if part in ("test", "val") else [None]
        if own and None not in own:
            raise InputError(f"{override}: each source sets its own value; set data.sources.NAME.{part}")


def _check_texts(config: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Raise InputError for a text that Hydra would change: 2024_11 into 202411, or 1e3 into 1000.0."""
    values = flatten(config)
    for parsed in OverridesParser.create().parse_overrides(list(overrides)):
        value, kept = parsed.value(), values.get(parsed.key_or_group)
        texts = kept if isinstance(kept, list) else [kept]
        if not all(isinstance(text, str) for text in texts):
            continue
        typed = Override.parse(str(parsed.input_line))
        parts = re.split(r"[\[\],\s]+", typed.value or "")
        items = value.list if isinstance(value, ChoiceSweep) else value
        for item in items if isinstance(items, list) else [items]:
            if isinstance(item, int | float) and str(item) not in parts:
                quoted = join_command([make_override(typed.key, typed.value or "")])
                raise InputError(f"{typed}: would become {item}; quote the value: {quoted}")


HELP = """memmlp train trains, evaluates, exports and times one configuration.

== Configuration groups ==
Compose your configuration from these groups (GROUP=OPTION)

{groups}

== Config ==
Override any key of the config (KEY=VALUE)

{config}
memmlp train --hydra-help lists the flags, such as -m for several runs and --config-dir for custom configs.
"""


def format_help(args: argparse.Namespace) -> str:
    """Return the help text: all groups with their options, and the config that the arguments compose."""
    folders = [find_packaged_folder("conf"), *(folder for _, folder in plugins.list_config_folders())]
    if args.config_dir:
        folders.append(_find_folder(args.config_dir, "--config-dir"))
    options: dict[str, list[str]] = {}
    for folder in folders:
        for path in sorted(folder.rglob("*.yaml")):
            options.setdefault(path.parent.relative_to(folder).as_posix(), []).append(path.stem)
    for group in (*GROUPS, *ONLY):
        options.setdefault(group, []).extend(["default"] if group in ONLY else list_component_names(group))
    groups = [
        f"{name}: {', '.join(sorted(options[name]))}"
        for name in sorted(options.keys() - {".", "search"})
        if options[name]
    ]
    with _initialize_hydra(args), convert_errors(args.overrides):
        config = OmegaConf.to_yaml(compose(args.config_name or CONFIG, args.overrides), resolve=args.resolve)
    return HELP.format(groups="\n".join(groups), config=config)


@contextmanager
def _initialize_hydra(args: argparse.Namespace) -> Iterator[None]:
    _check_hidden(args)
    main = _find_folder(args.config_path or find_packaged_folder("conf"), "--config-path")
    folder = _find_folder(args.config_dir, "--config-dir") if args.config_dir else None
    with (
        plugins.search_folder(folder) if folder else nullcontext(),
        initialize_config_dir(str(main), job_name="train", version_base=VERSION_BASE),
    ):
        yield


def _check_hidden(args: argparse.Namespace) -> None:
    """Raise InputError for a custom config file that a component, or a file in an earlier folder, hides."""
    folders = plugins.list_config_folders()
    own = [folder for provider, folder in folders if provider == plugins.OWN]
    own += [_find_folder(args.config_dir, "--config-dir")] if args.config_dir else []
    others = [_find_folder(args.config_path or find_packaged_folder("conf"), "--config-path")]
    others += [folder for provider, folder in folders if provider != plugins.OWN]
    for folder in own:
        for path in sorted(folder.rglob("*.yaml")):
            option = path.relative_to(folder)
            if plugins.is_component(option):
                raise InputError(f"{path}: memmlp already has an option with this name; rename the file")
            for used in (other / option for other in others):
                if used.is_file() and used.read_bytes() != path.read_bytes():
                    raise InputError(f"{path}: Hydra would use {used} instead; rename the file")
            group = option.parent.as_posix()
            if path.stem == args.config_name if group == "." else is_any_group(group):
                _check_scalars(path)


def is_any_group(name: str) -> bool:
    """Return whether a config group has this name: one of components, or one of files."""
    return is_group(name) or (find_packaged_folder("conf") / name).is_dir()


def _check_scalars(path: Path) -> None:
    """Raise InputError for a text that YAML 1.1 reads as another value, such as 010 (8) and 10_01 (1001)."""
    with suppress(yaml.YAMLError, UnicodeDecodeError):  # Hydra's error names the file
        for token in yaml.scan(path.read_text(encoding="utf-8")):
            if not isinstance(token, yaml.ScalarToken) or not token.plain:
                continue
            if not re.fullmatch(r"[-+.:\w]+", text := token.value) or parse_config_yaml(text) != text:
                continue
            value = OmegaConf.create(f"[{text}]")[0]
            if value != text:
                line = token.start_mark.line + 1
                raise InputError(
                    f"{path}, line {line}: YAML reads {text} as {value}; write '{text}' or {value}"
                )


def _find_folder(name: str | Path, option: str) -> Path:
    if not Path(name).is_dir():
        raise InputError(f"{option} {name}: must be an existing folder")
    return Path(name).absolute()


def _list_jobs(args: argparse.Namespace) -> list[list[str]]:
    """Return the overrides of each job. Raises InputError for an override that cannot be parsed, or would
    replace another one: a second `experiment=`, or in a multirun a second override of a group's keys."""
    with convert_errors(args.overrides):
        parsed = OverridesParser.create().parse_overrides(args.overrides)
        chosen = list(dict.fromkeys(str(one.input_line) for one in parsed if one.key_or_group == EXPERIMENT))
        if len(chosen) > 1:
            raise InputError(f"{chosen[-1]}: would replace {chosen[0]}; combine them as {EXPERIMENT}=[A,B]")
        if not args.multirun and "hydra.mode=MULTIRUN" not in args.overrides:
            return [args.overrides]
        choices: dict[str, list[str]] = {}
        for override in parsed:
            key, sweeps = override.get_key_element(), override.is_sweep_override()
            if sweeps and not override.is_discrete_sweep():
                raise InputError(f"{override.input_line}: must be a list of values, a choice or a range")
            if before := [value for value in choices.get(key, ()) if value.startswith(f"{key}={{")]:
                how = f"in a multirun, set {key}.NAME=VALUE"
                raise InputError(f"{override.input_line}: would replace {before[0]}; {how}")
            values = override.sweep_string_iterator() if sweeps else [override.get_value_element_as_str()]
            choices[key] = [f"{key}={value}" for value in values]
        return [list(job) for job in itertools.product(*choices.values())]


@contextmanager
def convert_errors(overrides: Sequence[str]) -> Iterator[None]:
    """Raise InputError, in one line, for errors while these overrides are composed."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(explain_error(error, overrides)) from error
