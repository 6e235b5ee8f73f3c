"""CEBORL: Conservative Example-Based Offline RL."""

import math
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule

from sb3_offline.ceborl.losses import (
    OVERFLOW,
    advantage_weights,
    conservative_penalty,
    example_loss,
    recursive_loss,
    success_odds,
)
from sb3_offline.ceborl.resampling import WeightedTransitions
from sb3_offline.common.example_based import ExampleBasedAlgorithm, ExampleSource
from sb3_offline.common.hyperparameters import COUNT, NOT_NEGATIVE, OR_NONE, POSITIVE, SHARE, WHOLE
from sb3_offline.common.losses import expectile_loss
from sb3_offline.data.buffer import OfflineSamples, joined
from sb3_offline.data.reader import DatasetSource

#: The paper's Eq. 10 and 11 as its appendix trains them, as constructor arguments.
PAPER_FORM: dict[str, Any] = {
    "backup": "policy",
    "policy_extraction": "maximize",
    "gamma": 0.99,
    "n_steps": 1,
    "beta": 0.1,
    "n_action_samples": 16,
    "tau": 0.005,
    "initial_odds": 1.0,
    "example_share": 0.0,
}

#: Diagnostics that need extra forward passes are taken once in so many gradient steps.
DIAGNOSTICS_INTERVAL = 50


