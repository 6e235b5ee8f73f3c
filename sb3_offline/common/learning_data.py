"""The life of the data that a model learns from: opening, checking, fitting, relabelling, and where sampling goes on."""

from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_offline.common.normalization import normalizes
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.reader import OfflineDataset, open_datasets


class Learner(Protocol):
    """What :class:`LearningData` asks of its model. All of these may be replaced between two openings, as ``load`` does."""

    dataset: Any
    dataset_storage: Any
    observation_space: Any
    action_space: Any
    device: Any
    n_stack: int
    n_steps: Any
    gamma: float
    seed: Any
    needs_next_actions: bool
    policy: Any
    _vec_normalize_env: Any
    _sampler_state: dict[str, Any] | None
    _observations_normalized: bool

    def _data_inputs(self) -> tuple[Any, ...]: ...

    def _on_data_opened(self, buffer: OfflineReplayBuffer) -> None: ...

    def relabel(self, buffer: OfflineReplayBuffer) -> None: ...


class LearningData:
    """
    The data of one model, opened once.

    :meth:`open` opens the dataset, checks it against the model's spaces, restores the state of the sampling generator, fits
    the statistics of observations, and relabels. It does so again only where an input of the model was replaced.

    :param learner: the model
    """

    def __init__(self, learner: Learner):
        self._learner = learner
        self._opened: tuple[Any, list[OfflineDataset]] = (None, [])
        self._inputs: tuple[Any, ...] = ()
        #: the open buffer, if any
        self.buffer: OfflineReplayBuffer | None = None

    def datasets(self, dataset: Any) -> list[OfflineDataset]:
        """
        :param dataset: a path, a glob pattern, a dataset, or a list of these
        :return: the open datasets; the same ones if they were opened before
        """
        if self._opened[0] is not dataset:
            self._opened = (dataset, open_datasets(dataset))
        return self._opened[1]

    def open(self) -> OfflineReplayBuffer:
        """
        :return: the buffer, ready to sample from; raises ``RuntimeError`` if the model has no dataset, and ``DatasetError``
            if the data do not fit it
        """
        learner = self._learner
        replaced = any(new is not old for new, old in zip(learner._data_inputs(), self._inputs, strict=False))
        if self.buffer is not None and not replaced:
            return self.buffer
        if learner.dataset is None:
            raise RuntimeError(
                f"{type(learner).__name__} has no dataset to learn from: pass `dataset=` to the constructor, "
                "or `load(path, dataset=...)`"
            )
        buffer = OfflineReplayBuffer(
            self.datasets(learner.dataset),
            learner.observation_space,
            learner.action_space,
            device=learner.device,
            n_steps=learner.n_steps,
            gamma=learner.gamma,
            storage=learner.dataset_storage,
            n_stack=learner.n_stack,
            next_actions=learner.needs_next_actions,
            seed=learner.seed,
        )
        self.adopt(buffer)
        self.restore_generator()
        self._prepare(buffer)
        return buffer

    def adopt(self, buffer: Any) -> None:
        """
        :param buffer: is taken for the open buffer, as it is; ``None`` to open the dataset anew at the next use
        """
        self.buffer = buffer
        self._inputs = self._learner._data_inputs() if buffer is not None else ()

    def restore_generator(self) -> None:
        """Set the sampling generator to the state that the model was saved with or seeded with, if any."""
        if self.buffer is not None and self._learner._sampler_state is not None:
            self.buffer.set_rng_state(self._learner._sampler_state)

    def _prepare(self, buffer: OfflineReplayBuffer) -> None:
        """Fit and relabel; or forget the buffer, so that no model learns from data that are half prepared."""
        try:
            self._fit_observation_statistics(buffer)
            self._learner.relabel(buffer)
            self._learner._on_data_opened(buffer)
        except BaseException:
            self.buffer = None
            raise

    def _fit_observation_statistics(self, buffer: OfflineReplayBuffer) -> None:
        normalizer = self._learner._vec_normalize_env
        self.check_normalizer(normalizer)
        self._learner._observations_normalized = normalizes(normalizer)
        if not normalizes(normalizer):
            self._learner.policy.fit_observation_statistics(buffer.observation_statistics)
        elif normalizer.training:
            # No rollout fits the running statistics of a VecNormalize here, so they come from the dataset
            statistics = buffer.observation_statistics()
            running = normalizer.obs_rms if isinstance(normalizer.obs_rms, dict) else {"": normalizer.obs_rms}
            for key, rms in running.items():
                rms.mean, rms.var, rms.count = statistics[key] if key else statistics

    def check_normalizer(self, normalizer: VecNormalize | None) -> None:
        """
        :param normalizer: the environment's, if any; raises ``RuntimeError`` if the policy was fitted to observations that
            were normalised otherwise
        """
        if normalizes(normalizer) and self._learner.policy.standardizes:
            raise RuntimeError(
                "The policy was fitted to plain observations, but the environment is a VecNormalize that normalises them; "
                "use the environment without it, or train a new model with it"
            )
        if self._learner._observations_normalized and not normalizes(normalizer):
            raise RuntimeError(
                "The policy was fitted to observations that a VecNormalize normalised, but the environment is not normalised; "
                "give the normalised one: set_env, or load(path, env=...)"
            )

    def prepare_again(self) -> None:
        """Repeat all that depends on the normaliser of the environment, which was replaced."""
        buffer = self.buffer
        if buffer is None:
            return
        rewards = buffer.rewards
        buffer.restore_rewards()
        self._prepare(buffer)
        if not buffer.is_relabelled:
            buffer.rewards = rewards  # those that load_replay_buffer brought

    def go_on_from(self, saved: OfflineReplayBuffer) -> bool:
        """
        Take over the state of a saved buffer: where it was in its data, and its rewards where they were relabelled.

        :param saved: the saved buffer
        :return: whether it is over the same data; otherwise nothing is taken over
        """
        own = self.open()
        if not np.array_equal(own.actions, saved.actions):
            return False
        own.set_rng_state(saved.get_rng_state())
        if saved.is_relabelled and not own.is_relabelled:
            own.rewards = saved.rewards
        return True
