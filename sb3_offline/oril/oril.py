"""ORIL: Offline Reinforced Imitation Learning, from examples of success."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule

from sb3_offline.common.example_based import ExampleBasedAlgorithm, ExamplesLike
from sb3_offline.common.hyperparameters import POSITIVE, SHARE, WHOLE, Constraints
from sb3_offline.common.search import Choice, SearchSpace, log_uniform
from sb3_offline.cql.cql import CQL
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.examples import examples_checksum
from sb3_offline.data.reader import DatasetLike
from sb3_offline.oril.losses import classifier_loss
from sb3_offline.oril.reward_model import RewardClassifier


class ORIL(ExampleBasedAlgorithm, CQL):
    """
    Offline Reinforced Imitation Learning (ORIL, https://arxiv.org/abs/2011.13885): a classifier learns to tell success
    examples from the dataset, its probability becomes the reward, and CQL learns from this reward::

        r(s) = sigmoid(f(s)),    f:  min  E_{s ~ S*}[CE(f(s); 1)] + E_{s ~ D}[CE(f(s); 0)]

    The classifier is trained and the rewards are computed once, when the dataset is opened. The classifier is saved with the
    model, so a loaded model computes the same rewards without the examples.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy)
    :param env: see :class:`~sb3_offline.cql.cql.CQL`
    :param dataset: see :class:`~sb3_offline.cql.cql.CQL`; its rewards are not used
    :param examples: Success examples S*: a folder of images, an ``.npz`` or HDF5 file, or an array of observations
    :param learning_rate: learning rate of actor and critic, a float or a function of the remaining progress (from 1 to 0)
    :param example_batch_size: success examples in a batch of the classifier, beside ``batch_size`` observations of the dataset
    :param reward_steps: gradient steps of the classifier
    :param reward_learning_rate: learning rate of the classifier
    :param positive_prior: share of the dataset that looks like the examples, for positive-unlabelled learning of the
        classifier (ORIL's authors: 0.5); ``None`` for plain cross-entropy
    :param cql_alpha: weight of the conservative term, see :class:`~sb3_offline.cql.cql.CQL`
    :param ent_coef: Entropy coefficient, see :class:`~sb3_offline.cql.cql.CQL`
    :param kwargs: the other arguments of :class:`~sb3_offline.cql.cql.CQL`, but no ``reward_fn``
    """

    _parameter_constraints: ClassVar[Mapping[str, Constraints]] = {
        "reward_steps": [WHOLE],
        "reward_learning_rate": [POSITIVE],
        "positive_prior": [SHARE, None],
    }
    search_space: ClassVar[SearchSpace] = {
        **CQL.search_space,
        "ent_coef": log_uniform(1e-5, 0.1),
        "reward_learning_rate": log_uniform(1e-5, 1e-3),
        "positive_prior": Choice(None, 0.1, 0.3, 0.5),
    }
    #: arguments that the trained classifier depends on
    _classifier_settings: ClassVar[tuple[str, ...]] = ("example_batch_size", *_parameter_constraints)
    reward_model: RewardClassifier

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        examples: ExamplesLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        example_batch_size: int = 256,
        reward_steps: int = 1000,
        reward_learning_rate: float = 3e-4,
        positive_prior: float | None = None,
        cql_alpha: float | str = 0.1,
        ent_coef: float | str = 1e-4,
        **kwargs: Any,
    ):
        if "reward_fn" in kwargs:
            raise TypeError("ORIL makes its rewards from the examples; for other rewards use CQL(..., reward_fn=...)")
        self.reward_steps = reward_steps
        self.reward_learning_rate = reward_learning_rate
        self.positive_prior = positive_prior
        self._trained_with: dict[str, Any] | None = None
        super().__init__(
            policy,
            env,
            dataset,
            examples,
            example_batch_size,
            learning_rate=learning_rate,
            cql_alpha=cql_alpha,
            ent_coef=ent_coef,
            **kwargs,
        )

    def _setup_model(self) -> None:
        super()._setup_model()
        space = self.example_space  # the keys by which success is known
        self.reward_model = RewardClassifier(
            space,
            self.action_space,
            features_extractor=self.policy.features_extractor_class(space, **self.policy.features_extractor_kwargs),
            net_arch=self.policy.critic_kwargs["net_arch"],  # type: ignore[arg-type]
            normalize_images=self.policy.normalize_images,
        ).to(self.device)

    def relabel(self, buffer: OfflineReplayBuffer) -> None:
        if not self.reward_model.trained:
            self._train_reward_model()
        self.reward_model.set_training_mode(False)
        buffer.relabel(lambda batch: self.reward_model(batch.observations).sigmoid(), self._vec_normalize_env)

    def _train_reward_model(self) -> None:
        model, encoder = self.reward_model, self.reward_model.features_extractor
        assert encoder is not None
        for name, statistics in encoder.named_buffers():  # of the dataset, for vectors
            statistics.copy_(self.critic.features_extractor.get_buffer(name))
        model.set_training_mode(True)
        optimizer = th.optim.Adam(model.parameters(), lr=self.reward_learning_rate)
        for _ in range(self.reward_steps):
            data_logits = model(self.augment(self.replay_buffer.sample(self.batch_size, self._vec_normalize_env).observations))
            examples, rows = self.sample_examples()
            example_logits = model(self.augment(examples))[rows]
            loss = classifier_loss(example_logits, data_logits, self.positive_prior)
            self._optimize(optimizer, loss)
            self._record(
                reward_model_loss=loss,
                reward_examples=example_logits.sigmoid().mean(),
                reward_data=data_logits.sigmoid().mean(),
            )
        model.trained.fill_(1.0)
        self._trained_with = self._training_settings()

    def _training_settings(self) -> dict[str, Any]:
        """:return: everything that the classifier depends on, apart from the dataset"""
        return {
            "examples": examples_checksum(self.read_examples()),
            **{name: getattr(self, name) for name in self._classifier_settings},
        }

    @classmethod
    def load(cls, path: Any, *args: Any, **kwargs: Any) -> "ORIL":  # type: ignore[override]
        """
        See :meth:`sb3_offline.common.offline_algorithm.OfflineAlgorithm.load`. The examples and the settings of the classifier
        may be given again if they are those that it was trained with: ``TypeError`` otherwise.
        """
        model = super().load(path, *args, **kwargs)
        given = {name for name in ("examples", *cls._classifier_settings) if kwargs.get(name) is not None}
        if given and model._trained_with is not None:
            settings = model._training_settings() if "examples" in given else {name: kwargs[name] for name in given}
            others = sorted(name for name in given if settings[name] != model._trained_with[name])
            if others:
                problem = f"{', '.join(others)} of {path} cannot be replaced: its classifier is trained, and the rewards stay"
                raise TypeError(f"ORIL: {problem}; make a new model")
        return model

    @th.no_grad()
    def success_probabilities(self, observations: PyTorchObs, actions: th.Tensor | None = None) -> th.Tensor | None:
        self.reward_model.set_training_mode(False)
        return self.reward_model(observations).sigmoid()

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "reward_model"], variables
