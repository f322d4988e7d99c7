"""Makes the plan of a sweep file: every variant is composed and checked, and gets its run's identity.

This is in config because only config composes.

Composing takes a moment for each variant. So the plan of a sweep that was started is kept, and used again for
as long as the sweep, the configs, the code and the data are unchanged.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from memmlp.common.errors import InputError
from memmlp.common.files import digest, read_json, write_json
from memmlp.common.overrides import Override
from memmlp.config.package_data import packaged
from memmlp.config.plugins import activate, named, texts_outside_memmlp
from memmlp.sweep.definition import Sweep, Variant, keep_sweep, key_of
from memmlp.sweep.plan import Entry, Plan, RunTask, unique
from memmlp.sweep.sweep_file import load_sweep

if TYPE_CHECKING:
    from omegaconf import DictConfig

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
    activate(named(overrides))
    sweep = load_sweep(_path(name), lambda base: activate(named(base))).with_overrides(overrides)
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
    from memmlp.config.compose import EXPERIMENT, set_by_experiments

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
    known = set_by_experiments(options, sweep.all_overrides(variant))
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


def kept_or_new_plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
    """Return the kept plan of a sweep if it is still valid, or else a new one, which is kept.

    Looking at a sweep that was never started writes nothing into the outputs. Looking at fewer of its seeds,
    or while its data is absent, leaves the kept plan unchanged.

    Args:
        sweep: the sweep with the command line's overrides.
        outputs: the folder of runs and caches.
        prepare: whether to prepare data that is not prepared yet. Without it, entries with such data have no
            identity and are left out.

    Raises:
        InputError: if a config is wrong; the message names variant and key.
    """
    path = sweep_folder(sweep, outputs) / "plan_stamp.json"
    if not prepare and not path.parent.is_dir():
        return plan_anew(sweep, outputs)
    stamp = _stamp(sweep, outputs)
    kept = read_json(path)
    if kept.get("stamp") == stamp and all(_fresh(data, prepare) for data in kept["data"]):
        keep_sweep(sweep, path.parent)
        return Plan.load(path.with_name("plan.json"))
    plan, data = _plan(sweep, outputs, prepare)
    labels = {variant.label for variant in sweep.variants}
    before = [
        (e.get("label"), e.get("seed")) for e in read_json(path.with_name("plan.json")).get("entries", ())
    ]
    lost = {cell for cell in before if cell[0] in labels} - {(one.label, one.seed) for one in plan.entries}
    if prepare or not lost:
        keep_sweep(sweep, path.parent)
        plan.save(path.with_name("plan.json"))
        write_json(path, {"stamp": stamp if data is not None else None, "data": data or []})
        ever = path.with_name("entries.json")  # all entries that the sweep has ever had, for `orphans`
        entries = [*read_json(ever).get("entries", []), *map(asdict, plan.entries)]
        unique_entries = {(e["label"], e["seed"], e["id"]): e for e in entries}
        write_json(ever, {"entries": list(unique_entries.values())})
    return plan


def plan_anew(sweep: Sweep, outputs: Path) -> Plan:
    """Return the plan of a sweep as far as its data is prepared, and write nothing into the outputs.

    Raises:
        InputError: as `kept_or_new_plan` does.
    """
    return _plan(sweep, outputs, prepare=False)[0]


def orphans(sweep: Sweep, plan: Plan) -> list[Entry]:
    """Return the begun runs of earlier versions of the sweep that the sweep no longer has.

    Their variant's label is gone, or the variant has another config now.
    """
    recorded = read_json(sweep_folder(sweep, plan.outputs) / "entries.json").get("entries", [])
    labels = {variant.label for variant in sweep.variants}
    now = {(entry.label, entry.seed): entry.id for entry in plan.entries}
    used = set(now.values())
    entries = [Entry(entry["label"], entry["seed"], entry["id"]) for entry in recorded]
    return [
        entry
        for entry in entries
        if entry.id not in used
        and plan.run_of(entry).manifest
        and (entry.label not in labels or now.get((entry.label, entry.seed), entry.id) != entry.id)
    ]


def _plan(sweep: Sweep, outputs: Path, prepare: bool) -> tuple[Plan, list[dict[str, Any]] | None]:
    """Make the plan, and list the data that it relies on; the list is None if some data is not prepared."""
    planned: list[tuple[Entry, list[RunTask]]] = []
    data: dict[str, dict[str, Any]] = {}
    for variant in sweep.runnable():
        for seed, request in _requests(sweep, variant, outputs):
            if (known := _data_digest(request, prepare, data)) is not None:
                found = tasks_of(request, known)
                planned.append((Entry(variant.label, seed, found[-1].id, found[-1].stages), found))
    planned.sort(key=lambda one: sweep.seeds.index(one[0].seed))  # a half-done sweep then has every variant
    tasks = unique(task for _, found in planned for task in found)
    plan = Plan(sweep.name, outputs, tuple(entry for entry, _ in planned), tasks)
    complete = all(one["digest"] is not None for one in data.values())
    return plan, list(data.values()) if complete else None


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
    from memmlp.training.request import without_refiner

    bare = without_refiner(request.config) if request.config["refiner"] is not None else request.config
    *before, own = request.identities(data)
    tasks: list[RunTask] = []
    for one in before:
        tasks.append(RunTask(one.id, one.kind, bare, tasks[-1].id if tasks else None))
    last = tasks[-1].id if tasks else None
    return [*tasks, RunTask(own.id, own.kind, request.config, last, request.stage_ids)]


def _data_digest(request: RunRequest, prepare: bool, data: dict[str, dict[str, Any]]) -> str | None:
    """Return the digest of the request's prepared data; None if it is not prepared.

    The digest is looked up once for each data config and kept in `data`.
    """
    config = {"data": request.config["data"], "paths": request.config["paths"]}
    key = digest(config)
    if key not in data:
        found = request.motion.prepare().digest if prepare else request.motion.digest()
        data[key] = {"config": config, "digest": found, "groups": request.motion.groups_digest}
    return data[key]["digest"]


def _fresh(data: dict[str, Any], prepare: bool) -> bool:
    """Return whether the data that a kept plan relies on is unchanged, and if `prepare`, fit to train on.

    The groups of clips count, too, since identities of evaluations depend on them.
    """
    from omegaconf import OmegaConf

    from memmlp.config.build_motion import build_motion

    cfg: DictConfig = OmegaConf.create(data["config"])
    try:
        motion = build_motion(cfg)
        found = motion.prepare().digest if prepare else motion.digest()
        return (found, motion.groups_digest) == (data["digest"], data.get("groups"))
    except InputError:
        return False


def _stamp(sweep: Sweep, outputs: Path) -> str:
    """Return a digest of everything except the data on which a plan depends.

    That is the sweep, the outputs folder, the configs, and the code of memmlp and of users' packages. A plan
    that depends on folders or on the environment in another way has a digest of its own each time.
    """
    package = Path(__file__).parent.parent
    files = [*packaged("conf").rglob("*.yaml"), *package.rglob("*.py")]
    ours = [(str(file), file.read_text(encoding="utf-8")) for file in sorted(files)]
    own = texts_outside_memmlp()
    elsewhere = any(sign in repr((asdict(sweep), own)) for sign in ELSEWHERE)
    unstable = [time.time_ns()] if elsewhere else []
    return digest([asdict(sweep), str(outputs), ours, *([own] if own else []), *unstable])


ELSEWHERE = ("oc.env", "hydra.searchpath")
"""What an override or a user's config holds that takes values from the environment, or from other folders."""
