"""The height of the floor in a clip, found from where its feet stand."""

from __future__ import annotations

import numpy as np

from memmlp.motion.importing.anatomy import FEET

CONTACT = 0.02  # metres: height of the toe joint above the floor it stands on (the built-in body's)
STILL = 0.15  # metres a second: a toe that stands is slower
SECONDS = 0.2  # toes must stand as long in all for a floor to be known
LOWEST = 0.05  # share of the standing toes that may be lower: noise, and feet that sink in


def find_floor(positions: np.ndarray, fps: float) -> float | None:
    """Return the height of the floor, metres.

    It is below nearly all toes that stand still, and not above the lowest joint in nearly all frames.

    Args:
        positions: global joint positions (N, 22, 3), world (Z up).
        fps: frames per second.

    Returns:
        None if no toe stands long enough to tell the floor's height.
    """
    toes = positions[:, list(FEET.values())]
    if len(toes) < 2:
        return None
    speed = np.linalg.norm(np.gradient(toes, axis=0), axis=-1) * fps
    standing = toes[..., 2][speed < STILL]
    if len(standing) < SECONDS * fps:
        return None
    lowest = np.quantile(positions[..., 2].min(1), LOWEST)  # of who lies, whose toes are up
    return float(min(np.quantile(standing, LOWEST) - CONTACT, lowest))
