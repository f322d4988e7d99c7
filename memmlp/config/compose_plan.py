"""Makes the plan of a sweep: composes and checks each variant's config, and computes the ids of its runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from memmlp.common.errors import InputError
from memmlp.common.files import digest, find_packaged_folder
from memmlp.common.overrides import Override
from memmlp.config.plugins import activate, find_named_packages
from memmlp.sweep.definition import Sweep, Variant, parse_key, save_sweep_copy
from memmlp.sweep.plan import Entry, Plan, RunTask, order_tasks
from memmlp.sweep.sweep_file import load_sweep

if TYPE_CHECKING:
    from memmlp.training.request import RunRequest


def find_sweep(name: str, overrides: Sequence[str] = ()) -> Sweep:
    """Load a sweep (a file's path, a shipped sweep's name, or a table's number) with overrides, and activate
    its plugins. Raises InputError if it does not exist, or is invalid."""
    activate(find_named_packages(overrides))
    sweep = load_sweep(
        _find_sweep_file(name), lambda base: activate(find_named_packages(base))
    ).with_overrides(overrides)
    for variant in sweep.list_runnable():
        check_preset(sweep, variant)
    return sweep


def check_preset(sweep: Sweep, variant: Variant) -> None:
    """Check that other overrides do not conflict with a variant's `experiment=NAME`. In Hydra, an override of
    a key has priority over an experiment, and the last experiment replaces earlier ones. So an override of
    the base could silently undo a part of the variant. Raises InputError for a conflict."""
    from memmlp.config.compose import EXPERIMENT, find_experiment_keys

    variant_words = {parse_key(word): word for word in variant.overrides or ()}
    chosen = variant_words.get(EXPERIMENT)
    if chosen is None:
        return
    others = variant.own_overrides if chosen in variant.cell else ()
    around = {parse_key(word): word for word in (*sweep.base, *sweep.command_line)}
    around = {key: word for key, word in around.items() if key not in variant_words or key == EXPERIMENT}
    before, options = Override.parse(around.pop(EXPERIMENT, "")).options, Override.parse(chosen).options
    where = f"sweep {sweep.name}, variant '{variant.label}': {chosen}"
    if options and (lost := [option for option in before if option not in options]):
        both = ",".join(dict.fromkeys([*before, *options]))
        raise InputError(f"{where} would replace {EXPERIMENT}={lost[0]}; use {EXPERIMENT}=[{both}]")
    preset_keys = find_experiment_keys(options)
    for key, word in (around | {parse_key(word): word for word in others}).items():
        if key in preset_keys:
            raise InputError(f"{where} sets {key}, and {word} would override it; remove it or the experiment")


def _find_sweep_file(name: str) -> Path:
    if is_path(name):
        return Path(name)
    folder = find_packaged_folder("sweeps")
    stem = f"table{int(name):02d}" if name.isdecimal() else name
    path = folder / f"{stem}.yaml"
    if not path.is_file():
        shipped = sorted(file.stem for file in folder.glob("*.yaml"))
        tables = [int(stem.removeprefix("table")) for stem in shipped if stem.startswith("table")]
        others = ", ".join(stem for stem in shipped if not stem.startswith("table"))
        numbers = f"a table's number from {min(tables)} to {max(tables)}"
        raise InputError(
            f"sweep '{name}': no such sweep; expected {numbers}, a path ending in .yaml, or one of {others}"
        )
    return path


def is_path(name: str) -> bool:
    """Return whether a sweep's name is a path, not a shipped sweep's name."""
    return name.endswith((".yaml", ".yml")) or "/" in name


def get_sweep_folder(sweep: Sweep, outputs: Path) -> Path:
    """Return the folder of a sweep's plan, seed rounds and logs. The overrides' order does not matter."""
    if not sweep.command_line:
        return outputs / "sweeps" / sweep.name
    ordered = sorted(sweep.command_line, key=parse_key)
    return outputs / "sweeps" / f"{sweep.name}-{digest(ordered)[:8]}"


def make_plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
    """Make the plan of a sweep. With `prepare`, also write it into the sweep's folder, and prepare missing
    data. Otherwise, entries with unprepared data are omitted, because a run's id depends on its data. Raises
    InputError for an invalid config."""
    planned: list[tuple[Entry, list[RunTask]]] = []
    data: dict[str, str | None] = {}
    for variant in sweep.list_runnable():
        for seed, request in _build_requests(sweep, variant, outputs):
            if (data_digest := _find_data_digest(request, prepare, data)) is not None:
                tasks = make_tasks(request, data_digest)
                planned.append((Entry(variant.label, seed, tasks[-1].id, tasks[-1].stages), tasks))
    planned.sort(key=lambda one: sweep.seeds.index(one[0].seed))  # every variant soon has a run
    every_task = order_tasks(task for _, tasks in planned for task in tasks)
    plan = Plan(sweep.name, outputs, tuple(entry for entry, _ in planned), every_task)
    if prepare:
        folder = get_sweep_folder(sweep, outputs)
        save_sweep_copy(sweep, folder)
        plan.save(folder / "plan.json")
    return plan


def _build_requests(sweep: Sweep, variant: Variant, outputs: Path) -> Iterable[tuple[int, RunRequest]]:
    from memmlp.config.build_request import build_requests
    from memmlp.config.compose import compose_checked

    seeds = sweep.get_seeds(variant)
    try:
        checked = compose_checked(list(sweep.merge_overrides(variant)))
        if checked.resolved["force"]:  # variants may share a run, which would be trained repeatedly
            raise InputError("force=true: expected --again, which trains a sweep's finished runs again")
        chosen = {parse_key(text) for text in sweep.command_line}
        solver = checked.resolved["evaluation"]["ik"]
        if variant.branch == "combined" and solver == "off" and "evaluation.ik" not in chosen:
            raise InputError("branch: combined needs evaluation.ik=lbfgs or evaluation.ik=arms")
        yield from zip(seeds, build_requests(checked, outputs, seeds), strict=True)
    except InputError as error:
        raise InputError(f"sweep {sweep.name}, variant '{variant.label}': {error}") from None


def make_tasks(request: RunRequest, data: str) -> list[RunTask]:
    """Return the tasks of a request for data with this digest: its prerequisite runs in order, then its own
    run."""
    from memmlp.training.request import remove_refiner

    bare = remove_refiner(request.config) if request.config["refiner"] is not None else request.config
    *prerequisites, identity = request.compute_identities(data)
    tasks: list[RunTask] = []
    for one in prerequisites:
        tasks.append(RunTask(one.id, one.kind, bare, tasks[-1].id if tasks else None))
    last = tasks[-1].id if tasks else None
    return [*tasks, RunTask(identity.id, identity.kind, request.config, last, request.stage_ids)]


def _find_data_digest(request: RunRequest, prepare: bool, digests: dict[str, str | None]) -> str | None:
    """Return the digest of a request's prepared data, or None; `digests` caches it by data config."""
    key = digest([request.config["data"], request.config["paths"]])
    if key not in digests:
        digests[key] = request.motion.prepare().digest if prepare else request.motion.find_digest()
    return digests[key]
