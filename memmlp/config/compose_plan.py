"""Makes the plan of a sweep file: every variant is composed and checked, and gets its run's identity.

This is in config because only config composes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.common.overrides import Override
from memmlp.config.plugins import activate, find_named, packaged
from memmlp.sweep.definition import Sweep, Variant, key_of, save_sweep_copy
from memmlp.sweep.plan import Entry, Plan, RunTask, unique
from memmlp.sweep.sweep_file import load_sweep

if TYPE_CHECKING:
    from memmlp.training.request import RunRequest


def find_sweep(name: str, overrides: Sequence[str] = ()) -> Sweep:
    """Load the sweep with a path, a shipped file's name, or a table's number.

    Users' packages that its base or the overrides name are in use afterwards.

    Args:
        name: the path, name or number.
        overrides: the command line's overrides (see `Sweep.with_overrides`).

    Raises:
        InputError: if there is no such sweep, or its file is wrong.
    """
    activate(find_named(overrides))
    sweep = load_sweep(_path(name), lambda base: activate(find_named(base))).with_overrides(overrides)
    for variant in sweep.runnable():
        check_preset(sweep, variant)
    return sweep


def check_preset(sweep: Sweep, variant: Variant) -> None:
    """Check that a variant's `experiment=NAME` sets all that it should, and replaces no other experiment.

    Hydra lets a group or key on the command line win over an experiment's, wherever it stands, and the last
    experiment replaces those before. So an override of the base could undo a part of what the variant is for.

    Raises:
        InputError: for such a variant; the message names the sweep, the variant and both overrides.
    """
    from memmlp.config.compose import EXPERIMENT, find_experiment_keys

    own = {key_of(word): word for word in variant.overrides or ()}
    chosen = own.get(EXPERIMENT)
    if chosen is None:
        return
    others = variant.own_overrides if chosen in variant.cell else ()
    around = {key_of(word): word for word in (*sweep.base, *sweep.command_line)}
    around = {key: word for key, word in around.items() if key not in own or key == EXPERIMENT}
    before, options = Override.parse(around.pop(EXPERIMENT, "")).options, Override.parse(chosen).options
    where = f"sweep {sweep.name}, variant '{variant.label}': {chosen}"
    if options and (lost := [option for option in before if option not in options]):
        both = ",".join(dict.fromkeys([*before, *options]))
        raise InputError(f"{where} would replace {EXPERIMENT}={lost[0]}; use {EXPERIMENT}=[{both}]")
    known = find_experiment_keys(options, sweep.all_overrides(variant))
    for key, word in (around | {key_of(word): word for word in others}).items():
        if key in known:
            raise InputError(f"{where} sets {key}, and {word} would override it; remove it or the experiment")


def _path(name: str) -> Path:
    """Return the file of a sweep. Raises InputError if there is no shipped sweep with that name."""
    if is_path(name):
        return Path(name)
    folder = packaged("sweeps")
    stem = f"table{int(name):02d}" if name.isdecimal() else name
    path = folder / f"{stem}.yaml"
    if not path.is_file():
        shipped = sorted(file.stem for file in folder.glob("*.yaml"))
        tables = [int(known.removeprefix("table")) for known in shipped if known.startswith("table")]
        others = ", ".join(known for known in shipped if not known.startswith("table"))
        numbers = f"the number of a table of the paper, {min(tables)} to {max(tables)}"
        raise InputError(f"sweep '{name}': no such sweep; use {numbers}, a path ending in .yaml, or {others}")
    return path


def is_path(name: str) -> bool:
    """Return whether a sweep's name is the path of a file."""
    return name.endswith((".yaml", ".yml")) or "/" in name


def sweep_folder(sweep: Sweep, outputs: Path) -> Path:
    """Return the folder of a sweep with its overrides: its plan, its rounds and its workers' logs.

    The order of overrides does not matter.
    """
    if not sweep.command_line:
        return outputs / "sweeps" / sweep.name
    ordered = sorted(sweep.command_line, key=key_of)
    return outputs / "sweeps" / f"{sweep.name}-{digest(ordered)[:8]}"


def make_plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
    """Return the plan of a sweep; with `prepare`, it is also written into the sweep's folder.

    Args:
        sweep: the sweep with the command line's overrides.
        outputs: the folder of runs and caches.
        prepare: whether to prepare data that is not prepared yet. Without it, entries with such data have no
            identity and are left out.

    Raises:
        InputError: if a config is wrong; the message names variant and key.
    """
    planned: list[tuple[Entry, list[RunTask]]] = []
    data: dict[str, str | None] = {}
    for variant in sweep.runnable():
        for seed, request in _requests(sweep, variant, outputs):
            if (known := _data_digest(request, prepare, data)) is not None:
                found = tasks_of(request, known)
                planned.append((Entry(variant.label, seed, found[-1].id, found[-1].stages), found))
    planned.sort(key=lambda one: sweep.seeds.index(one[0].seed))  # a half-done sweep then has every variant
    tasks = unique(task for _, found in planned for task in found)
    plan = Plan(sweep.name, outputs, tuple(entry for entry, _ in planned), tasks)
    if prepare:
        folder = sweep_folder(sweep, outputs)
        save_sweep_copy(sweep, folder)
        plan.save(folder / "plan.json")
    return plan


def _requests(sweep: Sweep, variant: Variant, outputs: Path) -> Iterable[tuple[int, RunRequest]]:
    """Yield the checked requests of a variant, with their seeds."""
    from memmlp.config.build_request import build_requests
    from memmlp.config.compose import composed

    seeds = sweep.seeds_of(variant)
    try:
        cfg = composed(list(sweep.all_overrides(variant)))
        if cfg.force:  # variants that share a run would make it again and again
            raise InputError("force=true: use --again, which makes a sweep's finished runs again")
        cfg.paths.outputs = str(outputs)
        yield from zip(seeds, build_requests(cfg, seeds), strict=True)
    except InputError as error:
        raise InputError(f"sweep {sweep.name}, variant '{variant.label}': {error}") from None


def tasks_of(request: RunRequest, data: str) -> list[RunTask]:
    """Return the runs that a request needs on data with this digest, its own run last."""
    from memmlp.training.request import remove_refiner

    bare = remove_refiner(request.config) if request.config["refiner"] is not None else request.config
    *before, own = request.identities(data)
    tasks: list[RunTask] = []
    for one in before:
        tasks.append(RunTask(one.id, one.kind, bare, tasks[-1].id if tasks else None))
    last = tasks[-1].id if tasks else None
    return [*tasks, RunTask(own.id, own.kind, request.config, last, request.stage_ids)]


def _data_digest(request: RunRequest, prepare: bool, known: dict[str, str | None]) -> str | None:
    """Return the digest of the request's prepared data, looked up once for each data config.

    Returns:
        None if the data is not prepared.
    """
    key = digest([request.config["data"], request.config["paths"]])
    if key not in known:
        known[key] = request.motion.prepare().digest if prepare else request.motion.digest()
    return known[key]
