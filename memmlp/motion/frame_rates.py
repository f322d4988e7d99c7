"""Rates at which motion is usually recorded and kept; any other may be a slip, as a rounded frame time is."""

from __future__ import annotations

USUAL_RATES = (15, 24, 25, 30, 48, 50, 60, 72, 75, 90, 100, 120, 144, 150, 180, 200, 240, 300)  # Hz
RARE_RATES = (20, 40, 80, 250, 360, 400, 480, 500)  # Hz; what a rounded frame time is not taken for
CLOSE = 2e-3  # relative: 29.97, 59.94 and 119.88 Hz are rates of video


def nearest_rate(rate: float) -> float:
    """Return the usual or rare rate that is nearest to a rate, relatively, Hz."""
    return float(min(USUAL_RATES + RARE_RATES, key=lambda known: max(known / rate, rate / known)))


def is_known_rate(rate: float) -> bool:
    """Whether motion is recorded and kept at such a rate, Hz."""
    return abs(nearest_rate(rate) - rate) <= CLOSE * rate
