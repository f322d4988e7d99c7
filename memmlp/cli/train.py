"""`memmlp train`: a Hydra application whose errors are one line."""

from __future__ import annotations

import dataclasses
import difflib
import os
import re
import sys
from functools import partial
from pathlib import Path

import click
import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

import memmlp
from memmlp.cli import schema
from memmlp.errors import InputError, TrainingDiverged


@click.command("train", add_help_option=False, context_settings={"ignore_unknown_options": True})
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def command(arguments: tuple[str, ...]) -> None:
    """Train one configuration; --help shows the groups and keys."""
    train(list(arguments))


def config_folder() -> Path:
    """conf/ of the checkout, or its copy in the installed package."""
    package = Path(memmlp.__file__).parent
    installed = package / "_conf"
    return installed if installed.is_dir() else package.parent / "conf"


def train(arguments: list[str]) -> None:
    """Run the Hydra application on command-line arguments; bad ones raise InputError.

    In a multirun every job gets its turn, and the first failure is raised at the end.
    """
    schema.register()
    failures: list[Exception] = []
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises instead of printing, and we print
    before, sys.argv = sys.argv, ["memmlp train", *arguments]
    application = hydra.main(version_base="1.3", config_path=str(config_folder()), config_name="train")
    try:
        application(partial(_job, failures))()
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(explain(error)) from error
    finally:
        sys.argv = before
    if failures:
        raise failures[0]


def _job(failures: list[Exception], cfg: DictConfig) -> None:
    """One job; its failure is kept, for Hydra would add lines of its own."""
    from memmlp.cli.build import run_training

    try:
        run_training(cfg)
    except (InputError, TrainingDiverged) as error:
        failures.append(error)


def explain(error: BaseException) -> str:
    """A composition error in one line that names the key and what is allowed."""
    whole = "\n".join(_chain(error))
    key = re.search(r"Could not override '([^'@]+)|full_key: (\S+)", whole)
    name = next(filter(None, key.groups())) if key else ""
    if unknown := re.search(r"Key '[^']*' (?:is )?not in '(\w+)'", whole):
        return _unknown_key(name, getattr(schema, unknown[1], schema.Config))
    if option := re.search(MISSING_OPTION, whole):
        return f"{option[1]}={option[2]}: no such option; allowed: {', '.join(option[3].split())}"
    if value := re.search(r"Value '(.*)' of type '.*' could not be converted to (\w+)", whole):
        return f"{name}={value[1]}: not allowed; needed is {KINDS.get(value[2], value[2])}"
    first = " ".join(str(error).split("full_key")[0].split())
    return f"{name}: {first}" if name and name not in first else first


MISSING_OPTION = r"Could not find '(.+)/([^/]+)'\s+Available options in '.+':((?:\s+\S+)+?)\s+Config"
KINDS = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false"}


def _chain(error: BaseException | None) -> list[str]:
    """The texts of an error and of what it came from."""
    return [str(error), *_chain(error.__cause__ or error.__context__)] if error else []


def _unknown_key(key: str, kind: type) -> str:
    """What is allowed beside a key that is not, in the schema of its group."""
    own = key.rpartition(".")[2]
    allowed = [field.name for field in dataclasses.fields(kind) if not field.name.startswith("_")]
    near = difflib.get_close_matches(own, allowed, 1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"{key}: no such key{hint}; allowed: {', '.join(allowed) or 'none with this option'}"
