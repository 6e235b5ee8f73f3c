"""CEBORL: Conservative Example-Based Offline RL."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule

from sb3_offline.ceborl.backups import BACKUPS, Backup
from sb3_offline.ceborl.classifier import RecursiveClassifier
from sb3_offline.ceborl.diagnostics import DiagnosticsCallback
from sb3_offline.ceborl.extraction import ADVANTAGES, EXTRACTIONS, PolicyExtraction
from sb3_offline.ceborl.losses import conservative_penalty
from sb3_offline.common.augmentation import has_images
from sb3_offline.common.example_based import ExamplesLike
from sb3_offline.common.hyperparameters import COUNT, NOT_NEGATIVE, POSITIVE, WHOLE, Constraints, Options
from sb3_offline.common.search import SearchSpace, Uniform, log_uniform
from sb3_offline.data.reader import DatasetLike

#: The paper's Eq. 10 and 11 with its appendix's settings, as constructor arguments. Where the paper is silent (omega over ten
#: steps, encoders, the policy's standard deviation), the settings are those of the code of RCE's authors. The preset names
#: every setting of the algorithm; those that its backup and its policy extraction do not use are the defaults.
PAPER_FORM: dict[str, Any] = {
    "learning_rate": 3e-4,
    "batch_size": 256,
    "example_batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "n_steps": 10,
    "beta": 0.1,
    "n_action_samples": 16,
    "mu": "uniform",
    "penalty_space": "probability",
    "example_share": 0.0,
    "initial_odds": 1.0,
    "backup": "policy",
    "policy_extraction": "maximize",
    "advantage": "mean",
    "temperature": 0.6,
    "state_exponent": 2.0,
    "ent_coef": 1e-4,
    "target_update_interval": 1,
    "random_shift": 0,
    "policy_kwargs": {"share_features_extractor": False, "std_transform": "softplus"},
}

#: Default of ``random_shift`` for images
RANDOM_SHIFT = 4


class CEBORL(RecursiveClassifier):
    """
    Conservative Example-Based Offline RL (CEBORL): learns a task from an unlabelled dataset and examples of success.

    A classifier C(s, a) of success in the discounted future is trained by recursive classification. Its odds C / (1 - C) are
    the Q-value (Eq. 1), and a conservative penalty holds down unseen actions (Eq. 10)::

        min  beta (E_{s ~ D, a ~ mu}[C(s, a)] - E_{s, a ~ D}[C(s, a)])                           (a)
             + (1 - gamma) E_{s ~ S*, a ~ pi}[CE(C(s, a); y = 1)]                                (b)
             + E_D[(1 + gamma omega) CE(C(s, a); y = gamma omega / (1 + gamma omega))]           (c)

    with ``omega = C(s', a') / (1 - C(s', a'))`` (Eq. 3). The defaults differ from the paper's form in two ways. Omega is the
    discounted success in the rest of the dataset's own episode, which a classifier of states detects, so nothing is
    bootstrapped. The policy imitates the dataset's actions, weighted by their advantage, instead of maximising C. The paper's
    form is :data:`PAPER_FORM`: ``CEBORL("CnnPolicy", env, ..., **PAPER_FORM)``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern; their rewards and success labels are not used
    :param examples: Success examples S*: a folder of images, an ``.npz`` or HDF5 file, or an array of observations
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param batch_size: Transitions in a batch
    :param example_batch_size: Success examples in a batch
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor. It also decides how fast the odds of states fade that the classifier mistakes for
        success
    :param n_steps: the longer of the two horizons of omega (1: one step alone), for any ``backup`` but ``"episode"``
    :param beta: weight of the conservative penalty (a); with 0 the next three have no effect
    :param n_action_samples: K, the number of actions drawn from mu at each state
    :param mu: distribution of the penalised actions: ``"uniform"``, ``"policy"``, or ``"mixture"`` (half of each)
    :param penalty_space: penalise the ``"probability"`` C or the ``"logit"``
    :param example_share: weight of the examples among the data of (c). The odds estimate the ratio of two densities, examples
        over data, which is unbounded where there are no data. With a share eta of examples the ratio is at most 1 / eta (the
        "relative" density ratio)
    :param initial_odds: odds of the untrained classifier. A network's usual first output, 0, means odds of 1, far above the
        truth. Discounting takes thousands of steps to bring them down, and until then they look like success
    :param backup: where omega comes from: ``"episode"``, the rest of the episode; or the target network, at the dataset's next
        action (``"dataset"``), at the policy's, as in the paper (``"policy"``), or at none (``"expectile"``: a state's odds
        are an upper expectile of the logits of the dataset's actions in it, as in IQL)
    :param policy_extraction: ``"weighted"``: imitate the dataset's actions, weighted by their advantage; ``"maximize"``: the
        paper's Eq. 11. The next three belong to ``"weighted"``
    :param advantage: the outcome that the weights compare with the state's odds: ``"return"``: omega, to which the dataset's
        action led; ``"value"``: the classifier's odds of this action; ``"mean"``: the geometric mean of both
    :param temperature: temperature of the advantage weights, which are the ratio of the odds to the power 1 / temperature
    :param state_exponent: power by which states and outcomes far from success count less. An advantage says which action is
        better in a state, but most states of a mixed dataset lead nowhere, and their best action matters little
    :param ent_coef: Entropy coefficient of ``policy_extraction="maximize"``
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation; default: 4
        where there are images)
    :param example_keys: keys of dict observations that the classifier sees, where examples show some keys only (default: those
        that the examples hold)
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :param kwargs: the other arguments of :class:`~sb3_offline.common.offline_algorithm.OfflineAlgorithm`, such as
        ``dataset_storage``
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "beta": [NOT_NEGATIVE],
        "n_action_samples": [COUNT],
        "mu": [Options(("uniform", "policy", "mixture"))],
        "penalty_space": [Options(("probability", "logit"))],
        "backup": [Options(tuple(BACKUPS))],
        "policy_extraction": [Options(tuple(EXTRACTIONS))],
        "advantage": [Options(tuple(ADVANTAGES))],
        "temperature": [POSITIVE],
        "random_shift": [WHOLE, None],
        "state_exponent": [NOT_NEGATIVE],
    }
    search_space: ClassVar[SearchSpace] = {
        **RecursiveClassifier.search_space,
        "beta": log_uniform(1e-2, 1),
        "temperature": log_uniform(0.1, 1),
        "initial_odds": log_uniform(1e-3, 1),
        "state_exponent": Uniform(0, 4),
    }

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 128,
        example_batch_size: int = 32,
        tau: float = 0.02,
        gamma: float = 0.97,
        n_steps: int = 10,
        beta: float = 0.1,
        n_action_samples: int = 4,
        mu: str = "uniform",
        penalty_space: str = "probability",
        example_share: float = 0.02,
        initial_odds: float = 0.01,
        backup: str = "episode",
        policy_extraction: str = "weighted",
        advantage: str = "mean",
        temperature: float = 0.6,
        state_exponent: float = 2.0,
        ent_coef: float = 1e-4,
        target_update_interval: int = 1,
        random_shift: int | None = None,
        example_keys: Sequence[str] | None = None,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            dataset,
            examples,
            example_batch_size=example_batch_size,
            example_keys=example_keys,
            example_share=example_share,
            initial_odds=initial_odds,
            ent_coef=ent_coef,
            learning_rate=learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            n_steps=n_steps,
            target_update_interval=target_update_interval,
            random_shift=random_shift,  # type: ignore[arg-type]
            policy_kwargs=policy_kwargs,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            **kwargs,
        )
        self.beta = beta
        self.n_action_samples = n_action_samples
        self.mu = mu
        self.penalty_space = penalty_space
        self.backup = backup
        self.policy_extraction = policy_extraction
        self.advantage = advantage
        self.temperature = temperature
        self.state_exponent = state_exponent

        if _init_setup_model:
            self._setup_model()

    def _make_parts(self) -> tuple[Backup, PolicyExtraction]:
        return BACKUPS[self.backup](self), EXTRACTIONS[self.policy_extraction](self)  # type: ignore[arg-type]

    def _setup_model(self) -> None:
        if self.random_shift is None and hasattr(self, "observation_space"):
            self.random_shift = RANDOM_SHIFT if has_images(self.observation_space) else 0
        super()._setup_model()
        if self.mu == "mixture" and self.n_action_samples == 1:
            raise TypeError(f"{type(self).__name__}: mu='mixture' takes half of the actions each; give n_action_samples >= 2")

    def default_callbacks(self) -> list[BaseCallback]:
        return [DiagnosticsCallback()]

    def _conservative_term(self, observations: PyTorchObs, features: th.Tensor, data_logits: th.Tensor) -> th.Tensor:
        if self.beta == 0:
            return super()._conservative_term(observations, features, data_logits)
        sampled_logits = self.critic.values(features, self._sample_penalized_actions(observations, features))
        penalty = conservative_penalty(data_logits, sampled_logits, self.penalty_space)
        self._record(penalty=penalty, classifier_penalized=sampled_logits.sigmoid().mean())
        return self.beta * penalty

    def _sample_penalized_actions(self, observations: PyTorchObs, features: th.Tensor) -> th.Tensor:
        """
        :param observations: a batch
        :param features: features of the critic's encoder, ``(batch, features_dim)``
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
