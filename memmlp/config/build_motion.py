"""Build the motion source of a config's `data`. It needs no torch, so that finished work is found quickly."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from memmlp.config.instantiate import built
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.preparing.source import MotionSource


def build_motion(cfg: DictConfig) -> MotionSource:
    """Build the source of an experiment's motion.

    A synthetic folder's name holds its length and seed, so that other settings never find stale files.
    """
    data, root = cfg.data, Path(cfg.data.root)
    generate = None
    if data.synth is not None:
        root = root / f"{data.synth.minutes:g}min-seed{data.synth.seed}"
        minutes, seed = data.synth.minutes, data.synth.seed

        def generate(folder: Path) -> None:
            from memmlp.motion.synthetic import synthesize

            synthesize(folder, minutes=minutes, seed=seed)

    split = built(data.split)
    source = ClipFolder(root, split, str(data.body), data.min_frames, data.strict)
    caches = Path(cfg.paths.outputs) / "cache"
    return MotionSource(source, generate, caches, partial=data.get("partial", False))
