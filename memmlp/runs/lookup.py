"""Finds and describes runs in an outputs folder, and edits their tags, notes and names, which do not affect
ids."""

import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import find_packaged_folder, now, write_json
from memmlp.runs import records
from memmlp.runs.identity import ID, NETWORK
from memmlp.runs.run import Run

MINUTE = 60 * 60  # frames at 60 Hz
LITTLE = 30 * MINUTE  # frames; `profile=small` draws 23 times as many


def format_outputs_option(outputs: Path) -> list[str]:
    """Return the words of a command that select this outputs folder; none for the default folder."""
    return [] if outputs == Path("outputs") else ["--outputs", str(outputs)]


def list_runs(outputs: Path | str) -> list[Run]:
    """Return all runs in an outputs folder, newest first."""
    folders = sorted((Path(outputs) / "runs").glob("*/"))
    runs = [Run(folder) for folder in folders if ID.fullmatch(folder.name)]
    return sorted(runs, key=lambda run: str(run.manifest.get("started", "")), reverse=True)


def find_run(outputs: Path | str, name: str) -> Run:
    """Find a run by its id, its first digits, its folder, or a shipped network's name. Raises InputError
    without one."""
    is_folder = bool(name) and (Path(name) / "manifest.json").is_file()
    if is_folder and ("/" in name or not ID.fullmatch(name)):
        return Run(Path(name).resolve())
    if not is_folder and (shipped := find_shipped(name)):
        return shipped
    runs = list_runs(outputs)
    matches = sorted(run.id for run in runs if name and run.id.startswith(name))
    if len(matches) == 1:
        return Run.from_id(outputs, matches[0])
    if matches:
        shown = ", ".join(matches[:8]) + (", ..." if len(matches) > 8 else "")
        raise InputError(f"run '{name}': {len(matches)} run ids begin with it: {shown}")
    if is_folder:
        return Run(Path(name).resolve())
    where = Path(outputs) / "runs"
    raise InputError(
        f"run '{name}': must be a run's folder, the first digits of one of {len(runs)} run ids in {where}, "
        f"or a shipped network ({', '.join(list_shipped())})"
    )


def find_outputs(run: Run) -> Path:
    """Return the outputs folder of a run; for a run that was copied elsewhere, the default folder."""
    if run.folder.parent.name == "runs":
        return run.folder.parent.parent
    return Path(os.environ.get("MEMMLP_OUTPUTS", "outputs"))


def is_trained(run: Run) -> bool:
    """Return whether a run is a finished run of a motion network, not a prerequisite run."""
    return run.done and run.manifest.get("kind") == NETWORK


def check_trained(run: Run) -> None:
    """Raise InputError if a run is not a finished run of a motion network."""
    if not is_trained(run):
        raise InputError(f"run {run.id}: must be a finished run of a motion network")


def describe_kind(kind: str) -> str:
    """Return the readable name of a prerequisite run's kind, such as "lower codes"."""
    return "VQ-VAE" if kind == "vqvae" else kind.replace("_", " ")


