"""The standard metrics by name: their units, and the smallest differences that matter.

Lower values are better for all standard metrics. User packages can add custom metrics
(memmlp.config.plugins). For a custom metric, higher values may be better.
"""

UNITS = {
    "MPJRE": "deg", "geodesic": "deg", "MPJPE": "cm", "Hand PE": "cm", "Upper PE": "cm", "Lower PE": "cm",
    "Root PE": "cm", "MPJVE": "cm/s", "Jitter": "10^2 m/s^3", "GT Jitter": "10^2 m/s^3",
}  # fmt: skip

MIN_FRAMES = {"MPJVE": 2, "Jitter": 4, "GT Jitter": 4}
"""The number of frames that a metric needs; 1 for all others. Shorter clips have no value, which is NaN."""

HIGHER: set[str] = set()
"""Names of the custom metrics for which higher values are better."""

SMALLEST = {
    "MPJRE": 0.05, "geodesic": 0.1, "MPJPE": 0.1, "Hand PE": 0.1, "Upper PE": 0.05, "Lower PE": 0.2,
    "Root PE": 0.1, "MPJVE": 1.0, "Jitter": 0.5, "GT Jitter": 0.5,
}  # fmt: skip
"""The smallest effect of interest by metric, in the metric's unit. Two methods with a smaller difference
count as equally good. A sweep file can override these values.

For errors, the value is 2 to 4 % of the paper's full model (MPJRE 2.57, MPJPE 3.08, Upper PE 1.25, Lower PE
5.72, Root PE 2.85). Such a difference is invisible on an avatar. MPJVE and Jitter vary more between seeds, so
their values are 7 to 8 % of the paper's 15.02 and 6.03. Hand PE (0.27 cm in the paper) uses 0.1 cm, like
MPJPE. The geodesic value is twice the MPJRE value, because true angles are about twice as large.
"""
