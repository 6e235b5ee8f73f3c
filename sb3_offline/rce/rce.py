"""RCE: Recursive Classification of Examples, on a fixed dataset."""

from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_offline.ceborl.ceborl import CEBORL
from sb3_offline.ceborl.losses import success_odds
from sb3_offline.common.example_based import ExampleSource
from sb3_offline.data.buffer import OfflineSamples
from sb3_offline.data.reader import DatasetSource


class RCE(CEBORL):
    """
    Recursive Classification of Examples (RCE, https://arxiv.org/abs/2103.12656), trained on a dataset: CEBORL's
    terms (b) and (c) without the penalty, ``a'`` from the policy, and the policy maximising C.

    With ``n_steps > 1`` the classifier's *probabilities* of the two horizons are averaged, as its authors do it
    (10 steps): ``omega = Cbar / (1 - Cbar)``, ``Cbar = (C(s_1, a_1) + gamma**n C(s_n, a_n)) / 2``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: see :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    :param dataset: see :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    :param examples: see :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param n_steps: 1, or the longer of the two horizons
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param kwargs: the other arguments of :class:`~sb3_offline.ceborl.ceborl.CEBORL`
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetSource | None = None,
        examples: ExampleSource | None = None,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 1,
        tau: float = 0.005,
        **kwargs: Any,
    ):
        defaults: dict[str, Any] = {
            "beta": 0.0,
            "backup": "policy",
            "policy_extraction": "maximize",
            "initial_odds": 1.0,
            "example_share": 0.0,
        }
        super().__init__(policy, env, dataset, examples, learning_rate, n_steps=n_steps, tau=tau, **{**defaults, **kwargs})

    def _discounted_omega(self, batch: OfflineSamples) -> th.Tensor:
        if self.n_steps == 1:
            return super()._discounted_omega(batch)
        assert batch.nstep_discounts is not None
        one_step, n_step = (logits.sigmoid() for logits in self._target_logits(batch))
        mean = 0.5 * (one_step + batch.nstep_discounts.squeeze(1) * n_step)
        return self.gamma * success_odds(th.logit(mean, eps=1e-7), self.omega_max)
