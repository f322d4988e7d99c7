"""`memmlp tune`: search loss weights, or any config keys, by the validation errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import add_run_options, config_dir_option, overrides_argument
from memmlp.cli.workers import Workers, add_worker_options, start_fleet
from memmlp.common.components import find_chosen_settings
from memmlp.common.errors import InputError
from memmlp.common.files import digest, write_json
from memmlp.common.lease import Lock
from memmlp.common.overrides import Override
from memmlp.common.text_formats import join_command, make_console
from memmlp.config.compose_plan import make_tasks
from memmlp.config.plugins import activate, find_named_packages, format_config_dir
from memmlp.runs.identity import affects_training, select_inference_config, select_validation_config
from memmlp.sweep.plan import Plan, RunTask

if TYPE_CHECKING:
    from memmlp.sweep.search.search_file import Search, Value
    from memmlp.sweep.search.study import Study
    from memmlp.training.request import RunRequest


@click.command("tune")
@overrides_argument
@add_worker_options
@click.option("--status", is_flag=True, help="Only show the search's progress.")
@config_dir_option
@add_run_options
def tune(overrides: tuple[str, ...], workers: Workers, status: bool, outputs: Path) -> None:
    """Search the manual loss weights: first the paper's weights, then Optuna's proposals.

    OVERRIDES can be overrides of `memmlp train` for all trials, settings of the executor as in `memmlp
    sweep`, or settings of the search: `search.n_trials=50`, `search.seeds=3`,
    `search.objectives=[MPJPE,Jitter] search.pruner=none`, `search.tflop=5` for the same compute in each
    training, or `+search.space.optim.lr={low: 1e-4, high: 1e-2,
    log: true}`. `search=NAME` selects conf/search/NAME.yaml. A restarted search continues where it stopped.
    """
    from memmlp.config.compose import is_any_group
    from memmlp.sweep.search import results
    from memmlp.sweep.search.study import Study

    if workers.executor == "debug":  # the search would wait for trials in its own process
        raise InputError("executor=debug: expected local or slurm for a search")
    setup = prepare_search(overrides, outputs.absolute())
    if status:
        show(setup)
        return
    with Lock(setup.folder).hold():
        about = {**asdict(setup.search), "command_line": setup.command_line}
        write_json(setup.folder / "search.json", about)
        study = Study.open(setup.search, setup.folder.name, setup.folder)
        search(setup, study, workers)
        results.write_trials(study, setup.folder / "trials.csv")
        results.write_experiments(study, setup.folder, is_any_group)
    print_summary(setup, study)


class SearchSetup(NamedTuple):
    """A search with its folder, the overrides for all trials, and the folder of runs and caches."""

    search: Search
    command_line: tuple[str, ...]
    outputs: Path
    folder: Path

    def list_overrides(self, values: Mapping[str, Value]) -> list[str]:
        """Return a trial's overrides: those of the search file and the command line, then the trial's values.
        By default, trials are neither exported nor timed, and only evaluated on validation clips."""
        fixed = ["export.graph=off", *self.search.budget, *self.search.base]
        return [*fixed, *self.command_line, *self.search.overrides(values)]


def prepare_search(overrides: Sequence[str], outputs: Path) -> SearchSetup:
    from memmlp.config.compose import compose_plain
    from memmlp.sweep.search.search_file import Search, parse_search, read_best_trial

    activate(find_named_packages(overrides))
    own = [text for text in overrides if Override.parse(text).group == "search"]
    content = compose_plain("tune", own).get("search")
    if not isinstance(content, dict):
        raise InputError("search: must be the name of a file in conf/search")
    activate(find_named_packages(map(str, content.get("base") or ())))
    remaining = tuple(text for text in overrides if text not in own)
    _complete_kinematic_loss(content, [*(content.get("base") or ()), *remaining])
    best: dict[str, Value] = {}
    if isinstance(folder := content.get("after"), str):
        overrides_before, best = read_best_trial(Path(folder))
        content["base"] = [*overrides_before, *Search.overrides(best), *(content.get("base") or ())]
    parsed = parse_search(content, best)
    setup = SearchSetup(parsed, remaining, outputs, outputs / "tune" / parsed.name)
    base = _check_space(setup)
    if not _make_requests(setup, {})[0].motion.prepare().has("val"):
        raise InputError("data.split.val: must be above 0 for a search, which ranks trials on validation")
    counted = {**asdict(parsed), "n_trials": None, "after": None, "storage": None}
    return setup._replace(folder=outputs / "tune" / f"{parsed.name}-{digest([base, counted])[:8]}")


def _complete_kinematic_loss(content: dict[str, Any], overrides: Sequence[str]) -> None:
    """Replace the choice `kinematic` of the loss by the network's own overrides for it."""
    from memmlp.config.compose import compose_config

    match content:
        case {"space": {"loss": {"choices": [*choices]}}} if "kinematic" in choices:
            settings = find_chosen_settings(compose_config(list(overrides)), "model")
            full = getattr(settings, "kinematic", "kinematic")
            content["space"]["loss"]["choices"] = [full if one == "kinematic" else one for one in choices]


