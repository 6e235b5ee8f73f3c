"""Meta-World tasks that share a table. Importing this needs the `metaworld` extra."""

try:
    import metaworld  # noqa: F401
except ModuleNotFoundError as error:
    message = "MultimodalMetaworld-v0 needs Meta-World and MuJoCo: pip install 'sb3-offline[metaworld]'"
    raise ModuleNotFoundError(message, name=error.name) from error

from sb3_offline.envs.multimodal_metaworld.env import MultimodalMetaworldEnv
from sb3_offline.envs.multimodal_metaworld.tables import STATE_NAMES, TABLES, TASKS

__all__ = ["STATE_NAMES", "TABLES", "TASKS", "MultimodalMetaworldEnv"]
