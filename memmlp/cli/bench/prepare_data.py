"""`memmlp bench prepare`: the speed of preparing motion data."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("prepare")
@click.option("--minutes", default=60.0, show_default=True, help="Length of the synthetic motion, minutes.")
@click.option("--clips", default=0, metavar="N", help="Instead, this many pieces of two seconds.")
def prepare(minutes: float, clips: int) -> None:
    """Time the preparation of synthetic motion.

    Printed are seconds, those of the processor, frames a second, and peak memory.
    """
    import resource
    import tempfile
    import time

    from memmlp.motion.preparing.cache import ClipFolder
    from memmlp.motion.preparing.cache import prepare as run
    from memmlp.motion.preparing.splits import SeededSplit
    from memmlp.motion.synthetic import synthesize

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "clips"
        if clips:
            _pieces(root, clips)
        else:
            synthesize(root, minutes=minutes)
        start, start_cpu = time.perf_counter(), time.process_time()
        manifest = run(ClipFolder(root, SeededSplit()), Path(folder) / "cache")
        seconds, cpu = time.perf_counter() - start, time.process_time() - start_cpu
    frames = sum(int(part["frames"]) for part in manifest.totals.values())
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    click.echo(
        f"{len(manifest.clips)} clips, {frames} frames ({frames / 216000:.2f} h) in {seconds:.1f} s "
        f"({cpu:.1f} s of the processor): {frames / seconds:.0f} frames/s, "
        f"{seconds / (frames / 216000):.1f} s an hour of motion, peak memory {peak / 2**20:.2f} GB"
    )


def _pieces(root: Path, count: int) -> None:
    """Write two-second pieces of one walk, starting at 28 different seconds.

    Each is moved by its own random horizontal offset, so that no two clips are equal.
    """
    import numpy as np

    from memmlp.motion.clip import Clip
    from memmlp.motion.formats.npz import write_clip
    from memmlp.motion.synthetic import synthesize_clip

    walk, rng = synthesize_clip("walking", 0, seconds=30), np.random.default_rng(0)
    for index in range(count):
        piece = slice(index % 28 * 60, index % 28 * 60 + 120)
        trans = walk.trans[piece] + [*rng.uniform(-1, 1, 2), 0.0]
        name = f"{index // 100}/{index}"
        write_clip(root / f"{name}.npz", Clip(name, walk.poses[piece], trans, walk.fps))
