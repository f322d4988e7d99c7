"""The field's metrics by name: their units, and the smallest differences that matter.

Lower is better for all of them. A user's package can add custom metrics (memmlp.config.plugins), for which
higher may be better.
"""

UNITS = {
    "MPJRE": "deg", "geodesic": "deg", "MPJPE": "cm", "Hand PE": "cm", "Upper PE": "cm", "Lower PE": "cm",
    "Root PE": "cm", "MPJVE": "cm/s", "Jitter": "10^2 m/s^3", "GT Jitter": "10^2 m/s^3",
}  # fmt: skip

HIGHER: set[str] = set()
"""Custom metrics for which higher is better."""

SMALLEST = {
    "MPJRE": 0.05, "geodesic": 0.1, "MPJPE": 0.1, "Hand PE": 0.1, "Upper PE": 0.05, "Lower PE": 0.2,
    "Root PE": 0.1, "MPJVE": 1.0, "Jitter": 0.5, "GT Jitter": 0.5,
}  # fmt: skip
"""The smallest effect of interest by metric, in its unit: the largest difference at which two methods are
equally good. A sweep file may set its own.

For errors it is 2 to 4 % of the paper's full model (MPJRE 2.57, MPJPE 3.08, Upper PE 1.25, Lower PE 5.72,
Root PE 2.85), which is invisible on an avatar. Velocity and Jitter, noisier from seed to seed, have 7 to 8 %
of the paper's 15.02 and 6.03. Hand PE (0.27 cm in the paper) takes MPJPE's 0.1 cm, and geodesic twice
MPJRE's, since true angles are about twice as large.
"""
