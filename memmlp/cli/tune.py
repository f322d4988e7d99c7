"""`memmlp tune`: search loss weights, or any config keys, by the validation errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import PATH, outputs_option, plugins_option
from memmlp.cli.workers import Workers, add_worker_options, start_fleet
from memmlp.common.errors import InputError
from memmlp.common.lease import Lock
from memmlp.common.overrides import Override
from memmlp.common.text_formats import join_command

if TYPE_CHECKING:
    from memmlp.sweep.plan import RunTask
    from memmlp.sweep.search.search_file import Search, Value
    from memmlp.sweep.search.study import Study
    from memmlp.training.request import RunRequest


@click.command("tune")
@click.argument("overrides", nargs=-1)
@add_worker_options
@click.option("--status", is_flag=True, help="Only show the search's progress.")
@click.option("--config-dir", type=PATH, help="Folder of more configs; they can name your own classes.")
@plugins_option
@outputs_option
def tune(
    overrides: tuple[str, ...], workers: Workers, status: bool, config_dir: Path | None, outputs: Path
) -> None:
    """Search the manual loss weights: first the paper's weights, then Optuna's proposals.

    OVERRIDES can be overrides of `memmlp train` for all trials, settings of the executor as in `memmlp
    sweep`, or settings of the search: `search.n_trials=50`, `search.seeds=3`,
    `search.objectives=[MPJPE,Jitter] search.pruner=none`, `search.tflop=5` for the same compute in each
    training, or `+search.space.optim.lr={low: 1e-4, high: 1e-2,
    log: true}`. `search=NAME` selects conf/search/NAME.yaml. A restarted search continues where it stopped.
    """
    from memmlp.common.files import write_json
    from memmlp.sweep.search.study import Study

    if workers.executor == "debug":  # the search would wait for trials in its own process
        raise InputError("executor=debug: expected local or slurm for a search")
    setup = prepare_search(overrides, config_dir, outputs.absolute())
    if status:
        show(setup)
        return
    with Lock(setup.folder).hold():
        about = {**asdict(setup.search), "command_line": setup.command_line}
        write_json(setup.folder / "search.json", about)
        study = Study.open(setup.search, setup.folder.name, setup.folder)
        search(setup, study, workers)
        write_results(setup, study)
    print_summary(setup, study)


class SearchSetup(NamedTuple):
    """A search, its folder, and the settings of its runs: the command line's overrides for all trials, the
    folder of runs and caches, and a folder of custom configs, or None."""

    search: Search
    command_line: tuple[str, ...]
    outputs: Path
    folder: Path
    config_dir: Path | None

    def list_overrides(self, values: Mapping[str, Value]) -> list[str]:
        """Return a trial's overrides: those of the search file and the command line, then the trial's values.
        By default, trials are neither exported nor timed, and only evaluated on validation clips."""
        fixed = ["export.graph=off", *self.search.budget, *self.search.base]
        return [*fixed, *self.command_line, *self.search.overrides(values)]

    @property
    def config_options(self) -> list[str]:
        """The command-line options for the custom configs."""
        return ["--config-dir", str(self.config_dir)] if self.config_dir else []


def prepare_search(overrides: Sequence[str], config_dir: Path | None, outputs: Path) -> SearchSetup:
    """Return the search of a command line. Raises InputError if a key or range does not fit the config."""
    from memmlp.common.files import digest
    from memmlp.config.compose import compose_plain
    from memmlp.config.plugins import activate, find_named_packages
    from memmlp.sweep.search.search_file import Search, parse_search, read_best_trial

    activate(find_named_packages(overrides))
    own = [text for text in overrides if Override.parse(text).group == "search"]
    content = compose_plain("tune", own, config_dir).get("search")
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
    setup = SearchSetup(parsed, remaining, outputs, outputs / "tune" / parsed.name, config_dir)
    base = _check_space(setup)
    if not _make_requests(setup, {})[0].motion.prepare().has("val"):
        raise InputError("data.split.val: must be above 0 for a search, which ranks trials on validation")
    counted = {**asdict(parsed), "n_trials": None, "after": None, "storage": None}
    return setup._replace(folder=outputs / "tune" / f"{parsed.name}-{digest([base, counted])[:8]}")


def _complete_kinematic_loss(content: dict[str, Any], overrides: Sequence[str]) -> None:
    """Replace the choice `kinematic` of the loss by the network's own overrides for it."""
    from memmlp.common.components import find_chosen_settings
    from memmlp.config.compose import compose_config

    match content:
        case {"space": {"loss": {"choices": [*choices]}}} if "kinematic" in choices:
            settings = find_chosen_settings(compose_config(list(overrides)), "model")
            full = getattr(settings, "kinematic", "kinematic")
            content["space"]["loss"]["choices"] = [full if one == "kinematic" else one for one in choices]


