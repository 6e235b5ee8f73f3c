"""Offline reinforcement learning for Stable-Baselines3, from rewards or from examples of success."""

from pathlib import Path

import sb3_offline.envs  # noqa: F401  (registers the environments)
from sb3_offline.awac import AWAC
from sb3_offline.bc import BC
from sb3_offline.ceborl import CEBORL
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.cql import CQL
from sb3_offline.dcql import DCQL
from sb3_offline.iql import IQL
from sb3_offline.oril import ORIL
from sb3_offline.rce import RCE
from sb3_offline.rebrac import ReBRAC
from sb3_offline.td3_bc import TD3BC

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

#: All algorithms by the names that configs and the command line use.
ALGOS: dict[str, type[OfflineAlgorithm]] = {
    "awac": AWAC,
    "bc": BC,
    "ceborl": CEBORL,
    "cql": CQL,
    "dcql": DCQL,
    "iql": IQL,
    "oril": ORIL,
    "rce": RCE,
    "rebrac": ReBRAC,
    "td3_bc": TD3BC,
}

__all__ = [
    "ALGOS",
    "AWAC",
    "BC",
    "CEBORL",
    "CQL",
    "DCQL",
    "IQL",
    "ORIL",
    "RCE",
    "TD3BC",
    "OfflineAlgorithm",
    "ReBRAC",
    "__version__",
]