def get_run_name(manifest: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return a run's name, which shows how its config (by dotted key) differs from the default config."""
    seed = "" if config.get("seed") is None else f" · seed {config['seed']}"
    return str(manifest.get("name") or describe_kind(str(manifest.get("kind") or "run")) + seed)


def count_training_frames(run: Run) -> float:
    """Return the number of frames that a run's network saw in all training steps, for a refiner including
    those of the network that it refines; 0 if unknown."""
    config = run.config
    refiner, optim, model = (config.get(name) or {} for name in ("refiner", "optim", "model"))
    length = (refiner or model).get("frames") or 0
    seen = float(run.total_steps * (optim.get("batch") or 0) * length)
    if not refiner:
        return seen
    network = Run(run.folder.parent / str(run.manifest.get("prerequisite")))
    before = 0.0 if network.config.get("refiner") else count_training_frames(network)
    return seen + before if seen and before else 0.0


def warn_if_hardly_trained(frames: float) -> str:
    """Return a warning if a network saw less than half an hour of motion (`frames`; 0 if unknown) in
    training."""
    if not 0 < frames < LITTLE:
        return ""
    return f"hardly trained (its steps saw {frames / MINUTE:.2g} minutes of motion): ignore its errors"


TAG = re.compile(r"[\w.+/:-]{1,64}")
MAX_LENGTH, MAX_NAME = 10_000, 200  # characters of a note, and of a custom name


@dataclass(frozen=True)
class Notes:
    """A run's sorted tags, its note and custom name, which may be empty, and whether lists leave it out."""

    tags: tuple[str, ...] = ()
    note: str = ""
    name: str = ""
    archived: bool = False


def read_notes(run: Run) -> Notes:
    """Return a run's tags and note; both are empty if the file is missing or damaged."""
    content = records.read(run.notes_path, records.Notes)
    tags = tuple(sorted(set(content.get("tags", ()))))
    return Notes(tags, content.get("note", ""), content.get("name", ""), content.get("archived", False))


def edit_notes(run: Run, **changes: Any) -> Notes:
    """Replace fields of a run's notes, and return them. Raises InputError for an invalid tag, note or
    name."""
    before = read_notes(run)
    notes = replace(before, **changes)
    tags = tuple(sorted(set(notes.tags)))
    notes = replace(notes, tags=tags, note=notes.note.strip(), name=notes.name.strip())
    if bad := [tag for tag in tags if tag not in before.tags and not TAG.fullmatch(tag)]:
        raise InputError(f"tag '{bad[0]}': must be up to 64 letters, digits and . _ + / : -")
    if len(notes.note) > MAX_LENGTH:
        raise InputError(f"note: must have at most {MAX_LENGTH} characters, but has {len(notes.note)}")
    if len(notes.name) > MAX_NAME or not notes.name.isprintable():
        raise InputError(f"name: must have at most {MAX_NAME} printable characters")
    fields = {key: value for key, value in asdict(notes).items() if value or key in ("tags", "note")}
    write_json(run.notes_path, fields)
    return notes


def add_tags(run: Run, tags: Iterable[str]) -> Notes:
    """Add tags to a run. Raises InputError for an invalid tag."""
    return edit_notes(run, tags=(*read_notes(run).tags, *tags))


def remove_tags(run: Run, tags: Iterable[str]) -> Notes:
    """Remove tags from a run. Raises InputError for a tag that the run does not have."""
    before, removed = read_notes(run).tags, set(tags)
    if missing := sorted(removed - set(before)):
        existing = ", ".join(before) or "none"
        raise InputError(f"tag '{missing[0]}': run {run.id} does not have this tag; its tags: {existing}")
    return edit_notes(run, tags=set(before) - removed)


ACTIONS = ("stop", "retry", "prioritize", "unprioritize", "archive", "restore", "name", "note", "tags")
"""The changes of a run that the command line and the page make (`change_run`)."""


def change_run(run: Run, action: str, value: str = "", by: str = "command line") -> None:
    """Change a run, and log the change in its folder. Raises InputError for an invalid value.

    Args:
        run: the run; it may be in progress.
        action: one of ACTIONS.
        value: the name, the note, or all tags separated by blanks; empty for other actions.
        by: who asked for the change, for the log.
    """
    match action:
        case "stop" if run.complete and not run.failure:
            raise InputError(f"run {run.id}: must be unfinished, but it is done")
        case "stop":
            run.request_stop()
        case "retry":
            run.retry()
        case "prioritize" | "unprioritize":
            run.prioritize(action == "prioritize")
        case "archive" | "restore":
            edit_notes(run, archived=action == "archive")
        case "name" | "note":
            edit_notes(run, **{action: value})
        case "tags":
            edit_notes(run, tags=value.split())
        case _:
            raise InputError(f"action={action}: must be one of {', '.join(ACTIONS)}")
    log_action(run.folder, action, value, by)


def log_action(folder: Path, action: str, value: str, by: str) -> None:
    """Append a line about a change to the file actions.jsonl in a folder."""
    line = json.dumps({"time": now(), "action": action, "value": value, "by": by})
    with open(folder / "actions.jsonl", "a", encoding="utf-8") as file:
        file.write(f"{line}\n")


# The package ships networks and a clip in its folder `models`. A shipped network is a finished run without
# checkpoints. Its folder has the network's name, and `card.json` describes it. Commands only read the folder.

CARD = "card.json"
DEFAULT = "recurrent_poser"
"""The network of commands without a network."""


def list_shipped() -> list[str]:
    """Return the names of the shipped networks."""
    return sorted(path.parent.name for path in find_packaged_folder("models").glob(f"*/{CARD}"))


def find_shipped(name: str) -> Run | None:
    """Return the run of a shipped network; None for other names."""
    return Run(find_packaged_folder("models") / name) if name in list_shipped() else None


def get_shipped_name(run: Run) -> str | None:
    """Return the network's name of a shipped run or its copy; None for other runs."""
    return run.manifest.get("shipped")


def find_shipped_clip() -> Path:
    """Return the shipped clip, an AMASS npz file of a test person. Raises InputError if it is missing."""
    for path in sorted((find_packaged_folder("models") / "clip").glob("*.npz")):
        return path
    raise InputError(f"{find_packaged_folder('models') / 'clip'}: has no clip; install memmlp again")


def read_card(name: str) -> dict[str, Any]:
    """Return the card of a shipped network."""
    card: dict[str, Any] = json.loads((find_packaged_folder("models") / name / CARD).read_text("utf-8"))
    return card


def copy_shipped(run: Run, outputs: Path) -> Run:
    """Copy a shipped run to the folder `models` in `outputs`, unless it was copied before.

    New results are written to the copy.
    """
    copy = Run(outputs / "models" / run.id)
    if copy.weights_digest != run.weights_digest:
        shutil.copytree(run.folder, copy.folder, dirs_exist_ok=True)
    return copy
