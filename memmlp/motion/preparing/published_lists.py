"""Published lists of training and test clips, and the assignment of a data root's clips to their entries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.motion.preparing.amass_names import clip_key, subset

PHASES = ("train", "test")  # the parts for which there are published lists


def entries_of_clips(entries: Collection[str], names: Collection[str]) -> dict[str, str]:
    """Map clips to their entries in a list: by name, else by the name in another release of AMASS.

    Raises:
        InputError: if several clips have an entry's name in another release, and none has exactly the entry's
            name.
    """
    fits = {name: name for name in names if name in entries}
    others = {clip_key(entry).lower(): entry for entry in sorted(set(entries) - set(fits), reverse=True)}
    found = defaultdict(list)
    for name in sorted(set(names) - set(fits)):
        if (entry := others.get(clip_key(name).lower())) is not None:
            found[entry].append(name)
    _refuse_several(found.values())
    return fits | {clips[0]: entry for entry, clips in found.items()}


def check_once(names: Iterable[str]) -> None:
    """Raise InputError for clips that occur more than once, from several releases of AMASS."""
    found = defaultdict(list)
    for name in sorted(names):
        found[clip_key(name)].append(name)
    _refuse_several(found.values())


def _refuse_several(found: Iterable[Sequence[str]]) -> None:
    several = [clips for clips in found if len(clips) > 1]
    if several:
        first, second = several[0][:2]
        raise InputError(
            f"data.root: {len(several)} clips of the split fit more than one file, the first {first}.npz and "
            f"{second}.npz; keep one release of AMASS below it"
        )


def read_lists(folder: Path) -> dict[str, str]:
    """Map clip names to "train" or "test", by all lists below a folder.

    Raises:
        InputError: if there are no lists, one cannot be read or lacks its counterpart, or a clip is in both.
    """
    files = {phase: sorted(folder.rglob(_file(phase))) for phase in PHASES}
    if not files["train"]:
        raise InputError(f"data.split: no SUBSET/train_split.txt below {folder}")
    for own in sorted({file.parent for phase in PHASES for file in files[phase]}):
        if lacking := [_file(phase) for phase in PHASES if own / _file(phase) not in files[phase]]:
            raise InputError(
                f"data.split: no {lacking[0]} in {own}, beside the other list of this subset; "
                "allowed: both, of which one may be empty"
            )
    entries: dict[str, str] = {}
    for phase in PHASES:
        for file in files[phase]:
            for name in _read_list(file):
                if entries.setdefault(name, phase) != phase:
                    raise InputError(f"{file}: {name} is both in a train and in a test list")
    return entries


def _file(phase: str) -> str:
    """Return the name of a subset's list."""
    return f"{phase}_split.txt"


def _read_list(file: Path) -> Iterator[str]:
    """Yield the clip names of a list; a path begins at the folder that is named like the list's own."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a readable list ({error})") from error
    for line in filter(None, map(str.strip, lines)):
        steps = [step for step in line.removesuffix(".npz").split("/") if step not in ("", ".")]
        own = next((i for i, step in enumerate(steps[:-1]) if subset(step) == subset(file.parent.name)), 0)
        yield "/".join(steps[own:])
