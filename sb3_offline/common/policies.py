"""
Actor-critic policies of the offline algorithms.

They are SB3's SAC policies with the differences that offline learning needs:

- vectors are standardised with the dataset's statistics;
- the critic trains a shared encoder, where SB3 lets the *actor* train it, and each image is encoded once, however many actions
  are then scored;
- the actor scores given actions, and its standard deviation has a floor;
- the critic may have a head for the value of a state without an action.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn

from sb3_offline.common.choices import CountingFromZero
from sb3_offline.common.fast import encode, linear_heads, mlp, state_action_values
from sb3_offline.common.torch_layers import (
    NormalizedNatureCNN,
    StandardizedCombinedExtractor,
    StandardizedExtractor,
    fit_statistics,
    standardized_encoders,
)
from sb3_offline.data.spaces import subspace

# Actions are clamped to this before atanh, which is infinite on the bounds, where actions of a dataset often lie
ACTION_LIMIT = 0.999
# Added to tanh's slope before its logarithm is taken, as in SB3
SQUASHING_EPSILON = 1e-6
# Floor of standard deviations that are made by a softplus
SOFTPLUS_FLOOR = 1e-3


class EncodingActor(CountingFromZero, BasePolicy):
    """
    Base class of actors, whose encoder may be the critic's.

    :param args: see :class:`stable_baselines3.common.policies.BasePolicy`
    :param detach_encoder: keep the actor's gradients from the encoder, because it belongs to the critic
    :param kwargs: see :class:`stable_baselines3.common.policies.BasePolicy`
    """

    def __init__(self, *args: Any, detach_encoder: bool = True, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.detach_encoder = detach_encoder
        self.mixed_precision: bool | None = False

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "detach_encoder": self.detach_encoder}

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: observations, uint8 images channel-first or float vectors (or a dict of them), batch first
        :return: features to learn from, ``(batch, features_dim)``, in bfloat16 or float32; without a graph if
            ``detach_encoder``
        """
        with th.set_grad_enabled(th.is_grad_enabled() and not self.detach_encoder):
            return encode(partial(stored_features, self), obs, self.mixed_precision)