def _check_space(setup: SearchSetup) -> str:
    """Check the ranges of a search, and return a text with everything that affects the results of its trials:
    the first trial's run, its validation interval, its inference settings, and the component versions at the
    limits of the space. The folder name of the search contains a digest of this text, so a search with
    another config or data has another folder. Raises InputError if a searched key is set on the command line
    or does not affect training, or if the config rejects a value."""
    from memmlp.common.files import digest
    from memmlp.runs.identity import affects_training, select_inference_config, select_validation_config

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
    first_validation = select_validation_config(configs[0])
    for config in configs[1:]:
        other = select_validation_config(config)
        for key in sorted(first_validation.keys() | other.keys()):
            if first_validation.get(key) != other.get(key):
                raise InputError(
                    f"search.space: {key} changes the validation clips of the trials; keys of data must be "
                    "weighting, mirror, split.train_fraction or sources.NAME.weight"
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
    from memmlp.config.compose_plan import make_tasks

    requests = _make_requests(setup, values)
    return [make_tasks(request, request.motion.prepare().digest) for request in requests]


def _make_requests(setup: SearchSetup, values: Mapping[str, Value]) -> list[RunRequest]:
    from memmlp.config.build_request import build_requests
    from memmlp.config.compose import compose_checked

    checked = compose_checked([*setup.config_options, *setup.list_overrides(values)])
    first = checked.resolved["seed"]
    return list(build_requests(checked, setup.outputs, range(first, first + setup.search.seeds)))


def show(setup: SearchSetup) -> None:
    """Print the progress of the search."""
    from memmlp.common.text_formats import make_console
    from memmlp.sweep.search.progress_table import render
    from memmlp.sweep.search.study import Study

    study = Study.view(setup.search, setup.folder.name, setup.folder)
    make_console().print(render(study, setup.outputs) if study else "not started")


def search(setup: SearchSetup, study: Study, workers: Workers) -> None:
    """Run the study until it has all trials of the search."""
    from memmlp.sweep.plan import Plan
    from memmlp.sweep.search.director import Director, run_search
    from memmlp.sweep.search.progress_table import SearchBoard

    plan = Plan(setup.folder.name, setup.outputs, (), (), open=True)
    base = _make_requests(setup, {})[0]
    digest = base.motion.prepare().digest

    def check() -> None:
        """Raise InputError if the data has changed, because further trials would be judged on other clips."""
        if base.motion.prepare().digest != digest:
            raise InputError(
                f"{base.motion.clips.root}: clips have changed since the search started; restore them, or "
                "start a new search"
            )

    director = Director(study, partial(_make_tasks, setup), plan, check)
    path, fleet = start_fleet(setup.folder, plan, workers, {base.config["device"]})
    run_search(director, fleet, SearchBoard(setup.outputs), path)


def write_results(setup: SearchSetup, study: Study) -> None:
    """Write the results of the search into its folder."""
    from memmlp.common.files import find_packaged_folder
    from memmlp.sweep.search import results

    results.write_trials(study, setup.folder / "trials.csv")
    groups = [path.name for path in find_packaged_folder("conf").iterdir() if path.is_dir()]
    results.write_experiments(study, setup.folder, groups)


def print_summary(setup: SearchSetup, study: Study) -> None:
    """Print the best trials, the importance of the keys, the folder, and the next command. Exits with 1 if no
    trial is complete."""
    from rich.text import Text

    from memmlp.common.text_formats import make_console
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
        click.echo("next: " + join_command(["memmlp", "train", *setup.config_options, *words]))
    else:
        reasons = [trial.user_attrs["reason"] for trial in study.trials if "reason" in trial.user_attrs]
        click.echo(f"no trial is complete; last failure: {(reasons or ['NaN errors'])[-1]}")
        raise SystemExit(1)
