"""
Policy extraction: how the policy is made of the classifier.

An extraction is a small object that says what it needs of the networks, owns the state that it keeps between gradient steps,
and gives the actor's loss.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_offline.ceborl.losses import OVERFLOW, odds_ratio_weights, success_odds
from sb3_offline.ceborl.resampling import WeightedTransitions
from sb3_offline.common.augmentation import has_images


class CriticStep(NamedTuple):
    """
    The critic's part of a gradient step, of which an extraction takes what it needs. No gradient but that of ``features``.

    :param observations: the batch, shifted as in training
    :param features: the critic's features, ``(batch, features_dim)``
    :param indices: indices of the transitions in the dataset, ``(batch,)``
    :param discounted_omega: ``gamma * omega`` of each transition, ``(batch,)``
    :param data_logits: logits of the dataset's actions, ``(n_critics, batch)``
    :param success: the odds of success itself, as the backup counts them, scalar
    :param state_logits: logits of the head of states, ``(batch,)``; ``None`` without that head
    """

    observations: PyTorchObs
    features: th.Tensor
    indices: th.Tensor
    discounted_omega: th.Tensor
    data_logits: th.Tensor
    success: th.Tensor
    state_logits: th.Tensor | None


def _odds_of_actions(step: CriticStep) -> th.Tensor:
    return success_odds(step.data_logits, OVERFLOW)


#: By the names that ``advantage`` takes: the outcomes that the advantage weights compare with the odds of the states
ADVANTAGES: dict[str, Callable[[CriticStep], th.Tensor]] = {
    "return": lambda step: step.discounted_omega,
    "value": _odds_of_actions,
    "mean": lambda step: (step.discounted_omega * _odds_of_actions(step)).sqrt(),
}


class Learner(Protocol):
    """What extractions ask of their model: networks, data, and the constructor's arguments, which may change in training."""

    actor: Any
    observation_space: Any
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
    state_exponent: float


class PolicyExtraction:
    """
    The base of all policy extractions.

    :param model: the model whose policy is learned
    """

    #: whether the critic has a head of states without an action
    needs_state_head: ClassVar[bool] = False

    def __init__(self, model: Any):
        self.model = model

    def policy_kwargs(self) -> dict[str, Any]:
        """:return: arguments of the policy that suit this extraction, where the user says nothing"""
        return {}

    def actor_loss(self, step: CriticStep) -> th.Tensor:
        """
        :param step: the critic's part of this gradient step
        :return: the actor's loss, a scalar
        """
        raise NotImplementedError

    def start(self, checksum: int, n_transitions: int) -> None:
        """
        Called when the data are open.

        :param checksum: checksum of the dataset; state that belongs to another dataset is dropped
        :param n_transitions: number of transitions of the dataset
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
    The policy imitates the dataset's actions, weighted by their advantage. Each transition keeps the weight that it had when
    the critic last saw it, and the policy learns from those that are drawn by weight.
    """

    needs_state_head = True
    #: odds, as a share of the odds of success, below which advantages are noise
    advantage_floor: float = 0.01
    #: odds, as a share of the odds of success, below which states and outcomes count little
    promise_floor: float = 0.1
    #: upper bound of the advantage weights
    weight_max: float = 100.0
    model: WeightingLearner

    def __init__(self, model: WeightingLearner):
        super().__init__(model)
        self.pool = WeightedTransitions(0)
        self.checksum: int | None = None  # of the dataset that the weights belong to

    def policy_kwargs(self) -> dict[str, Any]:
        if hasattr(self.model, "policy_batches"):  # an earlier version saved the model
            return {"std_min": 0.05}
        # The policy imitates few transitions, which it would learn by heart. It has an encoder of its own for images, because
        # features that tell success apart need not tell which action is good
        own_encoder = has_images(self.model.observation_space)
        return {"std_min": 0.05, "actor_dropout": 0.2, "share_features_extractor": not own_encoder}

    def get_state(self) -> Any:
        return self.pool, self.checksum

    def set_state(self, state: Any) -> None:
        self.pool, self.checksum = state

    def start(self, checksum: int, n_transitions: int) -> None:
        if (checksum, n_transitions) != (self.checksum, len(self.pool.weights)):  # a loaded model may have another dataset
            self.pool, self.checksum = WeightedTransitions(n_transitions), checksum

    def actor_loss(self, step: CriticStep) -> th.Tensor:
        self.pool.add(step.indices, self.weights(step))
        features, actions = self._draw(len(step.indices))
        loss = self.model.actor.regression_loss(features, actions).mean()
        self.model._record(effective_weights=self.pool.effective_share())
        return loss  # type: ignore[no-any-return]

    def weights(self, step: CriticStep) -> th.Tensor:
        """:return: the advantage weights of a batch, ``(batch,)``"""
        assert step.state_logits is not None
        return odds_ratio_weights(
            ADVANTAGES[self.model.advantage](step),
            step.state_logits,
            step.success,
            self.model.temperature,
            self.advantage_floor,
            self.promise_floor,
            self.weight_max,
            self.model.state_exponent,
        )

    def _draw(self, n: int) -> tuple[th.Tensor, th.Tensor]:
        """:return: the policy's features and the dataset's actions of n kept transitions, drawn by their weights"""
        model = self.model
        observations, actions = model.replay_buffer.pairs(self.pool.draw(n), env=model._vec_normalize_env)
        return model.actor.encode(model.augment(observations)), actions


#: By the names that ``policy_extraction`` takes.
EXTRACTIONS: dict[str, type[PolicyExtraction]] = {"weighted": WeightedRegression, "maximize": Maximization}
