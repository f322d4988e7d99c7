"""Mem-MLP: full-body motion from three tracked points, and the platform for its ablations."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from memmlp.api import Prediction, Runs, TrainedRun, load_run
    from memmlp.common.errors import InputError
    from memmlp.live.stream import Pose, Stream
    from memmlp.live.tracker_input import SampleWarning
    from memmlp.live.wearer import Offsets

__version__ = "0.3.0"

__all__ = [
    "InputError",
    "Offsets",
    "Pose",
    "Prediction",
    "Runs",
    "SampleWarning",
    "Stream",
    "TrainedRun",
    "load_run",
]

_HOMES = {
    "InputError": "memmlp.common.errors",
    "Offsets": "memmlp.live.wearer",
    "Pose": "memmlp.live.stream",
    "Prediction": "memmlp.api",
    "Runs": "memmlp.api",
    "SampleWarning": "memmlp.live.tracker_input",
    "Stream": "memmlp.live.stream",
    "TrainedRun": "memmlp.api",
    "load_run": "memmlp.api",
}


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


if not TYPE_CHECKING:  # to a type checker it would say that every name is there

    def __getattr__(name):
        """Return a public name, which is imported when first used, so that importing the package is quick."""
        if name in _HOMES:
            return getattr(import_module(_HOMES[name]), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
