"""What runs make that no test looks at, as small as can be.

A picture of one pixel, since drawing is half a tiny evaluation; and steps timed in turn with one layer of the
yardstick in place of its eight, since 86 M multiply-adds are most of the time of a tiny network's deployment.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from PIL import Image


def small_picture(model: Any, test: Any, path: Path) -> None:
    """Write a picture of one pixel, in place of `memmlp.training.run_stages.draw_first_clip`."""
    Image.new("RGB", (1, 1)).save(path)


original: Any = None


def draw_small() -> None:
    """Runs of this process have both small from now on, if what makes them is imported by now."""
    if stages := sys.modules.get("memmlp.training.run_stages"):
        global original
        if stages.draw_first_clip is not small_picture:
            original = stages.draw_first_clip
        stages.draw_first_clip = small_picture
    if latency := sys.modules.get("memmlp.deploy.latency"):
        latency.YARDSTICK_SHAPE = (*latency.YARDSTICK_SHAPE[:2], 1)


def draw_large() -> None:
    """Draw real pictures again; no test looks at the times of a yardstick."""
    from memmlp.training import run_stages

    if original is not None:
        run_stages.draw_first_clip = original
