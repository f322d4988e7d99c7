"""The results of a search: a CSV file of its trials, config files of the best trials, and plots."""

import itertools
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.importance import PedAnovaImportanceEvaluator
from optuna.trial import FrozenTrial, TrialState

from memmlp.common.files import atomic_write
from memmlp.common.overrides import select_last_by_key
from memmlp.common.schema import parse_config_yaml
from memmlp.common.text_formats import format_csv
from memmlp.sweep.search.study import Study, compute_deviations, get_reason, get_values

IMPORTANCE = "keys in which the best tenth of the trials differs from the others"
ENOUGH_TRIALS = 25
"""The minimum number of complete trials for an estimate of importance. In random searches over three keys,
only one of them with an effect, that key was ranked first in 95 % of searches with 25 trials, in 78 % with 20
trials and in 45 % with 10 trials."""


def write_trials(study: Study, path: Path) -> None:
    """Write all trials to a CSV file: number, state, objectives, values, runs, and the reason of a failure.
    With several seeds, the objectives are means. Columns with the standard deviations and each seed's values
    follow. A pruned trial has empty objectives; the reason contains its last value."""
    search = study.search
    names, keys = [one.text for one in search.objectives], [one.key for one in search.space]
    seeds = range(1, search.seeds + 1) if search.seeds > 1 else ()
    seed_columns = [f"{name} sd" for name in names] if seeds else []
    seed_columns += [f"{name}, run {number}" for number in seeds for name in names]
    rows: list[list[Any]] = [["trial", "state", *names, *seed_columns, *keys, "run", "reason"]]
    for trial in study.trials:
        figures = trial.values if trial.state == TrialState.COMPLETE else [""] * len(names)
        by_seed: list[Any] = []
        if seeds:
            by_seed = [*compute_deviations(trial), *itertools.chain(*trial.user_attrs.get("values", ()))]
            by_seed = by_seed or [""] * len(seed_columns)
        params = [trial.params.get(key, "") for key in keys]
        extra = [" ".join(trial.user_attrs.get("runs", ())), get_reason(trial)]
        rows.append([trial.number, trial.state.name.lower(), *figures, *by_seed, *params, *extra])
    atomic_write(path, format_csv(rows))


def write_experiments(study: Study, folder: Path, is_group: Callable[[str], bool]) -> list[Path]:
    """Write the best trial to FOLDER/experiment/best.yaml, and the rest of a Pareto front to trial-N.yaml,
    and return the paths. Files of trials that are no longer on the front are removed. `is_group` tells config
    groups, of which a trial chooses options, from keys."""
    folder = folder / "experiment"
    folder.mkdir(parents=True, exist_ok=True)
    best = study.list_best()
    files = [folder / ("best.yaml" if not n else f"trial-{one.number}.yaml") for n, one in enumerate(best)]
    for path, trial in zip(files, best, strict=True):
        atomic_write(path, format_experiment(study, trial, is_group))
    for stale in {*folder.glob("trial-[0-9]*.yaml")} - {*files}:
        stale.unlink()
    return files


def format_experiment(study: Study, trial: FrozenTrial, is_group: Callable[[str], bool]) -> str:
    """Return a trial as the text of a file for the config group `experiment`. It omits an `experiment=`
    override of the search's base, because an experiment cannot select another experiment."""
    search = study.search
    tree: dict[str, Any] = {}
    options: list[dict[str, str]] = []
    texts = (*search.base, *search.overrides(get_values(trial, search)))
    for key, override in select_last_by_key(texts).items():
        if key == "experiment":
            continue
        if is_group(key):
            options.append({f"override /{key}": override.value or ""})
            continue
        *parents, leaf = key.split(".")
        node = tree
        for name in parents:
            node = node.setdefault(name, {})
        node[leaf] = parse_config_yaml(override.value or "")
    head = (
        f"# @package _global_\n# Trial {trial.number} of {len(study.trials)} of the search {search.name}: "
        f"{', '.join(o.text for o in search.objectives)} on validation "
        f"{', '.join(f'{value:.4f}' for value in trial.values)}; run {' '.join(trial.user_attrs['runs'])}.\n"
    )
    return head + yaml.safe_dump({"defaults": [*options, "_self_"], **tree}, sort_keys=False)


def compute_importances(study: optuna.Study) -> list[tuple[str, float]]:
    """Return each key's importance for an Optuna study's first objective, largest first. The sum is 1.
    PED-ANOVA (Watanabe et al. 2023) measures in which keys the best tenth of the trials differs from all
    trials. It does not measure explained variance. The list is empty with fewer than ENOUGH_TRIALS complete
    trials or with a single key."""
    complete = _list_complete_trials(study)
    if len(complete) < ENOUGH_TRIALS or len(complete[0].params) < 2:
        return []
    target = None if len(study.directions) == 1 else (lambda trial: trial.values[0])
    with warnings.catch_warnings(action="ignore"):
        evaluator = PedAnovaImportanceEvaluator()  # Optuna's other evaluators need scikit-learn
        importances = optuna.importance.get_param_importances(study, evaluator=evaluator, target=target)
    return sorted(importances.items(), key=lambda item: -item[1])


def explain_missing_importances(study: optuna.Study) -> str | None:
    """Return a line if a study has too few trials for importances; None if it has enough trials, no complete
    trial, or a single key."""
    complete = _list_complete_trials(study)
    if not 0 < len(complete) < ENOUGH_TRIALS or len(complete[0].params) < 2:
        return None
    return f"needs {ENOUGH_TRIALS} complete trials; with {len(complete)} it would be chance"


def _list_complete_trials(study: optuna.Study) -> list[FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state == TrialState.COMPLETE]


def find_boundary_warnings(study: optuna.Study) -> list[str]:
    """Return a warning for each key with its best value at an end of the searched range: the outer 2 % of the
    range, on a logarithmic scale if the search uses one. There are no warnings for several objectives,
    because a Pareto front often reaches the ends, or for a value of zero."""
    if len(_list_complete_trials(study)) < 2 or len(study.directions) > 1:
        return []
    params, distributions = study.best_trial.params, study.best_trial.distributions
    return [
        f"{key}: the best value, {params[key]:g}, is the {end} tried value; consider a wider range"
        for key, distribution in distributions.items()
        if (end := _find_range_end(params[key], distribution))
    ]


def _find_range_end(value: Any, tried: BaseDistribution) -> str | None:
    """Return "smallest" or "largest" if a value is at this end of the tried values, else None."""
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
    position = (scale(value) - scale(low)) / (scale(high) - scale(low))
    if position >= 1 - margin:
        return "largest"
    return "smallest" if position <= margin and value else None
