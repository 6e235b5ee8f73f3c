"""Offline reinforcement learning for Stable-Baselines3, from rewards or from examples of success."""

from pathlib import Path

import sb3_offline.envs  # noqa: F401  (registers the environments)

# The registry: an algorithm is one import line here. The command line, the RL Zoo, the conformance tests and the lists in the
# docs follow from it.
from sb3_offline.awac import AWAC as AWAC
from sb3_offline.bc import BC as BC
from sb3_offline.ceborl import CEBORL as CEBORL
from sb3_offline.common.offline_algorithm import OfflineAlgorithm as OfflineAlgorithm
from sb3_offline.common.registry import algorithms_in
from sb3_offline.cql import CQL as CQL
from sb3_offline.data.reader import OfflineDataset as OfflineDataset
from sb3_offline.data.writer import DatasetWriter as DatasetWriter
from sb3_offline.dcql import DCQL as DCQL
from sb3_offline.iql import IQL as IQL
from sb3_offline.labelling.episodes import label_episodes as label_episodes
from sb3_offline.oril import ORIL as ORIL
from sb3_offline.rce import RCE as RCE
from sb3_offline.rebrac import ReBRAC as ReBRAC
from sb3_offline.td3_bc import TD3BC as TD3BC

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

#: All algorithms by the names that configs and the command line use, which are the names of their folders.
ALGOS: dict[str, type[OfflineAlgorithm]] = algorithms_in(globals())
