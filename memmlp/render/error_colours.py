"""The colours of limbs in pictures and on the live page, and the scale of errors."""

from __future__ import annotations

import numpy as np

NEUTRAL = (0.66, 0.70, 0.74)  # the truth's colour, which has no error
HEAT = ("#2b5fd9", "#27a9e1", "#3fc380", "#f2d43d", "#f28c28", "#c4161c")
"""Colours from no error to the top of the scale, evenly spaced."""

SCALES = (10, 15, 20, 30, 40, 50, 75, 100)  # the tops that a scale may have, cm


def heat(parts: np.ndarray) -> np.ndarray:
    """Return colours (..., 3), 0 to 1, of errors (...) given as fractions of the scale's top.

    Fractions above 1 have the colour of 1.
    """
    anchors = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in HEAT])
    place = np.clip(parts, 0, 1) * (len(anchors) - 1)
    return np.stack([np.interp(place, range(len(anchors)), channel) for channel in anchors.T], -1)


def scale(errors: np.ndarray) -> float:
    """Return the top of a scale for errors in cm: a round number below which 98 % of them are.

    Errors may be larger than the largest top.
    """
    high = float(np.percentile(errors, 98))
    return float(next((top for top in SCALES if high <= top), SCALES[-1]))
