"""RCE: Recursive Classification of Examples, on a fixed dataset."""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.ceborl.backups import Backup, PolicyBackup
from sb3_offline.ceborl.classifier import RecursiveClassifier
from sb3_offline.ceborl.diagnostics import DiagnosticsCallback
from sb3_offline.ceborl.extraction import Maximization, PolicyExtraction
from sb3_offline.common.example_based import ExamplesLike
from sb3_offline.common.search import SearchSpace, log_uniform
from sb3_offline.data.reader import DatasetLike


class RCE(RecursiveClassifier):
    """
    Recursive Classification of Examples (RCE, https://arxiv.org/abs/2103.12656), trained on a dataset: terms (b) and (c) of
    CEBORL's Eq. 10 without the penalty (a), with ``a'`` from the policy, which maximises C (Eq. 11)::

        critic:  min  (1 - gamma) E_{s ~ S*, a ~ pi}[CE(C(s, a); y = 1)]                                  (b)
                      + E_D[(1 + gamma omega) CE(C(s, a); y = gamma omega / (1 + gamma omega))]           (c)
        actor:   min  E_D[ent_coef log pi(a | s) - C(s, a)],    a ~ pi(s)

    With ``n_steps > 1`` omega is made of the mean *probability* of two horizons, as in its authors' code (10 steps):
    ``omega = Cbar / (1 - Cbar)``, ``Cbar = (C(s_1, a_1) + gamma**n C(s_n, a_n)) / 2``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: The environment the policy is meant for, a registered id, or ``None`` (spaces from the dataset)
    :param dataset: Path(s) of HDF5 datasets, or a glob pattern; their rewards and success labels are not used
    :param examples: Success examples S*: a folder of images, an ``.npz`` or HDF5 file, or an array of observations
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param n_steps: 1, or the longer of the two horizons
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param batch_size: Transitions in a batch
    :param example_batch_size: Success examples in a batch
    :param gamma: the discount factor
    :param example_share: weight of the examples among the data of (c), see :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    :param initial_odds: odds of the untrained classifier, see :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    :param ent_coef: Entropy coefficient
    :param target_update_interval: update the target network every ``target_update_interval`` gradient steps
    :param random_shift: images are shifted by up to so many pixels, alike in groups of 32 (0: no augmentation)
    :param example_keys: keys of dict observations that the classifier sees, where examples show some keys only (default: those
        that the examples hold)
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

    search_space: ClassVar[SearchSpace] = {**RecursiveClassifier.search_space, "ent_coef": log_uniform(1e-5, 0.1)}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 10,
        tau: float = 0.005,
        batch_size: int = 256,
        example_batch_size: int = 256,
        gamma: float = 0.99,
        example_share: float = 0.0,
        initial_odds: float = 1.0,
        ent_coef: float = 1e-4,
        target_update_interval: int = 1,
        random_shift: int = 0,
        example_keys: Sequence[str] | None = None,
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

        if _init_setup_model:
            self._setup_model()

    def _make_parts(self) -> tuple[Backup, PolicyExtraction]:
        return PolicyBackup(self), Maximization(self)  # type: ignore[arg-type]

    def default_callbacks(self) -> list[BaseCallback]:
        return [DiagnosticsCallback()]
