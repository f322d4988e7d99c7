"""The schema of the config: the type of every key is declared here.

The values and their sources are in conf/, the limits are enforced by `check`. Each dataclass is one option of
a config group. Hydra's ConfigStore holds it as schema/<group>_<option>, and the YAML file of the same name
starts from it, so that unknown keys and wrong types are refused when the config is composed.
"""

from memmlp.config.schema.config import SCHEMAS, Config, add_schema, register
from memmlp.config.schema.config_checks import check, unknown_key
from memmlp.config.schema.recorded_configs import restored

__all__ = ["SCHEMAS", "Config", "add_schema", "check", "register", "restored", "unknown_key"]
