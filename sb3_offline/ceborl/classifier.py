"""The recursive classifier of success: terms (b) and (c) of Eq. 10, and the one ``train()`` of all that is built on it."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_offline.ceborl.backups import Backup
from sb3_offline.ceborl.extraction import CriticStep, PolicyExtraction
from sb3_offline.ceborl.losses import example_loss, recursive_loss, success_odds
from sb3_offline.common.example_based import ExampleBasedAlgorithm, ExamplesLike
from sb3_offline.common.hyperparameters import NOT_NEGATIVE, POSITIVE, SHARE, Constraints, check_parameters
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace, Uniform
from sb3_offline.data.buffer import OfflineReplayBuffer, OfflineSamples, joined
from sb3_offline.data.reader import DatasetLike

#: Gradient steps between two looks at the diagnostics that need extra forward passes.
DIAGNOSTICS_INTERVAL = 50


class RecursiveClassifier(ExampleBasedAlgorithm):
    """
    The base of CEBORL and RCE: a classifier C(s, a) of success in the discounted future, trained by recursive classification::

        min  (1 - gamma) E_{s ~ S*, a ~ pi}[CE(C(s, a); y = 1)]                                  (b)
             + E_D[(1 + gamma omega) CE(C(s, a); y = gamma omega / (1 + gamma omega))]           (c)

    A subclass chooses the backup, from which omega is made, and the policy extraction; it may add a penalty, term (a).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param dataset: see :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`
    :param examples: see :class:`~sb3_offline.common.example_based.ExampleBasedAlgorithm`
    :param example_share: weight of the examples among the data of (c)
    :param initial_odds: odds of the untrained classifier
    :param ent_coef: entropy coefficient of policy extractions that maximise the classifier
    :param kwargs: see :class:`~sb3_offline.common.example_based.ExampleBasedAlgorithm`
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "example_share": [SHARE],
        "initial_odds": [POSITIVE],
        "ent_coef": [NOT_NEGATIVE],
    }
    search_space: ClassVar[SearchSpace] = {**BOOTSTRAPPING, "example_share": Uniform(0, 0.1)}
    value_name: ClassVar[str | None] = "C(s, a)"
    #: upper bound of omega, against overflow. Values of 20 to 60 are normal, so it is far above
    omega_max: float = 1e4
    #: weight of the examples in (b), p(e = 1), which the paper drops
    class_prior: float = 1.0
    _backup: Backup
    _extraction: PolicyExtraction

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        *,
        example_share: float = 0.0,
        initial_odds: float = 1.0,
        ent_coef: float = 1e-4,
        **kwargs: Any,
    ):
        super().__init__(policy, env, dataset, examples, **kwargs)
        self.example_share = example_share
        self.initial_odds = initial_odds
        self.ent_coef = ent_coef
        # Between a saved model and the parts of the loaded one
        self._extraction_state: Any = None
        self._backup_state: Any = None

    def _make_parts(self) -> tuple[Backup, PolicyExtraction]:
        """:return: a new backup and a new policy extraction, as the constructor's arguments say"""
        raise NotImplementedError

    def _setup_model(self) -> None:
        check_parameters(self)  # before the parts are chosen by them
        self._backup, self._extraction = self._make_parts()
        self.needs_next_actions = self._backup.needs_next_actions
        if "_weighted_transitions" in self.__dict__:  # of a zip that an earlier version saved
            self._extraction_state = self.__dict__.pop("_weighted_transitions"), self.__dict__.pop("_dataset_checksum")
        for part, name in ((self._backup, "_backup_state"), (self._extraction, "_extraction_state")):
            if self.__dict__.get(name) is not None:
                part.set_state(getattr(self, name))
                setattr(self, name, None)
        super()._setup_model()

    def all_policy_kwargs(self) -> dict[str, Any]:
        own: dict[str, Any] = {"critic_output_bias": math.log(self.initial_odds)}
        if self._extraction.needs_state_head or self._backup.fits_state_head:
            own["critic_state_value"] = True
        own |= self._extraction.policy_kwargs()
        if self.examples_lack_keys:  # the classifier sees what examples show, and the policy has an encoder of its own
            own |= {"critic_keys": self.example_keys, "share_features_extractor": False}
        return {**own, **self.policy_kwargs}

    def _open_data(self) -> None:
        super()._open_data()
        self.read_examples()

    def _on_data_opened(self, buffer: OfflineReplayBuffer) -> None:
        super()._on_data_opened(buffer)
        self._backup.start(buffer)
        self._extraction.start(buffer.checksum(), buffer.size())

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        for _ in range(gradient_steps):
            batch = self._backup.sample(batch_size)
            observations = self.augment(batch.observations)
            examples, example_rows = self.sample_examples()
            examples = self.augment(examples)
            # One pass of the encoder for both: for a small batch, reading the weights takes longer than encoding its images
            features, distinct_features = self.critic.encode(
                joined([self.seen_in_examples(observations), examples])
            ).tensor_split([batch_size])
            example_features = distinct_features[example_rows]
            with th.no_grad():
                example_actions = self._example_actions(examples, example_features, example_rows, batch.actions)
                discounted_omega = self._backup.discounted_omega(batch)
                example_omega = None
                if self.example_share > 0:  # the examples count among the data of term (c)
                    example_omega = self._backup.example_omega(examples, example_rows, example_actions)

            # Eq. 10. The rows of `logits` are the critics; a head of states may be one more classifier, the last row.
            both_features = th.cat([features, example_features])
            logits = self.critic.values(both_features, th.cat([batch.actions, example_actions]))
            data_logits, example_logits = logits[:, :batch_size], logits[:, batch_size:]
            if self._extraction.needs_state_head and not self._backup.fits_state_head:
                logits = th.cat([logits, self.critic.state_values(both_features).unsqueeze(0)])
                state_logits = logits[-1, :batch_size]
            term_c = recursive_loss(logits[:, :batch_size], discounted_omega)
            term_b = self._example_term(logits[:, batch_size:], example_omega)
            term_a = self._conservative_term(observations, features, data_logits)
            critic_loss = term_c + term_b + term_a
            if self._backup.fits_state_head:
                state_logits, state_loss = self._backup.state_loss(observations, features, batch.actions, discounted_omega)
                critic_loss = critic_loss + state_loss
            self._optimize(self.critic.optimizer, critic_loss)

            assert batch.indices is not None
            step = CriticStep(
                observations,
                features,
                batch.indices,
                discounted_omega,
                data_logits.detach(),
                self._backup.success_odds(example_logits.detach()),
                state_logits.detach() if self._extraction.needs_state_head else None,
            )
            actor_loss = self._extraction.actor_loss(step)
            self._optimize(self.actor.optimizer, actor_loss)

            self._n_updates += 1
            self._update_target()
            self._record(
                critic_loss=critic_loss,
                actor_loss=actor_loss,
                classifier_data=data_logits.sigmoid().mean(),
                classifier_examples=example_logits.sigmoid().mean(),
            )
            if self._n_updates % DIAGNOSTICS_INTERVAL == 0:
                self._record_diagnostics(observations, features, discounted_omega / self.gamma)

    def _conservative_term(self, observations: PyTorchObs, features: th.Tensor, data_logits: th.Tensor) -> th.Tensor:
        """
        Term (a) with its weight; none here.

        :param observations: a batch
        :param features: the critic's features of it, ``(batch, features_dim)``
        :param data_logits: logits of the dataset's actions, ``(n_critics, batch)``
        :return: scalar
        """
        return data_logits.new_zeros(())

    def _example_actions(
        self, examples: PyTorchObs, features: th.Tensor, rows: th.Tensor, data_actions: th.Tensor
    ) -> th.Tensor:
        """
        Choose actions for the examples of term (b): the policy's. Where examples lack keys that the policy sees, it cannot be
        asked, and actions of the dataset take the place of its own: an example counts as success with whatever is done there.

        :param examples: distinct examples, shifted as in training
        :param features: the critic's features of each place in the batch of examples, ``(example batch, features_dim)``
        :param rows: for each place its row in ``examples``
        :param data_actions: the dataset's actions of the batch, ``(batch, action_dim)``
        :return: ``(example batch, action_dim)``
        """
        if self.examples_lack_keys:
            return data_actions[th.randint(len(data_actions), (len(rows),), device=data_actions.device)]
        return self.actor.sample(self._policy_features(examples, features, rows))[0]

    def _example_term(self, logits: th.Tensor, example_omega: th.Tensor | None) -> th.Tensor:
        """Term (b), and the examples' part of term (c), which bounds the odds by ``1 / example_share``."""
        loss = example_loss(logits, self.gamma, self.class_prior)
        if example_omega is not None:
            loss = loss + self.example_share * recursive_loss(logits, example_omega)
        return loss

    @th.no_grad()
    def _record_diagnostics(self, observations: PyTorchObs, features: th.Tensor, omega: th.Tensor) -> None:
        actions, log_prob = self.actor.sample(self._policy_features(observations, features))
        p50, p99 = th.quantile(omega, th.tensor([0.5, 0.99], device=omega.device))
        self._record(
            log_prob=log_prob.mean(),
            classifier_policy=self.critic.values(features, actions).amin(dim=0).sigmoid().mean(),
            omega_p50=p50,
            omega_p99=p99,
        )

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        self._backup_state, self._extraction_state = self._backup.get_state(), self._extraction.get_state()
        super().save(path, exclude, include)
        self._backup_state = self._extraction_state = None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_backup", "_extraction"]

    @th.no_grad()
    def values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor | None:
        return self.critic.values(self.critic.encode(observations), actions).amin(dim=0).sigmoid()

    def some_data_actions(self, n: int) -> th.Tensor:
        """:return: ``(n, action_dim)`` actions of the dataset, the same ones each time"""
        buffer = self.replay_buffer
        return buffer.pairs(np.random.default_rng(0).integers(buffer.size(), size=n), self._vec_normalize_env)[1]

    def success_probabilities(self, observations: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor | None:
        if actions is None and isinstance(observations, dict) and len(observations) < len(self.observation_space.spaces):  # type: ignore
            actions = self.some_data_actions(len(next(iter(observations.values()))))  # examples, which the policy cannot see
        if actions is None:
            actions = self.policy._predict(observations, deterministic=True)  # type: ignore[arg-type]
        return self.values(observations, actions)

    @th.no_grad()
    def td_errors(self, batch: OfflineSamples) -> th.Tensor | None:
        """See :meth:`OfflineAlgorithm.td_errors`; these are errors of the probabilities in the recursion."""
        logits = self.critic.values(self.critic.encode(batch.observations), batch.actions)
        omega = self.gamma * success_odds(self._next_values(batch), self.omega_max)
        return (logits.sigmoid() - omega / (1 + omega)).abs().mean(dim=0)
