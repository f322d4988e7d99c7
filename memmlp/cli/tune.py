"""`memmlp tune`: search loss weights, or any config keys, by the errors on validation."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import outputs_option, plugins_option
from memmlp.cli.workers import Workers, hire, worker_options
from memmlp.common.errors import InputError
from memmlp.common.lease import Lock
from memmlp.common.overrides import Override

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

    from memmlp.sweep.plan import RunTask
    from memmlp.sweep.search.search_file import Search, Value
    from memmlp.sweep.search.study import Study
    from memmlp.training.request import RunRequest


@click.command("tune")
@click.argument("overrides", nargs=-1)
@worker_options
@click.option("--status", is_flag=True, help="Show how far the search is, and run nothing.")
@click.option(
    "--config-dir",
    type=click.Path(path_type=Path),
    help="Folder of your own configs, searched beside memmlp's; it may name classes of yours.",
)
@plugins_option
@outputs_option
def tune(
    overrides: tuple[str, ...], workers: Workers, status: bool, config_dir: Path | None, outputs: Path
) -> None:
    """Search the manual loss weights: the paper's first, then what Optuna proposes.

    OVERRIDES are those of `memmlp train` for all trials, those of the search (`search.n_trials=50`,
    `search.seeds=3`, `search.objectives=[MPJPE,Jitter] search.pruner=none`, `+search.space.optim.lr={low:
    1e-4, high: 1e-2, log: true}`; `search=NAME` takes conf/search/NAME.yaml), and the executor's of `memmlp
    sweep`. Started again, it goes on where it stopped.
    """
    from memmlp.common.files import write_json
    from memmlp.sweep.search.study import Study

    if workers.executor == "debug":  # it would wait in this process for its own trials
        raise InputError("executor=debug: allowed of a search is local, slurm, ray or dask")
    setup = prepare_search(overrides, config_dir, outputs.absolute())
    if status:
        show(setup)
        return
    lock = Lock(setup.folder)
    lock.settle()
    with lock.hold(wait=False) as mine:
        if not mine:
            raise InputError(f"search {setup.folder.name}: in use by {lock.holder}; --status shows it")
        write_json(setup.folder / "search.json", asdict(setup.search))
        study = Study.opened(setup.search, setup.folder.name, setup.folder)
        search(setup, study, workers)
        write_results(setup, study)
    summary(setup, study)


class Setup(NamedTuple):
    """A search, its folder, and the settings of its trials' runs.

    Attributes:
        search: the parsed search.
        words: the command line's overrides for all trials.
        outputs: the folder of runs and caches.
        folder: the folder of the search.
        config_dir: a folder of the user's own configs; None for none.
    """

    search: Search
    words: tuple[str, ...]
    outputs: Path
    folder: Path
    config_dir: Path | None

    def overrides(self, values: Mapping[str, Value]) -> list[str]:
        """Return a trial's overrides: the search's base, the command line's, and the trial's values.

        Trials are judged on validation alone; they are exported and timed only if that is asked for.
        """
        return ["export.graph=off", *self.search.base, *self.words, *self.search.overrides(values)]


def prepare_search(words: Sequence[str], config_dir: Path | None, outputs: Path) -> Setup:
    """Return the search of a command line, with keys and ranges checked against the config.

    Raises:
        InputError: if a key is wrong; the message names it.
    """
    from memmlp.common.files import digest
    from memmlp.config.plugins import activate, named
    from memmlp.sweep.search.search_file import parse_search

    activate(named(words))
    own = [word for word in words if Override.parse(word).group == "search"]
    rest = tuple(word for word in words if word not in own)
    content = _search_config(own, config_dir)
    activate(named(map(str, content.get("base") or ())))
    wanted = parse_search(content)
    setup = Setup(wanted, rest, outputs, outputs / "tune" / wanted.name, config_dir)
    base = _check_space(setup)
    counted = {**asdict(wanted), "n_trials": None, "storage": None}
    if wanted.seeds == 1:
        del counted["seeds"]  # so that searches from before this key keep their folder
    return setup._replace(folder=outputs / "tune" / f"{wanted.name}-{digest([base, counted])[:8]}")


def _search_config(words: Sequence[str], config_dir: Path | None) -> dict[str, Any]:
    """Compose only the part of the config that describes the search."""
    from memmlp.config.compose import composed_plain

    found = composed_plain("tune", words, config_dir).get("search")
    if not isinstance(found, dict):
        raise InputError("search: has no value; allowed is the name of a file in conf/search")
    return found


def _check_space(setup: Setup) -> str:
    """Check the ranges of a search, and describe what a trial's numbers depend on.

    Returns:
        A text that names the first trial's run, its interval of validations, how its network is used, and
        with what, by which recipes, the ends of the space are trained. It is part of the digest in the name
        of the search's folder, so that another config or other data makes another search.

    Raises:
        InputError: if a searched key is set on the command line or does not change the training, or if the
            config refuses a value.
    """
    from memmlp.common.files import digest
    from memmlp.runs.identity import changes_training, inference

    space = setup.search.space
    for word in setup.words:
        if Override.parse(word).key in {one.key for one in space}:
            raise InputError(f"{word}: is searched; leave it out of the space with search.space....=null")
    requests = [_requests(setup, {})[0]]
    for number in range(max(len(one.corners()) for one in space)):
        corner = {one.key: one.corners()[number % len(one.corners())] for one in space}
        try:
            requests.append(_requests(setup, corner)[0])
        except InputError as error:
            raise InputError(f"search.space: {error}") from None
    configs = [request.config for request in requests]
    _check_validation(configs)
    for one in space:
        # Some change it at other values than 0.
        counts = any(changes_training(one.key, config) for config in configs)
        if not isinstance(configs[0].get(one.key), Mapping) and not counts:
            raise InputError(f"search.space: {one.key}: changes no training; allowed are keys that do")
    first = _tasks(setup, next(iter(setup.search.first_trials()), {}))[0][-1]
    often = f"validated every {first.config['optim']['validate_every']} steps"  # when trials may be pruned
    trained = digest([one.identity("").id for one in requests])  # what the first trial need not have
    return f"{first.id}, {often}, used with {inference(first.config)}, trained with {trained}"


def _check_validation(configs: Sequence[Mapping[str, Any]]) -> None:
    """Raise InputError if the trials of a space would be judged by different validation clips."""
    from memmlp.runs.identity import validated_on

    first = validated_on(configs[0])
    for config in configs[1:]:
        other = validated_on(config)
        for key in sorted(first.keys() | other.keys()):
            if first.get(key) != other.get(key):
                raise InputError(
                    f"search.space: {key} changes which clips the trials are judged by; allowed of data are "
                    "weighting, mirror, split.train_fraction and sources.NAME.weight"
                )


def _tasks(setup: Setup, values: Mapping[str, Value]) -> list[Sequence[RunTask]]:
    """Return the runs of a trial with these values, as a list of tasks for each seed; prepares the data."""
    from memmlp.config.compose_plan import tasks_of

    requests = _requests(setup, values)
    return [tasks_of(request, request.motion.prepare().digest) for request in requests]


def _requests(setup: Setup, values: Mapping[str, Value]) -> list[RunRequest]:
    """Return the checked requests of a trial: one for the config's seed, and one for each further seed."""
    from memmlp.config.build_request import build_request
    from memmlp.config.compose import composed

    own = ["--config-dir", str(setup.config_dir)] if setup.config_dir else []
    cfg = composed([*own, *setup.overrides(values)])
    cfg.paths.outputs = str(setup.outputs)
    first, found = cfg.seed, []
    for number in range(setup.search.seeds):
        cfg.seed = first + number
        found.append(build_request(cfg))
    return found


def show(setup: Setup) -> None:
    """Print the progress of the search."""
    from rich.console import Console

    from memmlp.sweep.search.progress_table import render
    from memmlp.sweep.search.study import Study

    study = Study.view(setup.search, setup.folder.name, setup.folder)
    Console(highlight=False).print(render(study, setup.outputs) if study else "not begun")


def search(setup: Setup, study: Study, workers: Workers) -> None:
    """Run the study until it has as many trials as are wanted."""
    from memmlp.sweep.plan import Plan
    from memmlp.sweep.search.director import Director, direct
    from memmlp.sweep.search.progress_table import SearchBoard

    plan = Plan(setup.folder.name, setup.outputs, (), (), open=True)
    base = _requests(setup, {})[0]
    check = partial(_check_same_clips, base, base.motion.prepare().digest)
    director = Director(study, partial(_tasks, setup), plan, check)
    path, fleet = hire(setup.folder, plan, workers, {base.config["device"]})
    direct(director, fleet, SearchBoard(setup.outputs), path)


def _check_same_clips(base: RunRequest, digest: str) -> None:
    """Raise InputError if the data has another digest now, so that further trials would be judged by it."""
    if base.motion.prepare().digest != digest:
        raise InputError(
            f"{base.motion.clips.root}: its clips changed since the search began; put them back, or start "
            "the search again, which begins another one"
        )


def write_results(setup: Setup, study: Study) -> None:
    """Write the results of the search into its folder."""
    from memmlp.config.package_data import packaged
    from memmlp.runs.identity import option_in_slot
    from memmlp.sweep.search import results

    results.write_trials(study, setup.folder / "trials.csv")
    groups = [path.name for path in packaged("conf").iterdir() if path.is_dir()]
    results.write_experiments(study, setup.folder, groups)
    model = option_in_slot(_requests(setup, {})[0].config, "model")
    if model in (None, "mem_mlp"):  # Table 5 is about this network
        table = f"table{results.TABLE:02d}.yaml"
        results.write_table(study, packaged("sweeps") / table, setup.folder / table, setup.words)
    results.write_plots(study, setup.folder)


def summary(setup: Setup, study: Study) -> None:
    """Print the best trials, the importance of the keys, where the files are, and the next command.

    Exits with 1 if no trial is complete.
    """
    from rich.console import Console
    from rich.text import Text

    from memmlp.sweep.search.progress_table import counts, figures, row, trials_table
    from memmlp.sweep.search.results import IMPORTANCE, at_an_end, importances, too_few_trials
    from memmlp.training.data_remarks import partial_words

    console = Console(highlight=False)
    best = study.best()
    if best:
        title = "Pareto front" if len(study.search.objectives) > 1 else "best trial"
        table = trials_table(study.search, f"{title}, errors on validation")
        for trial in best:
            row(table, study.search, trial, Text(figures(trial)))
        console.print(table)
    if found := importances(study):
        click.echo(f"importance, {IMPORTANCE}: {', '.join(f'{key} {share:.2f}' for key, share in found)}")
    elif few := too_few_trials(study.study):
        click.echo(f"importance: {few}")
    for line in at_an_end(study.study):
        click.echo(line)
    click.echo(counts(study))
    request = _requests(setup, {})[0]
    if part := partial_words(request.config, request.motion.prepare()):
        click.echo(f"on a part of the data: {part}")
    click.echo(f"in {setup.folder}")
    if best:
        click.echo(f"next: memmlp train {shlex.join(training(setup, best[0]))}")
    else:
        reasons = [trial.user_attrs["reason"] for trial in study.trials if "reason" in trial.user_attrs]
        click.echo(
            f"no trial is complete; the last failure: {(reasons or ['errors that are no numbers'])[-1]}"
        )
        raise SystemExit(1)


def training(setup: Setup, trial: FrozenTrial) -> list[str]:
    """Return what `memmlp train` needs to make a trial's run.

    That is the experiment that was written of it, or, where that makes another run (an experiment of the
    base's or of the command line's chooses something else), its settings word by word.
    """
    from memmlp.sweep.search.study import values

    short = ["--config-dir", str(setup.folder), "experiment=best", *setup.words]
    if _makes(setup, short, trial.user_attrs["runs"][0]):
        return short
    own = ["--config-dir", str(setup.config_dir)] if setup.config_dir else []
    return [*own, *setup.overrides(values(trial, setup.search))[1:]]


def _makes(setup: Setup, words: Sequence[str], run_id: str) -> bool:
    """Return whether `memmlp train` with these words makes the run with that id."""
    from memmlp.config.build_request import build_request
    from memmlp.config.compose import composed

    try:
        cfg = composed(words)
        cfg.paths.outputs = str(setup.outputs)
        request = build_request(cfg)
        return request.identity(request.motion.prepare().digest).id == run_id
    except InputError:
        return False
