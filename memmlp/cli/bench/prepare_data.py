"""`memmlp bench prepare`: the speed of preparing motion data."""

from __future__ import annotations

import click


@click.command("prepare")
@click.option("--minutes", default=60.0, show_default=True, help="Length of the synthetic motion, minutes.")
def prepare(minutes: float) -> None:
    """Time the preparation of synthetic motion.

    Printed are seconds, frames a second, and peak memory.
    """
    import resource
    import tempfile
    import time
    from pathlib import Path

    from memmlp.motion.preparing.cache import ClipFolder
    from memmlp.motion.preparing.cache import prepare as run
    from memmlp.motion.preparing.splits import SeededSplit
    from memmlp.motion.synthetic import synthesize

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "clips"
        synthesize(root, minutes=minutes)
        start = time.perf_counter()
        manifest = run(ClipFolder(root, SeededSplit()), Path(folder) / "cache")
        seconds = time.perf_counter() - start
    frames = sum(int(part["frames"]) for part in manifest.totals.values())
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    click.echo(
        f"{frames} frames ({frames / 216000:.2f} h) in {seconds:.1f} s: {frames / seconds:.0f} frames/s, "
        f"{seconds / (frames / 216000):.1f} s an hour of motion, peak memory {peak / 2**20:.2f} GB"
    )