class OfflineActor(EncodingActor, Actor):
    """
    Tanh-Gaussian actor (policy) that can also score given actions.

    :param args: see :class:`stable_baselines3.sac.policies.Actor`
    :param std_min: floor of the standard deviation *before* the tanh. A positive floor bounds the likelihood of the dataset's
        actions.
    :param std_transform: how the second output becomes the standard deviation: ``"exp"``, its exponential, as in SB3;
        or ``"softplus"``, ``1e-3 + log(1 + exp(output))``, as in the code of RCE's authors
    :param dropout: share of the hidden units that are left out at random when learning
    :param kwargs: see :class:`EncodingActor` and :class:`stable_baselines3.sac.policies.Actor`
    """

    def __init__(self, *args: Any, std_min: float = 0.0, std_transform: str = "exp", dropout: float = 0.0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if std_transform not in ("exp", "softplus"):
            raise TypeError(f"std_transform is {std_transform!r}; give 'exp' or 'softplus'")
        self.std_min, self.std_transform, self.dropout = std_min, std_transform, dropout
        if dropout:
            layers = [
                (layer, nn.Dropout(dropout)) if isinstance(layer, self.activation_fn) else (layer,) for layer in self.latent_pi
            ]
            self.latent_pi = nn.Sequential(*(part for layer in layers for part in layer))
        self.log_std_min = max(LOG_STD_MIN, float(th.tensor(std_min).log())) if std_min > 0 else LOG_STD_MIN

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"std_min": self.std_min, "std_transform": self.std_transform, "dropout": self.dropout}
        return {**super()._get_constructor_parameters(), **own}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if deterministic:  # SB3's distribution gives the same, but checks its numbers, which cannot be exported.
            return th.tanh(self.get_action_dist_params(obs)[0])
        return super().forward(obs, deterministic)

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        # A policy that acts computes in float32, whatever it learned in.
        mean, log_std = self.gaussian_parameters(self.extract_features(obs, self.features_extractor))
        return mean, log_std, {}

    def gaussian_parameters(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: ``(batch, features_dim)``
        :return: mean and log standard deviation of the Gaussian before tanh, each ``(batch, action_dim)``
        """
        assert isinstance(self.mu, nn.Linear) and isinstance(self.log_std, nn.Linear)
        mean, log_std = linear_heads(self.latent_pi, (self.mu, self.log_std), features)
        if self.std_transform == "softplus":
            log_std = th.log(SOFTPLUS_FLOOR + nn.functional.softplus(log_std))
        return mean, th.clamp(log_std, self.log_std_min, LOG_STD_MAX)

    def sample(self, features: th.Tensor, n_samples: int | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        Draw reparametrised actions in [-1, 1], and compute their log-probabilities.

        :param features: ``(batch, features_dim)``
        :param n_samples: actions per state; ``None`` draws one, and the results have no axis for it
        :return: actions ``(batch[, n_samples], action_dim)`` and log-probabilities ``(batch[, n_samples])``
        """
        mean, log_std = self.gaussian_parameters(features)
        if n_samples is not None:
            mean, log_std = mean.unsqueeze(1), log_std.unsqueeze(1)
        noise = th.randn(len(mean), *(() if n_samples is None else (n_samples,)), mean.shape[-1], device=mean.device)
        actions = th.tanh(mean + log_std.exp() * noise)
        return actions, _log_density(actions, log_std, noise.pow(2))

    def log_prob(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]; clamped to +-0.999, where tanh can be inverted
        :return: log-probability density of each action, ``(batch,)``
        """
        mean, log_std = self.gaussian_parameters(features)
        actions = actions.clamp(-ACTION_LIMIT, ACTION_LIMIT)
        return _log_density(actions, log_std, (th.atanh(actions) - mean).pow(2) * th.exp(-2 * log_std))

    def regression_loss(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Add the squared error of the mode and the negative log-likelihood of the standard deviation around that mode.

        This loss is steadier than the likelihood of both together. Before the tanh, an action on the bounds lies far out, and
        a few such actions move the mean of a Gaussian more than all others.

        :param features: ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)`` in [-1, 1]
        :return: loss of each action, ``(batch,)``
        """
        mean, log_std = self.gaussian_parameters(features)
        error = (th.tanh(mean) - actions).pow(2).sum(dim=1)
        actions = actions.clamp(-ACTION_LIMIT, ACTION_LIMIT)
        return error - _log_density(actions, log_std, (th.atanh(actions) - mean.detach()).pow(2) * th.exp(-2 * log_std))


def _log_density(actions: th.Tensor, log_std: th.Tensor, squared_noise: th.Tensor) -> th.Tensor:
    """
    Compute the log-densities of SB3's ``SquashedDiagGaussianDistribution`` with a third of its operations. On so few numbers,
    the number of operations decides how long they take.

    :param actions: tanh of samples of a Gaussian, ``(..., action_dim)``
    :param log_std: logarithm of the Gaussian's standard deviation, broadcast to ``actions``
    :param squared_noise: squared distances of the samples from the mean, in standard deviations, like ``actions``
    :return: log-probability density, ``(...)``
    """
    terms = 0.5 * squared_noise + log_std + th.log(1 + SQUASHING_EPSILON - actions.pow(2))
    return -terms.sum(dim=-1) - 0.5 * math.log(2 * math.pi) * actions.shape[-1]


class OfflineCritic(CountingFromZero, ContinuousCritic):
    """
    Critic networks on one encoder, which their loss trains.

    The parameters not listed here are those of :class:`stable_baselines3.common.policies.ContinuousCritic`.

    :param layer_norm: put a LayerNorm after each hidden linear layer of the heads
    :param output_bias: initial output of the heads, for all states and actions
    :param state_value: add a head that sees the state without an action
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = True,
        layer_norm: bool = False,
        output_bias: float = 0.0,
        state_value: bool = False,
    ):
        # ContinuousCritic's own constructor is skipped, because it would build other heads first.
        super(ContinuousCritic, self).__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.share_features_extractor = share_features_extractor
        self.n_critics = n_critics
        self.mixed_precision: bool | None = False
        modules: list[type[nn.Module]] = [nn.LayerNorm] if layer_norm else []
        input_dims = {f"qf{idx}": features_dim + get_action_dim(action_space) for idx in range(n_critics)}
        if state_value:
            input_dims["vf"] = features_dim
        for name, input_dim in input_dims.items():
            layers = create_mlp(input_dim, 1, net_arch, activation_fn, post_linear_modules=modules)
            nn.init.constant_(layers[-1].bias, output_bias)  # type: ignore[arg-type]
            self.add_module(name, nn.Sequential(*layers))
        self.q_networks = [self.get_submodule(f"qf{idx}") for idx in range(n_critics)]

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: observations, uint8 images channel-first or float vectors (or a dict of them), batch first
        :return: features to learn from, ``(batch, features_dim)``, in bfloat16 or float32
        """
        return encode(partial(stored_features, self), obs, self.mixed_precision)

    def values(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Compute the outputs of all critics, for one or for many actions per state.

        :param features: ``(batch, features_dim)``
        :param actions: ``(batch, action_dim)``, or ``(batch, K, action_dim)``, in [-1, 1]
        :return: ``(n_critics, batch)``, or ``(n_critics, batch, K)``
        """
        return state_action_values(self.q_networks, features, actions)  # type: ignore[arg-type]

    def state_values(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: ``(batch, features_dim)``
        :return: outputs of the state head, ``(batch,)``
        """
        head = self.get_submodule("vf")
        assert isinstance(head, nn.Sequential)
        return mlp(head, features).squeeze(1)

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:  # type: ignore[override]
        return tuple(self.values(self.encode(obs), actions).unsqueeze(-1))


def stored_features(module: CountingFromZero, obs: PyTorchObs) -> th.Tensor:
    """
    :param module: a network with an encoder
    :param obs: observations as they are stored
    :return: their features, ``(batch, features_dim)``
    """
    encoder = module.features_extractor
    assert encoder is not None
    if isinstance(encoder, NormalizedNatureCNN) and module.normalize_images:
        return encoder(obs)  # It scales uint8 images by itself, which is cheaper than SB3's preprocessing.
    return module.extract_features(obs, encoder)


class OfflinePolicy(SACPolicy):
    """
    Policy class (with both actor and critic) of the offline actor-critic algorithms. Its networks have the same names as those
    of :class:`stable_baselines3.sac.policies.SACPolicy`.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param share_features_extractor: let actor and critic share one encoder, which the critic alone trains
    :param std_min: floor of the actor's standard deviation before the tanh
    :param std_transform: ``"exp"`` or ``"softplus"``, see :class:`OfflineActor`
    :param actor_dropout: share of the actor's hidden units that are left out at random when learning
    :param critic_layer_norm: put a LayerNorm after each hidden layer of the critics
    :param critic_output_bias: initial output of the critics, for all states and actions
    :param critic_state_value: add a critic that sees the state without an action
    :param critic_keys: keys of dict observations that the critics see, in place of all. Their encoder then differs from the
        actor's, which sees all keys, so ``share_features_extractor`` must be false: ``TypeError`` otherwise
    :param mixed_precision: compute matrix products and convolutions in bfloat16 when learning, or in float32; ``None`` takes
        bfloat16 if the device has instructions for it. Parameters, losses and the optimizers' states are always float32, and
        so is a policy that acts.
    :param features_extractor_class: encoder of the observations (default: ``default_features_extractor_class``)
    :param kwargs: all other arguments of :class:`stable_baselines3.sac.policies.SACPolicy`: ``net_arch``, ``activation_fn``,
        ``features_extractor_kwargs``, ``n_critics``, ``optimizer_class``, ...
    """

    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = StandardizedExtractor
    actor: OfflineActor
    critic: OfflineCritic
    critic_target: OfflineCritic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        share_features_extractor: bool = True,
        std_min: float = 0.0,
        std_transform: str = "exp",
        actor_dropout: float = 0.0,
        critic_layer_norm: bool = False,
        critic_output_bias: float = 0.0,
        critic_state_value: bool = False,
        critic_keys: Sequence[str] | None = None,
        mixed_precision: bool | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        **kwargs: Any,
    ):
        self.std_min, self.std_transform, self.actor_dropout = std_min, std_transform, actor_dropout
        self.mixed_precision = mixed_precision
        self.critic_keys = critic_keys
        if critic_keys is not None and share_features_extractor:
            problem = f"the critics see {list(critic_keys)} only and the actor sees all keys, so they cannot share one encoder"
            raise TypeError(f"{type(self).__name__}: {problem}; give share_features_extractor=False")
        self.offline_critic_kwargs: dict[str, Any] = {
            "layer_norm": critic_layer_norm,
            "output_bias": critic_output_bias,
            "state_value": critic_state_value,
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            share_features_extractor=share_features_extractor,
            features_extractor_class=features_extractor_class or self.default_features_extractor_class,
            **kwargs,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic = self.make_critic()
        self.critic_target = self.make_critic()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)
        self.actor = self.make_actor(self.critic.features_extractor if self.share_features_extractor else None)

        actor_parameters = [
            parameter
            for name, parameter in self.actor.named_parameters()
            if not (self.share_features_extractor and name.startswith("features_extractor."))
        ]
        self.actor.optimizer = self._make_optimizer(actor_parameters, lr_schedule)
        self.critic.optimizer = self._make_optimizer(list(self.critic.parameters()), lr_schedule)

    def set_training_mode(self, mode: bool) -> None:
        if mode != self.training:  # Learners call this in each step, and a walk through all modules takes a while.
            super().set_training_mode(mode)

    def _make_optimizer(self, parameters: list[nn.Parameter], lr_schedule: Schedule) -> th.optim.Optimizer:
        defaults = {"fused": True} if self.optimizer_class in (th.optim.Adam, th.optim.AdamW) else {}
        return self.optimizer_class(parameters, lr=lr_schedule(1), **{**defaults, **self.optimizer_kwargs})  # type: ignore

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> OfflineActor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        actor = OfflineActor(
            **actor_kwargs,
            std_min=self.std_min,
            std_transform=self.std_transform,
            dropout=self.actor_dropout,
            detach_encoder=self.share_features_extractor,
        )
        actor.mixed_precision = self.mixed_precision
        return actor.to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> OfflineCritic:
        critic_kwargs: dict[str, Any] = self.critic_kwargs
        if self.critic_keys is not None:
            seen = subspace(self.observation_space, self.critic_keys)
            critic_kwargs = {**critic_kwargs, "observation_space": seen}
            features_extractor = features_extractor or self.features_extractor_class(seen, **self.features_extractor_kwargs)
        critic_kwargs = self._update_features_extractor(critic_kwargs, features_extractor)
        critic = OfflineCritic(**critic_kwargs, **self.offline_critic_kwargs)
        critic.mixed_precision = self.mixed_precision
        return critic.to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            share_features_extractor=self.share_features_extractor,
            std_min=self.std_min,
            std_transform=self.std_transform,
            actor_dropout=self.actor_dropout,
            critic_keys=self.critic_keys,
            mixed_precision=self.mixed_precision,
            **{f"critic_{name}": value for name, value in self.offline_critic_kwargs.items()},
        )
        return data

    def fit_observation_statistics(self, statistics: Callable[[list[str] | None], Any]) -> None:
        """
        Fit every :class:`~sb3_offline.common.torch_layers.StandardizedExtractor` that is not fitted yet.

        :param statistics: function that returns (mean, variance, count) of the dataset's observations, or a dict of such
            triples for the given keys of dict observations. It is called only if there is something to fit.
        """
        fit_statistics(self, statistics)

    @property
    def standardizes(self) -> bool:
        """``True`` once the statistics of a dataset are fitted."""
        return any(bool(encoder.fitted) for encoder in standardized_encoders(self))


MlpPolicy = OfflinePolicy


class CnnPolicy(OfflinePolicy):
    """
    :class:`OfflinePolicy` for images: the encoder is :class:`~sb3_offline.common.torch_layers.NormalizedNatureCNN`.
    """

    default_features_extractor_class = NormalizedNatureCNN


class MultiInputPolicy(OfflinePolicy):
    """
    :class:`OfflinePolicy` for dict observations: images and vectors are encoded separately and concatenated.
    """

    default_features_extractor_class = StandardizedCombinedExtractor
