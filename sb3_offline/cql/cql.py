"""CQL: Conservative Q-Learning."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, TypeVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule

from sb3_offline.common.hyperparameters import COUNT, Constraints
from sb3_offline.common.losses import bellman_loss
from sb3_offline.common.reward_based import RewardBasedAlgorithm, RewardFunction
from sb3_offline.common.search import BOOTSTRAPPING, SearchSpace, log_uniform
from sb3_offline.cql.losses import conservative_gaps
from sb3_offline.data.reader import DatasetLike

SelfCQL = TypeVar("SelfCQL", bound="CQL")

#: Bound of a learned ``cql_alpha``.
ALPHA_MAX = 1e6


class CQL(RewardBasedAlgorithm):
    """
    Conservative Q-Learning (CQL, https://arxiv.org/abs/2006.04779): soft actor-critic with a penalty that holds down the
    values of actions outside the dataset::

        y = r + gamma (1 - terminated) min_i Qbar_i(s', a'),    a' ~ pi(s')
        critic:  min  sum_i E_D[(Q_i(s, a) - y)^2] + cql_alpha E_D[log int exp(Q_i(s, a)) da - Q_i(s, a)]
        actor:   min  E_D[ent_coef log pi(a | s) - min_i Q_i(s, a)],    a ~ pi(s)

    The integral is estimated with K actions each from a uniform distribution, from pi(s) and from pi(s').

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param n_steps: steps of rewards before the target's value (1: as above)
    :param cql_alpha: weight of the conservative term. ``"auto"`` (or ``"auto_0.5"``, for 0.5 as initial value) learns it by
        dual gradient descent, so that the term comes to ``lagrange_threshold``
    :param lagrange_threshold: how far the soft maximum over sampled actions may lie above the data's values, in each critic,
        when learning ``cql_alpha``
    :param n_action_samples: K
    :param ent_coef: Entropy coefficient. ``"auto"`` (or ``"auto_0.1"``, for 0.1 as initial value) learns it
    :param target_entropy: target entropy when learning ``ent_coef``; ``"auto"`` is minus the number of action dimensions
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param reward_fn: rewards in place of the dataset's, see
        :class:`~sb3_offline.common.reward_based.RewardBasedAlgorithm`
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation)
    :param n_stack: number of frames that the policy sees at once, as SB3's ``VecFrameStack`` stacks them
    :param dataset_storage: ``"memory"``, ``"mmap"``, or ``"auto"``
    :param stats_window_size: kept for SB3's signature
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {"n_action_samples": [COUNT]}
    search_space: ClassVar[SearchSpace] = {**BOOTSTRAPPING, "cql_alpha": log_uniform(0.05, 20)}
    log_ent_coef: th.Tensor
    log_cql_alpha: th.Tensor
    ent_coef_optimizer: th.optim.Adam | None
    cql_alpha_optimizer: th.optim.Adam | None

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        n_steps: int = 1,
        cql_alpha: float | str = 5.0,
        lagrange_threshold: float = 10.0,
        n_action_samples: int = 10,
        ent_coef: float | str = "auto",
        target_entropy: float | str = "auto",
        target_update_interval: int = 1,
        reward_fn: RewardFunction | None = None,
        random_shift: int = 0,
        n_stack: int = 1,
        dataset_storage: Literal["auto", "memory", "mmap"] = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            dataset,
            reward_fn,
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            random_shift=random_shift,
            n_stack=n_stack,
            dataset_storage=dataset_storage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.cql_alpha = cql_alpha
        self.lagrange_threshold = lagrange_threshold
        self.n_action_samples = n_action_samples
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.target_entropy == "auto":
            self.target_entropy = -math.prod(self.action_space.shape or ())
        self.target_entropy = float(self.target_entropy)
        self.log_ent_coef, self.ent_coef_optimizer = self._coefficient("ent_coef", self.ent_coef)
        self.log_cql_alpha, self.cql_alpha_optimizer = self._coefficient("cql_alpha", self.cql_alpha)

    def _coefficient(self, name: str, setting: float | str) -> tuple[th.Tensor, th.optim.Adam | None]:
        """:return: logarithm of a coefficient, and the optimizer of one that is learned (``"auto"``, ``"auto_0.1"``)"""
        number, learned = setting, isinstance(setting, str) and setting.startswith("auto")
        if learned:
            number = str(setting).removeprefix("auto").removeprefix("_") or 1.0
        try:
            number = float(number)
            # A learned one that starts at 0 would stay there: it is the exponential of what is learned
            if not math.isfinite(number) or number < 0 or (learned and number == 0):
                raise ValueError(f"{number} is out of bounds")
        except (TypeError, ValueError) as error:
            problem = f"{type(self).__name__}: {name} is {setting!r}; give a number of at least 0, 'auto' or 'auto_0.1'"
            raise TypeError(problem) from error
        log = th.tensor([number], device=self.device).log()
        return log, th.optim.Adam([log.requires_grad_()], lr=self.lr_schedule(1)) if learned else None

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer, self.ent_coef_optimizer, self.cql_alpha_optimizer]
        self._update_learning_rate([optimizer for optimizer in optimizers if optimizer is not None])

        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            observations = self.augment(batch.observations)
            features = self.critic.encode(observations)
            policy_features = self._policy_features(observations, features)
            actions, log_prob = self.actor.sample(policy_features)

            if self.ent_coef_optimizer is not None:
                assert isinstance(self.target_entropy, float)
                ent_coef_loss = -(self.log_ent_coef * (log_prob.detach() + self.target_entropy)).mean()
                self._optimize(self.ent_coef_optimizer, ent_coef_loss)
            ent_coef = self.log_ent_coef.detach().exp()

            with th.no_grad():
                rewards, discounts, next_observations = self._returns(batch)
                sampled_actions, log_densities, next_actions = self._sample_actions(policy_features, next_observations)
                next_values = self.critic_target.values(self.critic_target.encode(next_observations), next_actions)
                targets = rewards + discounts * next_values.amin(dim=0)

            data_values = self.critic.values(features, batch.actions)
            gaps = conservative_gaps(data_values, self.critic.values(features, sampled_actions), log_densities)
            critic_loss = bellman_loss(data_values, targets) + self._conservative_term(gaps)
            self._optimize(self.critic.optimizer, critic_loss)

            values = self._values_of_policy(features, actions).amin(dim=0)
            actor_loss = (ent_coef * log_prob - values).mean()
            self._optimize(self.actor.optimizer, actor_loss)

            self._n_updates += 1
            self._update_target()
            self._record(
                critic_loss=critic_loss,
                actor_loss=actor_loss,
                ent_coef=ent_coef.squeeze(),
                log_prob=log_prob.mean(),
                values_data=data_values.mean(),
                values_policy=values.mean(),
                cql_gap=gaps.mean(),
            )

    def _sample_actions(
        self, policy_features: th.Tensor, next_observations: PyTorchObs
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param policy_features: ``(batch, features_dim)``
        :param next_observations: of the same transitions
        :return: K actions each of a uniform distribution, pi(s) and pi(s'), ``(batch, 3 K, action_dim)``; the logarithms of
            their densities, ``(batch, 3 K)``; and one action of pi(s') for the target, ``(batch, action_dim)``
        """
        n_samples = self.n_action_samples
        current, current_log_prob = self.actor.sample(policy_features, n_samples)
        following, following_log_prob = self.actor.sample(self.actor.encode(next_observations), n_samples + 1)
        uniform = th.rand_like(current) * 2 - 1
        uniform_log_prob = th.full_like(current_log_prob, -current.shape[-1] * math.log(2.0))
        return (
            th.cat([uniform, current, following[:, 1:]], dim=1),
            th.cat([uniform_log_prob, current_log_prob, following_log_prob[:, 1:]], dim=1),
            following[:, 0],
        )

    def _conservative_term(self, gaps: th.Tensor) -> th.Tensor:
        """
        :param gaps: of each critic, ``(n_critics,)``
        :return: scalar, summed over the critics; a learned ``cql_alpha`` is updated before
        """
        if self.cql_alpha_optimizer is None:
            return self.log_cql_alpha.exp().squeeze() * gaps.sum()
        excess = gaps - self.lagrange_threshold
        alpha_loss = -self.log_cql_alpha.exp().clamp(max=ALPHA_MAX).squeeze() * excess.detach().sum()
        self._optimize(self.cql_alpha_optimizer, alpha_loss)
        alpha = self.log_cql_alpha.detach().exp().clamp(max=ALPHA_MAX).squeeze()
        self._record(cql_alpha=alpha)
        return alpha * excess.sum()

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        learned = [name for name in ("ent_coef", "cql_alpha") if getattr(self, f"{name}_optimizer") is not None]
        # A fixed coefficient is an attribute, which `load` may replace
        return [*state_dicts, *(f"{name}_optimizer" for name in learned)], [*variables, *(f"log_{name}" for name in learned)]

    @classmethod
    def load(cls: type[SelfCQL], path: Any, *args: Any, **kwargs: Any) -> SelfCQL:  # type: ignore[override]
        """
        See :meth:`sb3_offline.common.offline_algorithm.OfflineAlgorithm.load`. A coefficient that was learned goes on being
        learned from its saved value, and a fixed one stays fixed: ``TypeError`` otherwise.
        """
        for name in kwargs.keys() & {"ent_coef", "cql_alpha"}:
            was_learned = f"{name}_optimizer" in load_from_zip_file(path, device="cpu", load_data=False)[1]
            if was_learned != str(kwargs[name]).startswith("auto"):
                problem = f"{name} is {kwargs[name]!r}, and the saved model's was {'learned' if was_learned else 'fixed'}"
                raise TypeError(f"{cls.__name__}: {problem}; leave it so, or train a new model")
        return super().load(path, *args, **kwargs)
