"""`memmlp` in a process of its own, as a person types it, on runs of a few steps."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

MAIN = [sys.executable, "-c", "from memmlp.cli.main import main; main()"]
TINY = [
    "profile=tiny",
    "data.synth.minutes=0.2",
    "tracker=none",
    "threads=1",
    "optim.steps=6",
    "vqvae.steps=6",
]


def run(folder: Path, *arguments: str, code: int = 0) -> str:
    """What a command line in that folder prints, on both streams; it must exit with the code."""
    line = [*MAIN, *arguments]
    ran = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == code, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr
