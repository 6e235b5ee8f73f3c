"""Observations of Discrete and MultiDiscrete spaces may count from any number: every algorithm learns and plays the same."""

import numpy as np
import pytest
from data_files import ACTIONS
from gymnasium import spaces

from sb3_offline import ALGOS
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.data.writer import DatasetWriter

FROM_ZERO = spaces.Dict({"one": spaces.Discrete(3), "two": spaces.MultiDiscrete([2, 3])})
SHIFTED = spaces.Dict({"one": spaces.Discrete(3, start=5), "two": spaces.MultiDiscrete([2, 3], start=[1, -4])})


def shifted(observations, space):
    return {key: part + space[key].start for key, part in observations.items()}


@pytest.mark.parametrize("name", ALGOS)
def test_choices_count_from_any_number(name, tmp_path):
    rng = np.random.default_rng(0)
    observations = {"one": rng.integers(3, size=9), "two": rng.integers([2, 3], size=(9, 2))}
    actions = np.stack([ACTIONS.sample() for _ in range(8)])
    played = []
    for space in (FROM_ZERO, SHIFTED):
        path = tmp_path / f"{len(played)}.h5"
        with DatasetWriter(path, space, ACTIONS, success=False) as writer:
            writer.add_episode(shifted(observations, space), actions, rewards=np.arange(8.0))
        needs_examples = issubclass(ALGOS[name], ExampleBasedAlgorithm)
        kwargs = {"examples": shifted({k: v[:4] for k, v in observations.items()}, space)} if needs_examples else {}
        model = ALGOS[name]("MultiInputPolicy", None, path, seed=0, batch_size=16, policy_kwargs={"net_arch": [8]}, **kwargs)
        played.append(model.learn(3).predict(shifted(observations, space), deterministic=True)[0])
    np.testing.assert_array_equal(*played)