def _check_space(setup: SearchSetup) -> str:
    """Check the ranges of a search, and return a text with everything that affects the results of its trials:
    the first trial's run, its validation interval, its inference settings, and the component versions at the
    limits of the space. The search's folder is named by its digest."""
    space = setup.search.space
    for override in map(Override.parse, setup.command_line):
        if override.key in {one.key for one in space}:
            raise InputError(
                f"{override}: is searched; remove it from the space with search.space.{override.key}=null"
            )
    requests = [_make_requests(setup, {})[0]]
    for number in range(max(len(one.list_corners()) for one in space)):
        corner = {one.key: one.list_corners()[number % len(one.list_corners())] for one in space}
        try:
            requests.append(_make_requests(setup, corner)[0])
        except InputError as error:
            raise InputError(f"search.space: {error}") from None
    configs = [request.config for request in requests]
    first_validation, *others = map(select_validation_config, configs)
    for other in others:
        changed = [key for key in first_validation | other if first_validation.get(key) != other.get(key)]
        if changed:
            raise InputError(
                f"search.space: {min(changed)} changes the validation clips of the trials; keys of data must "
                "be weighting, mirror, split.train_fraction or sources.NAME.weight"
            )
    for one in space:
        # Some keys change the training only at values other than 0.
        counts = any(affects_training(one.key, config) for config in configs)
        if not isinstance(configs[0].get(one.key), Mapping) and not counts:
            raise InputError(f"search.space.{one.key}: does not change the training")
    first = _make_tasks(setup, next(iter(setup.search.list_first_trials()), {}))[0][-1]
    validated = [first.config["optim"][key] for key in ("validate_every", "validation_pieces")]
    often = f"validated every {validated[0]} steps on {validated[1]} pieces"  # trials can be pruned then
    trained = digest([one.identity("").id for one in requests])  # also of components at the limits
    return f"{first.id}, {often}, used with {select_inference_config(first.config)}, trained with {trained}"


def _make_tasks(setup: SearchSetup, values: Mapping[str, Value]) -> list[Sequence[RunTask]]:
    requests = _make_requests(setup, values)
    return [make_tasks(request, request.motion.prepare().digest) for request in requests]


def _make_requests(setup: SearchSetup, values: Mapping[str, Value]) -> list[RunRequest]:
    from memmlp.config.build_request import build_requests
    from memmlp.config.compose import compose_checked

    checked = compose_checked(setup.list_overrides(values))
    first = checked.resolved["seed"]
    return list(build_requests(checked, setup.outputs, range(first, first + setup.search.seeds)))


def show(setup: SearchSetup) -> None:
    from memmlp.sweep.search.progress_table import render
    from memmlp.sweep.search.study import Study

    study = Study.view(setup.search, setup.folder.name, setup.folder)
    make_console().print(render(study, setup.outputs) if study else "not started")


def search(setup: SearchSetup, study: Study, workers: Workers) -> None:
    from memmlp.sweep.search.director import Director, run_search
    from memmlp.sweep.search.progress_table import SearchBoard

    plan = Plan(setup.folder.name, setup.outputs, (), (), open=True)
    base = _make_requests(setup, {})[0]
    digest_at_start = base.motion.prepare().digest

    def check() -> None:
        if base.motion.prepare().digest != digest_at_start:
            raise InputError(
                f"{base.motion.clips.root}: clips have changed since the search started; restore them, or "
                "start a new search"
            )

    director = Director(study, partial(_make_tasks, setup), plan, check)
    path, fleet = start_fleet(setup.folder, plan, workers, {base.config["device"]})
    run_search(director, fleet, SearchBoard(setup.outputs), path)


def print_summary(setup: SearchSetup, study: Study) -> None:
    """Print the best trials and the next command. Exits with 1 if no trial is complete."""
    from rich.text import Text

    from memmlp.sweep.search.progress_table import (
        add_row,
        describe_counts,
        format_objectives,
        make_trials_table,
    )
    from memmlp.sweep.search.results import (
        IMPORTANCE,
        compute_importances,
        explain_missing_importances,
        find_boundary_warnings,
    )
    from memmlp.sweep.search.study import get_values
    from memmlp.training.request import describe_missing_data

    console = make_console()
    best = study.list_best()
    if best:
        title = "Pareto front" if len(study.search.objectives) > 1 else "best trial"
        table = make_trials_table(study.search, f"{title}, validation errors")
        for trial in best:
            add_row(table, study.search, trial, Text(format_objectives(trial)))
        console.print(table)
    if found := compute_importances(study.study):
        click.echo(f"importance, {IMPORTANCE}: {', '.join(f'{key} {share:.2f}' for key, share in found)}")
    elif few := explain_missing_importances(study.study):
        click.echo(f"importance: {few}")
    for line in find_boundary_warnings(study.study):
        click.echo(line)
    click.echo(describe_counts(study))
    request = _make_requests(setup, {})[0]
    if part := describe_missing_data(request.config, request.motion.prepare()):
        click.echo(f"incomplete data: {part}")
    click.echo(f"in {setup.folder}")
    if best:
        unmeasured = 2 if setup.search.budget else 1  # the first overrides leave out export and evaluation
        words = setup.list_overrides(get_values(best[0], setup.search))[unmeasured:]
        click.echo("next: " + join_command(["memmlp", "train", *format_config_dir(), *words]))
    else:
        reasons = [trial.user_attrs["reason"] for trial in study.trials if "reason" in trial.user_attrs]
        click.echo(f"no trial is complete; last failure: {(reasons or ['NaN errors'])[-1]}")
        raise SystemExit(1)
