"""Components for memmlp that look after the feet: a memory, a loss term and a metric."""

from memmlp.common.plugin import Metric, Plugin

__version__ = "0.1.0"

plugin = Plugin(
    schemas={"memory_mean": "memmlp_feet.schema.MeanMemoryConfig"},
    recipes={"memory.mean": 1, "term.skate": 1},
    metrics={"FootSkate": Metric("memmlp_feet.metrics.foot_skate", unit="cm/s", smallest=0.5)},
)
