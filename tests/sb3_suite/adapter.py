"""An algorithm of this library in the place of SAC: what the tests of Stable-Baselines3 construct."""

import inspect
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_offline import OfflineAlgorithm
from sb3_offline.data.examples import save_examples
from sb3_offline.data.spaces import space_to_json
from sb3_offline.data.writer import DatasetWriter

FOLDER = Path(tempfile.mkdtemp(prefix="sb3_suite_"))
# One timestep is one gradient step here, and some tests ask for thousands. And CEBORL starts its critics at log(0.01), where
# a step of Adam is less than the tolerance of a test.
SMALL = {"batch_size": 8, "example_batch_size": 8, "n_action_samples": 2, "reward_steps": 4, "initial_odds": 1.0}
N_EPISODES, STEPS = 4, 25


def in_place_of_sac(algorithm: type[OfflineAlgorithm]) -> type[OfflineAlgorithm]:
    """
    :param algorithm: of ``sb3_offline.ALGOS``
    :return: the same with SAC's signature: what concerns collecting, and has no meaning offline, is dropped; datasets and
        examples are made up from the environment's spaces
    """
    known: set[str] = set()
    for cls in algorithm.__mro__:
        parameters = inspect.signature(cls.__init__).parameters
        known |= parameters.keys() - {"self", "args", "kwargs"}
        if "kwargs" not in parameters:
            break  # what it does not name, it does not take

    if algorithm.__name__ == "DCQL":
        known.remove("example_batch_size")  # it compares with all examples

    class InPlaceOfSAC(algorithm):  # type: ignore[valid-type, misc]
        def __init__(
            self, policy: Any, env: Any = None, learning_rate: Any = 3e-4, _init_setup_model: bool = True, **kwargs: Any
        ):
            kept = {name: value for name, value in kwargs.items() if name in known and not isinstance(value, str | tuple)}
            kept |= {name: kwargs[name] for name in ("device", "tensorboard_log") if name in kwargs}
            kept |= {name: value for name, value in SMALL.items() if name in known and name not in kept}
            super().__init__(policy, env, learning_rate=learning_rate, _init_setup_model=False, **kept)
            if _init_setup_model:
                self._setup_model()

        def _setup_model(self) -> None:
            super()._setup_model()
            if self.dataset is None:
                self.dataset = dataset_for(self.observation_space, self.action_space)
            if "examples" in vars(self) and self.examples is None:
                self.examples = examples_for(self.observation_space)

        def learn(
            self, total_timesteps: int, callback: Any = None, log_interval: int = 4, tb_log_name: str = "SAC", **kwargs: Any
        ):
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, **kwargs)

    InPlaceOfSAC.__name__ = InPlaceOfSAC.__qualname__ = algorithm.__name__
    globals()[algorithm.__name__] = InPlaceOfSAC  # so that it pickles
    return InPlaceOfSAC


def dataset_for(observation_space: spaces.Space, action_space: spaces.Box) -> str:
    """:return: path of a dataset of random steps; the same one for the same spaces"""
    name = f"{abs(hash((space_to_json(observation_space), space_to_json(action_space))))}.h5"
    if not (FOLDER / name).exists():
        rng = np.random.default_rng(0)
        with DatasetWriter(FOLDER / name, observation_space, action_space, success=False) as writer:
            for _ in range(N_EPISODES):
                observations, actions = (draw(s, n, rng) for s, n in ((observation_space, STEPS + 1), (action_space, STEPS)))
                writer.add_episode(observations, actions, rewards=np.linspace(0, 1, STEPS))
    return str(FOLDER / name)


def examples_for(observation_space: spaces.Space) -> str:
    """:return: path of some observations; the same ones for the same space"""
    path = FOLDER / f"examples_{abs(hash(space_to_json(observation_space)))}.h5"
    if not path.exists():
        save_examples(path, draw(observation_space, 8, np.random.default_rng(1)), observation_space)
    return str(path)


def draw(space: spaces.Space, n: int, rng: np.random.Generator) -> Any:
    """:return: so many random elements, which do not depend on whether the space stands in a Dict"""
    if isinstance(space, spaces.Dict):
        return {key: draw(part, n, rng) for key, part in space.items()}
    if isinstance(space, spaces.Box) and space.dtype.kind == "f":
        low, high = np.clip(space.low, -10, 10), np.clip(space.high, -10, 10)
        return rng.uniform(low, high, (n, *space.shape)).astype(space.dtype)
    space.seed(int(rng.integers(2**31)))
    return np.stack([space.sample() for _ in range(n)])