class CEBORL(ExampleBasedAlgorithm):
    """
    Conservative Example-Based Offline RL (CEBORL): learns a task from an unlabelled dataset and examples of success.

    A classifier C(s, a) of success in the discounted future is trained by recursive classification; its odds C / (1 - C) are
    the Q-value (Eq. 1), and a conservative penalty holds down unseen actions (Eq. 10)::

        min  beta (E_{s ~ D, a ~ mu}[C(s, a)] - E_{s, a ~ D}[C(s, a)])                           (a)
             + (1 - gamma) E_{s ~ S*, a ~ pi}[CE(C(s, a); y = 1)]                                (b)
             + E_D[(1 + gamma omega) CE(C(s, a); y = gamma omega / (1 + gamma omega))]           (c)

    with ``omega = C(s', a') / (1 - C(s', a'))`` (Eq. 3). The defaults are not the paper's exact form, which did not learn in
    our trials (see the docs), but its working relative: ``a'`` is the dataset's next action instead of the policy's, over
    ``n_steps``, and the policy is fitted to the dataset's actions, weighted by their advantage, instead of maximising C. The
    paper's form is :data:`PAPER_FORM`: ``CEBORL("CnnPolicy", env, ..., **PAPER_FORM)``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern; rewards and success labels in them are not looked at
    :param examples: Success examples S*: a folder of pictures, an ``.npz`` or HDF5 file, or an array of observations
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param example_batch_size: Success examples in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor. What the classifier mistakes for success lives on in the odds by it: where attempts are
        short (50 steps in the shipped environment), try 0.95
    :param n_steps: omega is the mean of the 1-step and the n-step odds, discounted (1: the 1-step odds alone)
    :param beta: weight of the conservative penalty (a); with 0 the next three are not looked at
    :param n_action_samples: K, actions drawn from mu at each state
    :param mu: distribution of the penalised actions: ``"uniform"``, ``"policy"``, or ``"mixture"`` (half of each)
    :param penalty_space: penalise the ``"probability"`` C or the ``"logit"``
    :param omega_max: bound of omega against overflow; values of 20 to 60 are normal, so keep it far above
    :param class_prior: weight of the examples in (b), p(e = 1); the paper drops it (1.0)
    :param example_share: weight of the examples among the data of (c). The odds estimate the ratio of two densities, examples
        over data, which is unbounded where the data have none; with a share eta of examples it is at most 1 / eta (the
        "relative" density ratio).
    :param initial_odds: odds of the untrained classifier. A network's usual first output, 0, means odds of 1, far above the
        truth; discounting takes thousands of steps to bring them down, and until then they look like success.
    :param backup: next action a' of omega: the ``"dataset"``'s, or the ``"policy"``'s as in the paper; or ``"expectile"``: no
        action, but a state's odds as an upper expectile of the logits of the data's actions in it, as in IQL
    :param expectile: of ``backup="expectile"``: 0.5 is the mean, near 1 the best of the data's actions
    :param policy_extraction: ``"weighted"``: imitate the dataset's actions, weighted by their advantage; ``"maximize"``: the
        paper's Eq. 11. The next six are of ``"weighted"``
    :param advantage: what the weights compare with the state's odds: ``"return"``: omega, to which the data's actions led
        within the n-step window; ``"value"``: what the classifier says of the data's action
    :param temperature: of the advantage weights: the power 1 / temperature of the odds' ratio
    :param advantage_floor: odds, as a share of the examples' odds, under which advantages are noise and count little
    :param weight_max: bound of the advantage weights
    :param state_exponent: states whose odds are under the floor count less, by this power. Advantages say which action is
        better in a state; most states of a mixed dataset lead nowhere, and what is best there matters little.
    :param policy_batches: the policy learns from the transitions of the last so many batches, drawn by their weights
    :param ent_coef: Entropy coefficient, for ``policy_extraction="maximize"``
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation)
    :param policy_random_shift: the same for the images that the policy imitates, and for those alone (default:
        ``random_shift``), for ``policy_extraction="weighted"``
    :param dataset_storage: ``"memory"``, ``"mmap"``, or ``"auto"``
    :param stats_window_size: kept for SB3's signature
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    numbers: ClassVar[dict[str, str]] = {
        "beta": NOT_NEGATIVE,
        "n_action_samples": COUNT,
        "omega_max": POSITIVE,
        "class_prior": POSITIVE,
        "example_share": SHARE,
        "initial_odds": POSITIVE,
        "expectile": SHARE,
        "temperature": POSITIVE,
        "advantage_floor": POSITIVE,
        "weight_max": POSITIVE,
        "state_exponent": NOT_NEGATIVE,
        "policy_batches": COUNT,
        "ent_coef": NOT_NEGATIVE,
        "policy_random_shift": WHOLE + OR_NONE,
    }
    choices: ClassVar[dict[str, tuple[str, ...]]] = {
        "mu": ("uniform", "policy", "mixture"),
        "penalty_space": ("probability", "logit"),
        "backup": ("dataset", "policy", "expectile"),
        "policy_extraction": ("weighted", "maximize"),
        "advantage": ("return", "value"),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetSource | None = None,
        examples: ExampleSource | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        example_batch_size: int = 256,
        tau: float = 0.02,
        gamma: float = 0.99,
        n_steps: int = 10,
        beta: float = 0.1,
        n_action_samples: int = 16,
        mu: str = "uniform",
        penalty_space: str = "probability",
        omega_max: float = 1e4,
        class_prior: float = 1.0,
        example_share: float = 0.02,
        initial_odds: float = 0.01,
        backup: str = "dataset",
        expectile: float = 0.9,
        policy_extraction: str = "weighted",
        advantage: str = "return",
        temperature: float = 0.3,
        advantage_floor: float = 0.01,
        weight_max: float = 100.0,
        state_exponent: float = 2.0,
        policy_batches: int = 512,
        ent_coef: float = 1e-4,
        target_update_interval: int = 1,
        random_shift: int = 0,
        policy_random_shift: int | None = None,
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
            examples,
            example_batch_size,
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            random_shift=random_shift,
            dataset_storage=dataset_storage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.beta = beta
        self.n_action_samples = n_action_samples
        self.mu = mu
        self.penalty_space = penalty_space
        self.omega_max = omega_max
        self.class_prior = class_prior
        self.example_share = example_share
        self.initial_odds = initial_odds
        self.backup = backup
        self.expectile = expectile
        self.policy_extraction = policy_extraction
        self.advantage = advantage
        self.temperature = temperature
        self.advantage_floor = advantage_floor
        self.weight_max = weight_max
        self.state_exponent = state_exponent
        self.policy_random_shift = policy_random_shift
        self.policy_batches = policy_batches
        self._weighted_transitions = WeightedTransitions(policy_batches)
        self._dataset_checksum: int | None = None
        self.ent_coef = ent_coef

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if self.policy_random_shift and self.policy_extraction == "maximize":
            remedy = "policy_extraction='maximize' imitates no images that it could shift; leave it out"
            raise TypeError(f"{type(self).__name__}: policy_random_shift is {self.policy_random_shift}, but {remedy}")
        if self.mu == "mixture" and self.n_action_samples == 1:
            raise TypeError(f"{type(self).__name__}: mu='mixture' takes half of the actions each; give n_action_samples >= 2")
        self.needs_next_actions = self.backup != "policy"
        super()._setup_model()

    def all_policy_kwargs(self) -> dict[str, Any]:
        own: dict[str, Any] = {"critic_output_bias": math.log(self.initial_odds)}
        if self.policy_extraction == "weighted" or self.backup == "expectile":
            own["critic_state_value"] = True
        if self.policy_extraction == "weighted":
            own["std_min"] = 0.05
        return {**own, **self.policy_kwargs}

    def _open_data(self) -> None:
        super()._open_data()
        self._loaded_examples()

    def _prepare_data(self) -> None:
        super()._prepare_data()
        checksum = self.replay_buffer.checksum()
        # The numbers of kept transitions are of another dataset, or a loaded model is to keep more or fewer
        if (checksum, self.policy_batches) != (self._dataset_checksum, self._weighted_transitions.n_batches):
            self._weighted_transitions = WeightedTransitions(self.policy_batches)
            self._dataset_checksum = checksum

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            observations = self.augment(batch.observations)
            examples, example_rows = self.sample_examples()
            examples = self.augment(examples)
            # One pass of the encoder: its weights take longer than the images of a small batch
            features, distinct_features = self.critic.encode(joined([observations, examples])).tensor_split([batch_size])
            example_features = distinct_features[example_rows]
            with th.no_grad():
                example_policy_features = self._policy_features(examples, example_features, example_rows)
                example_actions, _ = self.actor.sample(example_policy_features)
                discounted_omega = self._discounted_omega(batch)
                example_omega = self._example_omega(examples, example_rows, example_actions)

            # Eq. 10
            both_features = th.cat([features, example_features])
            logits = self.critic.values(both_features, th.cat([batch.actions, example_actions]))
            data_logits, example_logits = logits[:, : len(features)], logits[:, len(features) :]
            if self.policy_extraction == "weighted" and self.backup != "expectile":
                # One more critic, of the state without the action: its odds are the mean over the data's actions.
                logits = th.cat([logits, self.critic.state_values(both_features).unsqueeze(0)])
                state_logits = logits[-1, : len(features)]
            term_c = recursive_loss(logits[:, : len(features)], discounted_omega)
            term_b = self._example_term(logits[:, len(features) :], example_omega)
            critic_loss = term_c + term_b
            if self.beta > 0:
                sampled_logits = self.critic.values(features, self._sample_penalized_actions(observations, features))
                term_a = conservative_penalty(data_logits, sampled_logits, self.penalty_space)
                critic_loss = critic_loss + self.beta * term_a
                self._record(penalty=term_a, classifier_penalized=sampled_logits.sigmoid().mean())
            if self.backup == "expectile":
                state_logits = self.critic.state_values(features)
                with th.no_grad():
                    target_logits = self.critic_target.values(self.critic_target.encode(observations), batch.actions)
                critic_loss = critic_loss + expectile_loss(target_logits.amin(dim=0) - state_logits, self.expectile)
            self._optimize(self.critic.optimizer, critic_loss)

            if self.policy_extraction == "weighted":
                outcome = discounted_omega if self.advantage == "return" else success_odds(data_logits.detach(), OVERFLOW)
                weights = advantage_weights(
                    outcome,
                    state_logits.detach(),
                    example_logits.detach(),
                    self.temperature,
                    self.advantage_floor,
                    self.weight_max,
                    self.state_exponent,
                )
                assert batch.steps is not None
                self._weighted_transitions.add(batch.steps, weights)
                actor_loss = self.actor.regression_loss(*self._draw_imitated(batch_size)).mean()
                self._record(effective_weights=self._weighted_transitions.effective_share())
            else:  # Eq. 11
                actions, log_prob = self.actor.sample(self._policy_features(observations, features))
                classifier = self._values_of_policy(features, actions).amin(dim=0).sigmoid()
                actor_loss = (self.ent_coef * log_prob - classifier).mean()
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

    def _draw_imitated(self, batch_size: int) -> tuple[th.Tensor, th.Tensor]:
        """:return: features and actions of the last batches' transitions, drawn by their weights"""
        steps = self._weighted_transitions.draw(batch_size)
        observations, actions = self.replay_buffer.pairs(steps, env=self._vec_normalize_env)
        return self.actor.encode(self.augment(observations, self.policy_random_shift)), actions

    def _discounted_omega(self, batch: OfflineSamples) -> th.Tensor:
        """
        Eq. 3 times its discount: what term (c) takes as the positive weight of each transition.

        :param batch: transitions
        :return: ``(batch,)``
        """
        omegas = [success_odds(logits, self.omega_max) for logits in self._target_logits(batch)]
        one_step = batch.discounts.squeeze(1) * omegas[0]
        if self.n_steps == 1:
            return one_step
        assert batch.nstep_discounts is not None
        return 0.5 * (one_step + batch.nstep_discounts.squeeze(1) * omegas[1])

    def _example_omega(self, examples: PyTorchObs, rows: th.Tensor, actions: th.Tensor) -> th.Tensor | None:
        """:return: ``gamma * omega`` of examples as their own successors, where they count among the data"""
        if self.example_share == 0:
            return None
        target_logits = self.critic_target.values(self.critic_target.encode(examples)[rows], actions)
        return self.gamma * success_odds(target_logits, self.omega_max)

    def _example_term(self, logits: th.Tensor, example_omega: th.Tensor | None) -> th.Tensor:
        """Term (b), and the examples' part of (c), which bounds the odds by ``1 / example_share``."""
        loss = example_loss(logits, self.gamma, self.class_prior)
        if example_omega is not None:
            loss = loss + self.example_share * recursive_loss(logits, example_omega)
        return loss

    def _target_logits(self, batch: OfflineSamples) -> tuple[th.Tensor, ...]:
        """
        :param batch: transitions
        :return: the target's logits after one step and, for ``n_steps > 1``, after ``n_steps``, ``(n_critics, batch)`` each
        """
        successors, dataset_actions = [batch.next_observations], [batch.next_actions]
        if self.n_steps > 1:
            assert batch.nstep_observations is not None
            successors, dataset_actions = [*successors, batch.nstep_observations], [*dataset_actions, batch.nstep_actions]
        successors = [self.augment(observations) for observations in successors]
        successors_together = joined(successors)
        features = self.critic_target.encode(successors_together)
        if self.backup == "expectile":
            logits = self.critic_target.state_values(features).unsqueeze(0)
        elif self.backup == "dataset":
            logits = self.critic_target.values(features, th.cat(dataset_actions))  # type: ignore[arg-type]
        else:
            actions, _ = self.actor.sample(self.actor.encode(successors_together))
            logits = self.critic_target.values(features, actions)
        self._record(omega_clipped=(logits.amin(dim=0) >= math.log(self.omega_max)).float().mean())
        return logits.chunk(len(successors), dim=1)

    def _sample_penalized_actions(self, observations: PyTorchObs, features: th.Tensor) -> th.Tensor:
        """
        :param observations: a batch
        :param features: of the critic's encoder, ``(batch, features_dim)``
        :return: K actions from mu for each state, ``(batch, K, action_dim)``, no gradient
        """
        n_policy = {"uniform": 0, "mixture": self.n_action_samples // 2, "policy": self.n_action_samples}[self.mu]
        action_dim = get_action_dim(self.action_space)
        uniform = 2.0 * th.rand(len(features), self.n_action_samples - n_policy, action_dim, device=self.device) - 1.0
        if n_policy == 0:
            return uniform
        with th.no_grad():
            policy_features = self._policy_features(observations, features)
            return th.cat([uniform, self.actor.sample(policy_features, n_policy)[0]], dim=1)

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
