"""The results of a search: its trials as CSV, the best as experiments, and plots."""

from __future__ import annotations

import csv
import io
import itertools
import math
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.trial import FrozenTrial, TrialState

from memmlp.common.errors import import_optional
from memmlp.common.files import atomic_write
from memmlp.common.overrides import select_last_by_key
from memmlp.sweep.search.study import Study, deviations, reason, trial_values

IMPORTANCE = "by which keys the best tenth of the trials differs"
ENOUGH_TRIALS = 25
"""From so many complete trials on a tenth of them is more than two, and importance more than chance.

Of three keys, one of which acts, it ranks that one first in 95 % of random searches of 25 trials, in 78 % of
those of 20, in 45 % of those of 10.
"""


def write_trials(study: Study, path: Path) -> None:
    """Write all trials to a CSV file: number, state, objectives, values, runs, and the reason of a failure.

    With several seeds the objectives are means, followed by each objective's standard deviation and by the
    values of the single seeds. A pruned trial has no value: the value of an
    earlier step is not a result, and stands in the reason.
    """
    search = study.search
    names, keys = [one.text for one in search.objectives], [one.key for one in search.space]
    seeds = range(1, search.seeds + 1) if search.seeds > 1 else ()
    seed_columns = [f"{name} sd" for name in names] if seeds else []
    seed_columns += [f"{name}, run {number}" for number in seeds for name in names]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["trial", "state", *names, *seed_columns, *keys, "run", "reason"])
    for trial in study.trials:
        figures = trial.values if trial.state == TrialState.COMPLETE else [""] * len(names)
        by_seed: list[Any] = []
        if seeds:
            by_seed = [*deviations(trial), *itertools.chain(*trial.user_attrs.get("values", ()))]
            by_seed = by_seed or [""] * len(seed_columns)
        params = [trial.params.get(key, "") for key in keys]
        extra = [" ".join(trial.user_attrs.get("runs", ())), reason(trial)]
        writer.writerow([trial.number, trial.state.name.lower(), *figures, *by_seed, *params, *extra])
    atomic_write(path, text.getvalue())


def write_experiments(study: Study, folder: Path, groups: Collection[str]) -> list[Path]:
    """Write the best trial to experiment/best.yaml, and the others of a Pareto front to trial-N.yaml.

    Files of trials that left the front are removed.

    Args:
        study: the study.
        folder: the search's folder.
        groups: the names of the config groups, whose values are options rather than numbers.

    Returns:
        The files, the best trial's first.
    """
    folder = folder / "experiment"
    folder.mkdir(parents=True, exist_ok=True)
    best = study.best()
    files = [folder / ("best.yaml" if not n else f"trial-{one.number}.yaml") for n, one in enumerate(best)]
    for path, trial in zip(files, best, strict=True):
        atomic_write(path, experiment(study, trial, groups))
    for stale in {*folder.glob("trial-[0-9]*.yaml")} - {*files}:
        stale.unlink()
    return files


def experiment(study: Study, trial: FrozenTrial, groups: Collection[str]) -> str:
    """Return a trial as the text of a file for the config group `experiment`.

    It lacks an experiment of the search's base, since an experiment cannot choose another one, and it does
    not override an experiment of a command line.
    """
    search = study.search
    tree: dict[str, Any] = {}
    options: list[dict[str, str]] = []
    texts = (*search.base, *search.overrides(trial_values(trial, search)))
    for key, override in select_last_by_key(texts).items():
        if key == "experiment":
            continue
        if key in groups:
            options.append({f"override /{key}": override.value or ""})
            continue
        *parents, leaf = key.split(".")
        node = tree
        for name in parents:
            node = node.setdefault(name, {})
        node[leaf] = yaml.safe_load(override.value or "")
    head = (
        f"# @package _global_\n# Trial {trial.number} of {len(study.trials)} of the search {search.name}: "
        f"{', '.join(o.text for o in search.objectives)} on validation "
        f"{', '.join(f'{value:.4f}' for value in trial.values)}; run {' '.join(trial.user_attrs['runs'])}.\n"
    )
    return head + yaml.safe_dump({"defaults": [*options, "_self_"], **tree}, sort_keys=False)


