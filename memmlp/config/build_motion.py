"""Builds the motion source of a config's `data`, without torch, so that finished work is found quickly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig, OmegaConf

from memmlp.common.errors import InputError
from memmlp.config.instantiate import built, located
from memmlp.motion.clip import LINES
from memmlp.motion.motion_source import MotionSource
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.preparing.find_clips import Folders, Root
from memmlp.motion.preparing.splits import MixedSplit, SeededSplit, Split
from memmlp.runs.recipe_versions import RECIPES


def build_motion(cfg: DictConfig) -> MotionSource:
    """Build the source of an experiment's motion.

    A synthetic folder's name contains its length and seed, or the path and settings of a custom generator,
    and the generator's recipe version after the first, so that other settings and generators never find
    stale files. A custom generator's recipe has the name of its option, such as "data.walks".

    Raises:
        InputError: if a list of groups can't be read, two folders of a list have the same name, or the
            generator does not exist.
    """
    data = cfg.data
    root, split = _clips(data)
    generate: Callable[[Path], object] | None = None
    if data.synth is not None and "_target_" in data.synth:
        path = str(data.synth._target_)
        settings = {str(key): value for key, value in data.synth.items() if key != "_target_"}
        made = "-".join([path, *(f"{key}{value}" for key, value in settings.items())])
        root = Path(data.root) / f"{made}{_version(f'data.{data.name}')}"
        generate = partial(located(path, "data.synth"), **settings)
    elif data.synth is not None:
        made = f"{data.synth.minutes:g}min-seed{data.synth.seed}"
        root = Path(data.root) / f"{made}{_version('synthetic')}"
        generate = partial(_synthesize, minutes=data.synth.minutes, seed=data.synth.seed)

    interpolation = data.get("interpolation", LINES)  # recorded configs from before the key mean lines
    clips = ClipFolder(root, split, str(data.body), data.min_frames, data.strict, interpolation)
    caches = Path(cfg.paths.outputs) / "cache"
    return MotionSource(clips, generate, caches, partial=data.get("partial", False))


def _version(recipe: str) -> str:
    """Return what a folder's name says of a generator's recipe version: nothing of the first, else "-v2"."""
    version = RECIPES.get(recipe, 1)
    return f"-v{version}" if version > 1 else ""


def _synthesize(folder: Path, minutes: float, seed: int) -> None:
    """Make synthetic motion; imported here, since that needs torch."""
    from memmlp.motion.synthetic import synthesize

    synthesize(folder, minutes=minutes, seed=seed)


def shares(data: DictConfig) -> Mapping[str, float] | None:
    """Return the relative weight of each source in training windows; None if no source has a weight."""
    weights = {name: source.get("weight") for name, source in (data.get("sources") or {}).items()}
    return weights if any(weights.values()) else None


class _Clips(NamedTuple):
    """The folders of the clips, and the split."""

    root: Root
    split: Split


def _clips(data: DictConfig) -> _Clips:
    """Return the folder or folders of the clips, and their split; each source is split separately."""
    split = built(data.split)
    if sources := data.get("sources"):
        folders = Folders({name: Path(source.root) for name, source in sources.items()})
        own = {name: _own_split(split, name, source) for name, source in sources.items()}
        return _Clips(folders, MixedSplit(own))
    roots = list(data.root) if OmegaConf.is_list(data.root) else [data.root]
    if len(roots) == 1:
        return _Clips(Path(roots[0]), split)
    folders = Folders.of([Path(root) for root in roots])
    return _Clips(folders, MixedSplit(dict.fromkeys(folders.sources, split)))


def _own_split(split: SeededSplit, name: str, source: DictConfig) -> SeededSplit:
    """Return the split of one source, with its own groups and fractions."""
    own = {part: source.get(part) for part in ("test", "val") if source.get(part) is not None}
    groups = [*split.groups, *(source.get("groups") or ())]
    try:
        return replace(split, groups=groups, groups_file=source.get("groups_file"), **own)
    except InputError as error:
        raise InputError(f"data.sources.{name}: {error}") from None
