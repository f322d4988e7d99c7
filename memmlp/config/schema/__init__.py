"""Every key of the config: its type here, its values and their sources in conf/, its limits in `check`.

A dataclass is a group's option; ConfigStore holds it as schema/<group>_<option>, and the YAML file of the
same name starts from it, so that unknown keys and wrong types are refused when the config is composed.
"""

from memmlp.config.schema.checks import check, unknown_key
from memmlp.config.schema.config import SCHEMAS, Config, register, restored

__all__ = ["SCHEMAS", "Config", "check", "register", "restored", "unknown_key"]
