"""The standard metrics by name: their units, and the smallest differences that matter.

Lower values are better for all standard metrics. User packages can add custom metrics
(memmlp.config.plugins). For a custom metric, higher values may be better.
"""

from typing import NamedTuple

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


_OF_AGROL = tuple(name for name in UNITS if name != "geodesic")
_POSITIONS = ("MPJPE", "MPJVE", "Hand PE", "Upper PE", "Lower PE")


class MetricSet(NamedTuple):
    """How a repository's released test measures a clip. The defaults are AGRoL's.

    Attributes:
        source: the repository and its commit.
        metrics: the metrics that the test prints.
        angles: how MPJRE compares axis-angles: "wrapped" takes differences of components within ±pi, "plain"
            does not wrap them, and "turned" reads the difference as a rotation.
        root: whether MPJRE includes the root.
        root_in: the group of joints with the root: "Upper PE", "Lower PE" or neither.
        first: number of frames that are left out at the start of a clip.
        least: number of frames in the shortest clip that is measured.
        hop: the measured frames are `least` and a multiple of `hop`; the rest of a clip is left out.
        orthonormal: whether it makes the columns of 6D rotations orthonormal before it reads them.
    """

    source: str
    metrics: tuple[str, ...] = _OF_AGROL
    angles: str = "wrapped"
    root: bool = False
    root_in: str = "Lower PE"
    first: int = 0
    least: int = 1
    hop: int = 1
    orthonormal: bool = False


METRIC_SETS = {
    "agrol": MetricSet("facebookresearch/AGRoL 13a2b63"),
    "hmd_poser": MetricSet("Pico-AI-Team/HMD-Poser 7c3470d"),
    "sage": MetricSet("Wenchao-M/SAGE 07415ac", angles="turned", orthonormal=True),
    "rpm": MetricSet(
        "facebookresearch/motion_rolling_prediction 64fe8f1",
        ("MPJRE", "MPJPE", "MPJVE", "Jitter", "GT Jitter"), root=True, first=59, least=63,
    ),
    "avatar_poser": MetricSet("eth-siplab/AvatarPoser 0f97cb2", ("MPJPE", "MPJVE", "Hand PE")),
    "ego_poser": MetricSet(
        "eth-siplab/EgoPoser 1acf2fd", ("MPJRE", "MPJPE", "MPJVE"), angles="plain", first=79, least=81
    ),
    "avatar_jlm": MetricSet(
        "zxz267/AvatarJLM 9d27b35", ("MPJRE", *_POSITIONS, "Jitter", "GT Jitter"), angles="plain",
        root_in="Upper PE",
    ),
    "bodiffusion": MetricSet(
        "BCV-Uniandes/BoDiffusion 0ffd1b8", ("MPJRE", *_POSITIONS, "Root PE"), angles="plain",
        root_in="neither", least=41, hop=20,
    ),
    "manikin": MetricSet("eth-siplab/MANIKIN 24f4931", _POSITIONS, root_in="Upper PE", orthonormal=True),
}  # fmt: skip
"""The options of `evaluation.metric_set`: the released test of each repository."""

AUTHORS = "authors"
"""The name of the branch with the metrics of `evaluation.metric_set`."""
