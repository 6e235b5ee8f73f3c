"""
Policy extraction: how the policy is made of the classifier.

An extraction is a small object that says what it needs of the networks, owns the state that it keeps between gradient steps,
and gives the actor's loss.
"""

from typing import Any, ClassVar, NamedTuple, Protocol

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.ceborl.losses import OVERFLOW, odds_ratio_weights, success_odds
from sb3_offline.ceborl.resampling import WeightedTransitions


class CriticStep(NamedTuple):
    """
    The critic's part of a gradient step, of which an extraction takes what it needs. No gradient but that of ``features``.

    :param observations: the batch, shifted as in training
    :param features: the critic's features, ``(batch, features_dim)``
    :param indices: indices of the transitions in the dataset, ``(batch,)``
    :param discounted_omega: ``gamma * omega`` of each transition, ``(batch,)``
    :param data_logits: logits of the dataset's actions, ``(n_critics, batch)``
    :param example_logits: logits of the success examples, ``(n_critics, example batch)``
    :param state_logits: logits of the head of states, ``(batch,)``; ``None`` without that head
    """

    observations: PyTorchObs
    features: th.Tensor
    indices: th.Tensor
    discounted_omega: th.Tensor
    data_logits: th.Tensor
    example_logits: th.Tensor
    state_logits: th.Tensor | None


class Learner(Protocol):
    """What extractions ask of their model: networks, data, and the constructor's arguments, which may change in training."""

    actor: Any
    replay_buffer: Any
    augment: Any
    ent_coef: float
    _policy_features: Any
    _record: Any
    _values_of_policy: Any
    _vec_normalize_env: Any


class WeightingLearner(Learner, Protocol):
    """What :class:`WeightedRegression` asks of its model in addition."""

    advantage: str
    temperature: float
    advantage_floor: float
    weight_max: float
    state_exponent: float
    policy_batches: int
    policy_random_shift: int | None


class PolicyExtraction:
    """
    The base of all policy extractions.

    :param model: the model whose policy is learned
    """

    #: whether the critic has a head of states without an action
    needs_state_head: ClassVar[bool] = False
    #: whether the policy imitates observations of its own, which may be shifted otherwise than the critic's
    imitates: ClassVar[bool] = False
    #: floor of the policy's standard deviation before the tanh; ``None`` for the policy's own default
    std_min: ClassVar[float | None] = None

    def __init__(self, model: Any):
        self.model = model

    def actor_loss(self, step: CriticStep) -> th.Tensor:
        """
        :param step: the critic's part of this gradient step
        :return: the actor's loss, a scalar
        """
        raise NotImplementedError

    def start(self, checksum: int) -> None:
        """
        Called when the data are open.

        :param checksum: checksum of the dataset; state that belongs to another dataset is dropped
        """

    def get_state(self) -> Any:
        """:return: what a saved model keeps; ``None`` if there is nothing"""
        return None

    def set_state(self, state: Any) -> None:
        """:param state: what :meth:`get_state` of the saved model returned"""


class Maximization(PolicyExtraction):
    """The paper's Eq. 11: ``max E[C(s, a) - ent_coef log pi(a | s)]``, ``a ~ pi(s)``, with the lower of the critics."""

    model: Learner

    def actor_loss(self, step: CriticStep) -> th.Tensor:
        actions, log_prob = self.model.actor.sample(self.model._policy_features(step.observations, step.features))
        classifier = self.model._values_of_policy(step.features, actions).amin(dim=0).sigmoid()
        return (self.model.ent_coef * log_prob - classifier).mean()  # type: ignore[no-any-return]


class WeightedRegression(PolicyExtraction):
    """
    The policy imitates the dataset's actions, weighted by their advantage. The transitions of the last batches are kept with
    their weights, and the policy learns from those that are drawn by weight.
    """

    needs_state_head = True
    imitates = True
    std_min = 0.05
    model: WeightingLearner

    def __init__(self, model: WeightingLearner):
        super().__init__(model)
        self.pool = WeightedTransitions(model.policy_batches)
        self.checksum: int | None = None  # of the dataset that the pool's indices belong to

    def get_state(self) -> Any:
        return self.pool, self.checksum

    def set_state(self, state: Any) -> None:
        self.pool, self.checksum = state

    def start(self, checksum: int) -> None:
        # A loaded model may have another dataset, or keep more or fewer batches
        if (checksum, self.model.policy_batches) != (self.checksum, self.pool.n_batches):
            self.pool, self.checksum = WeightedTransitions(self.model.policy_batches), checksum

    def actor_loss(self, step: CriticStep) -> th.Tensor:
        self.pool.add(step.indices, self.weights(step))
        features, actions = self._draw(len(step.indices))
        loss = self.model.actor.regression_loss(features, actions).mean()
        self.model._record(effective_weights=self.pool.effective_share())
        return loss  # type: ignore[no-any-return]

    def weights(self, step: CriticStep) -> th.Tensor:
        """:return: the advantage weights of a batch, ``(batch,)``"""
        assert step.state_logits is not None
        outcomes = {"return": lambda: step.discounted_omega, "value": lambda: success_odds(step.data_logits, OVERFLOW)}
        return odds_ratio_weights(
            outcomes[self.model.advantage](),
            step.state_logits,
            step.example_logits,
            self.model.temperature,
            self.model.advantage_floor,
            self.model.weight_max,
            self.model.state_exponent,
        )

    def _draw(self, n: int) -> tuple[th.Tensor, th.Tensor]:
        """:return: the policy's features and the dataset's actions of n kept transitions, drawn by their weights"""
        model = self.model
        observations, actions = model.replay_buffer.pairs(self.pool.draw(n), env=model._vec_normalize_env)
        return model.actor.encode(model.augment(observations, model.policy_random_shift)), actions


#: By the names that ``policy_extraction`` takes.
EXTRACTIONS: dict[str, type[PolicyExtraction]] = {"weighted": WeightedRegression, "maximize": Maximization}
