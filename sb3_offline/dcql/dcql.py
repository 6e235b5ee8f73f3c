"""d-CQL: CQL on the distance to goals."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.common.example_based import ExampleBasedAlgorithm, ExamplesLike
from sb3_offline.common.hyperparameters import POSITIVE, Constraints, Options
from sb3_offline.common.search import Choice, SearchSpace, log_uniform
from sb3_offline.cql.cql import CQL
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples
from sb3_offline.data.reader import DatasetLike
from sb3_offline.dcql.distances import ObservationVectors, mean_distance


class DCQL(ExampleBasedAlgorithm, CQL):
    """
    CQL with a naive reward (d-CQL), the negative mean distance between an observation and the success examples::

        r(s) = -reward_scale E_{s* ~ S*}[|s - s*|]

    Pixels lie in [0, 1]; vectors are standardised by the dataset. The rewards are computed once, when the dataset is opened.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: see :class:`~sb3_offline.cql.cql.CQL`
    :param dataset: see :class:`~sb3_offline.cql.cql.CQL`; its rewards are not used
    :param examples: Success examples S*: a folder of images, an ``.npz`` or HDF5 file, or an array of observations. All of
        them are goals.
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param distance: ``"l2"``, the Euclidean norm of the difference, or ``"mse"``, the mean of its squares
    :param reward_scale: factor of the rewards
    :param cql_alpha: weight of the conservative term, see :class:`~sb3_offline.cql.cql.CQL`
    :param ent_coef: Entropy coefficient, see :class:`~sb3_offline.cql.cql.CQL`
    :param kwargs: the other arguments of :class:`~sb3_offline.cql.cql.CQL`, but no ``reward_fn``
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "distance": [Options(("l2", "mse"))],
        "reward_scale": [POSITIVE],
    }
    search_space: ClassVar[SearchSpace] = {
        **CQL.search_space,
        "ent_coef": log_uniform(1e-5, 0.1),
        "distance": Choice("l2", "mse"),
        "reward_scale": log_uniform(1e-3, 10),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        distance: str = "l2",
        reward_scale: float = 1.0,
        cql_alpha: float | str = 0.1,
        ent_coef: float | str = 1e-4,
        **kwargs: Any,
    ):
        if "reward_fn" in kwargs:
            raise TypeError("DCQL makes its rewards from the examples; for other rewards use CQL(..., reward_fn=...)")
        if "example_batch_size" in kwargs:
            raise TypeError("DCQL compares each observation with all examples, so it has no example_batch_size; leave it out")
        self.distance = distance
        self.reward_scale = reward_scale
        super().__init__(
            policy,
            env,
            dataset,
            examples,
            learning_rate=learning_rate,
            cql_alpha=cql_alpha,
            ent_coef=ent_coef,
            **kwargs,
        )

    def _data_inputs(self) -> tuple[Any, ...]:
        return (*super()._data_inputs(), self.examples)

    def relabel(self, buffer: OfflineReplayBuffer) -> None:
        statistics = None if self._observations_normalized else self.replay_buffer.observation_statistics
        vectors = ObservationVectors(self.example_space, statistics)
        goals = vectors(self.all_examples())

        def reward(batch: OfflineSamples) -> th.Tensor:
            return -self.reward_scale * mean_distance(vectors(batch.observations), goals, self.distance)

        buffer.relabel(reward, self._vec_normalize_env)
