"""The example package of docs/examples, for one test at a time."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from command_line import SMALL

from memmlp.common import components
from memmlp.config import plugins
from memmlp.evaluation.metric_facts import HIGHER, SMALLEST, UNITS
from memmlp.runs.identity import VERSIONS

EXAMPLE = Path(__file__).parent.parent / "docs/examples/feet"
PACKAGE = "memmlp_feet"
TINY = ["profile=tiny", *SMALL, "loggers=none", "threads=1", "optim.validate_every=20"]
REGISTERS = (SMALLEST, UNITS, VERSIONS, HIGHER, plugins._active, components._roots)


@contextmanager
def registers_kept() -> Iterator[None]:
    """Remove all that custom packages add, and their modules, afterwards."""
    before = [one.copy() for one in REGISTERS]
    modules = set(sys.modules)
    try:
        yield
    finally:
        for one, content in zip(REGISTERS, before, strict=True):
            one.clear()
            one.update(content)  # type: ignore[arg-type]
        components.collect_components.cache_clear()
        for name in set(sys.modules) - modules:
            if name.split(".")[0] in (PACKAGE, "mine", "other", "helper", "lab") and ":" not in name:
                del sys.modules[name]
