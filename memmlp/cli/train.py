"""`memmlp train`: a Hydra application that reports config errors in one line before anything runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import click
import hydra
from omegaconf import DictConfig

from memmlp.common import distributed
from memmlp.common.errors import InputError, LeaseLost, RunStopped, TrainingDiverged, is_interruption
from memmlp.common.files import find_packaged_folder
from memmlp.common.overrides import notify_repeats, parse_overrides
from memmlp.config.check import explain_error
from memmlp.config.compose import (
    CONFIG,
    VERSION_BASE,
    check_overrides,
    compose_jobs,
    format_help,
    format_hydra_arguments,
    parse_hydra_arguments,
)

if TYPE_CHECKING:
    from memmlp.training.request import Outcome


@click.command(
    "train",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    add_help_option=False,
)
@click.argument("hydra_arguments", nargs=-1, type=click.UNPROCESSED)
def command(hydra_arguments: Sequence[str]) -> None:
    """Train, evaluate, export and time one configuration."""
    train(list(hydra_arguments))


def train(argv: Sequence[str], job: Callable[[DictConfig], object] | None = None) -> None:
    """Run the jobs that the arguments of `memmlp train` describe, by default with `run_training`. Raises
    InputError for bad input. If several jobs fail, the last failure is raised; the others are printed."""
    args = parse_hydra_arguments(argv)
    only_prints = any((args.hydra_help, args.cfg, args.info, args.shell_completion))
    if args.help or args.cfg:
        check_overrides(args)
    if args.help:
        click.echo(format_help(args))
        return
    jobs = [] if only_prints else compose_jobs(args)
    if len(jobs) > 1 and distributed.world_size() > 1:
        raise InputError("torchrun: several processes train one run; start it without --multirun")
    _check_prediction_folders(jobs)
    notify_repeats(args.overrides)
    failures: list[Exception] = []
    train_from_config = _collect_failures(job or run_training, failures)
    keys = [override.key for override in parse_overrides(args.overrides)]
    has_hydra_keys = any(key.startswith(("hydra.", "hydra/")) for key in keys)
    if only_prints or args.multirun or args.config_name or has_hydra_keys:  # needs Hydra's launchers or keys
        _run_with_hydra(args, train_from_config)
    else:
        train_from_config(jobs[0])
    for failure in failures[:-1]:
        print(f"memmlp: {failure}", file=sys.stderr)
    if failures:
        raise failures[-1]


def _run_with_hydra(args: argparse.Namespace, train_from_config: Callable[[DictConfig], None]) -> None:
    """Run or print the jobs with Hydra, which reads its arguments from `sys.argv`."""
    folder = str(find_packaged_folder("conf"))
    main = hydra.main(config_path=folder, config_name=CONFIG, version_base=VERSION_BASE)
    os.environ["HYDRA_FULL_ERROR"] = "1"
    argv, sys.argv = sys.argv, ["memmlp train", *format_hydra_arguments(args)]
    try:
        main(train_from_config)()
    except Exception as error:
        if args.cfg or type(error).__module__.split(".")[0] in ("hydra", "omegaconf"):
            raise InputError(explain_error(error, args.overrides)) from error
        raise
    finally:
        sys.argv = argv


def _check_prediction_folders(jobs: Sequence[DictConfig]) -> None:
    """Raise InputError if save_predictions is empty, or several jobs would save predictions in one folder."""
    if any(cfg.save_predictions is not None and not cfg.save_predictions.strip() for cfg in jobs):
        raise InputError("save_predictions=: must be a folder, or null to save none")
    folders = [cfg.save_predictions for cfg in jobs if cfg.save_predictions]
    for folder in folders:
        if folders.count(folder) > 1:
            raise InputError(
                f"save_predictions={folder}: {folders.count(folder)} jobs would overwrite each other; "
                "give each its own folder, such as predictions/${seed}"
            )


def _collect_failures(
    job: Callable[[DictConfig], object], failures: list[Exception]
) -> Callable[[DictConfig], None]:
    """Wrap the job: expected failures are appended to `failures`, so the other jobs of a multirun still run.
    In processes of a launcher, failures are raised, and Hydra passes the first one on."""
    collector = os.getpid()

    def train_from_config(cfg: DictConfig) -> None:
        try:
            job(cfg)
        except (InputError, TrainingDiverged, LeaseLost, RunStopped, OSError) as failure:
            if os.getpid() != collector or is_interruption(failure):
                raise
            failures.append(failure)

    return train_from_config


def run_training(cfg: DictConfig) -> Outcome | None:
    """Finish a config's run, and print the results. Return None in additional processes of torchrun."""
    from memmlp.cli.train_summary import show
    from memmlp.config.build_request import build_request
    from memmlp.training.request import find_finished_outcome

    outcome = None
    if distributed.world_size() == 1:
        outcome = find_finished_outcome(build_request(cfg))  # needs no torch
    if outcome is None:
        from memmlp.config.build import build_experiment
        from memmlp.training.devices import use_threads
        from memmlp.training.run_stages import run_in_processes

        use_threads(cfg.threads)
        outcome = run_in_processes(build_experiment(cfg))
    if outcome:
        show(outcome)
    return outcome
