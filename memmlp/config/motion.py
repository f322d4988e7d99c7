"""From a config's `data` to its motion; torch-free, so that finished work is found quickly."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from memmlp.config.components import built
from memmlp.motion.prepare import ClipFolder
from memmlp.motion.source import MotionSource


def build_motion(cfg: DictConfig) -> MotionSource:
    """Where the motion is; a synthetic folder's name has its length and seed, so it is never stale."""
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
    return MotionSource(source, generate, Path(cfg.paths.outputs) / "cache")