def importances(study: optuna.Study) -> list[tuple[str, float]]:
    """Return each key's importance for the first objective of an Optuna study, largest first; their sum is 1.

    It shows by which keys the best tenth of the trials differs from all of them (PED-ANOVA, Watanabe et
    al. 2023); it is not a share of the variation. The list is empty with fewer than ENOUGH_TRIALS complete
    trials or a single key.
    """
    complete = _complete(study)
    if len(complete) < ENOUGH_TRIALS or len(complete[0].params) < 2:
        return []
    target = None if len(study.directions) == 1 else _first
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = optuna.importance.get_param_importances(study, evaluator=_evaluator(), target=target)
    return sorted(found.items(), key=lambda item: -item[1])


def too_few_trials(study: optuna.Study) -> str | None:
    """Return why an Optuna study of several keys has no importances yet; None if it has, or has no trial."""
    complete = _complete(study)
    if not 0 < len(complete) < ENOUGH_TRIALS or len(complete[0].params) < 2:
        return None
    return f"needs {ENOUGH_TRIALS} complete trials; with {len(complete)} it would be chance"


def _complete(study: optuna.Study) -> list[FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state == TrialState.COMPLETE]


def _evaluator() -> PedAnovaImportanceEvaluator:
    with warnings.catch_warnings():  # Optuna's other evaluators need scikit-learn
        warnings.simplefilter("ignore", ExperimentalWarning)
        return PedAnovaImportanceEvaluator()


def _first(trial: FrozenTrial) -> float:
    return trial.values[0]


def boundary_warnings(study: optuna.Study) -> list[str]:
    """Return a warning for each key with its best value at an end of its range: better ones may lie beyond.

    A value within a fiftieth of the range's width is at its end (of the logarithm's width, if that is
    searched). There are no warnings for several objectives, whose front reaches the ends, and none at zero,
    beyond which nothing lies.
    """
    if len(_complete(study)) < 2 or len(study.directions) > 1:
        return []
    best = study.best_trial
    ends = ((key, best.params[key], _end(best.params[key], one)) for key, one in best.distributions.items())
    return [
        f"{key}: the best value, {value:g}, is the {end} that was tried; better ones may lie beyond it"
        for key, value, end in ends
        if end
    ]


def _end(value: Any, tried: BaseDistribution) -> str | None:
    """Return the end at which a value is among those searched, "smallest" or "largest"; None for neither."""
    if isinstance(tried, CategoricalDistribution):
        numbers = [one for one in tried.choices if isinstance(one, int | float) and not isinstance(one, bool)]
        if len(numbers) < len(tried.choices):
            return None
        low, high, margin = min(numbers), max(numbers), 0.0
    else:
        assert isinstance(tried, FloatDistribution | IntDistribution)
        low, high, margin = tried.low, tried.high, 0.02
    if low == high:
        return None
    scale = math.log if getattr(tried, "log", False) else float
    share = (scale(value) - scale(low)) / (scale(high) - scale(low))
    if share >= 1 - margin:
        return "largest"
    return "smallest" if share <= margin and value else None


def plots(study: Study) -> dict[str, dict[str, Any]]:
    """Return the plots that are possible for a study, by name, with their further arguments."""
    names = [objective.text for objective in study.search.objectives]
    if len(_complete(study.study)) < 2:
        return {}
    if len(names) == 2:
        first = {"target": _first, "target_name": names[0]}
        return {"pareto_front": {"target_names": names}, "parallel_coordinate": first, "slice": first}
    titled = {"target_name": names[0]}
    found: dict[str, dict[str, Any]] = dict.fromkeys(
        ("optimization_history", "parallel_coordinate", "slice"), titled
    )
    if importances(study.study):
        found["param_importances"] = {**titled, "evaluator": _evaluator()}
    return found


def write_plots(study: Study, path: Path) -> None:
    """Write the plots into one HTML page, which works offline; nothing for fewer than two trials."""
    import_optional("plotly", "plots", "the page of a search")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        figures = [
            getattr(optuna.visualization, f"plot_{name}")(study.study, **keywords)
            for name, keywords in plots(study).items()
        ]
    parts = [figure.to_html(full_html=False, include_plotlyjs=not n) for n, figure in enumerate(figures)]
    title = f"search {study.search.name}: {len(study.trials)} trials"
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
    if parts:
        atomic_write(path, f"{head}<body><h1>{title}</h1>{''.join(parts)}</body></html>\n")
