"""Offline reinforcement learning for Stable-Baselines3, from rewards or from examples of success."""

from pathlib import Path

import sb3_offline.envs  # noqa: F401  (registers the environments)
from sb3_offline.bc import BC
from sb3_offline.ceborl import CEBORL
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.cql import CQL
from sb3_offline.rce import RCE

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

#: All algorithms by the names that configs and the command line use.
ALGOS: dict[str, type[OfflineAlgorithm]] = {"bc": BC, "ceborl": CEBORL, "cql": CQL, "rce": RCE}

__all__ = ["ALGOS", "BC", "CEBORL", "CQL", "RCE", "OfflineAlgorithm", "__version__"]
