"""One step of ``train()`` against a plain NumPy float64 reading of Eq. 10 and 11: what goes into the terms, not they alone."""

import copy
import inspect

import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, make_observations, write_dataset
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline import BC, CEBORL, RCE
from sb3_offline.ceborl import PAPER_FORM, backups
from sb3_offline.ceborl.resampling import WeightedTransitions
from sb3_offline.common.augmentation import GROUP_SIZE, random_shift
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.labelling.calibration import Calibration
from sb3_offline.labelling.classifier import StepProbabilities

STATES = spaces.Box(-5, 5, (3,), np.float32)
IMAGES = spaces.Box(0, 255, (36, 40, 3), np.uint8)
EXAMPLES = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
GAMMA, SMALL = 0.9, {"net_arch": [16, 16], "mixed_precision": False, "actor_dropout": 0.0}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_dataset(folder / "states.h5", 12, STATES)
    write_dataset(folder / "images.h5", 6, IMAGES)
    return folder


def sigmoid(f):
    return 1 / (1 + np.exp(-f))


def softplus(f):
    return np.logaddexp(0, f)


class Reading:
    """The networks of a model as functions of NumPy arrays, its policy's mode for its samples, and one fixed batch."""

    def __init__(self, model, monkeypatch):
        self.model, actor = model, model.actor
        model.learn(20, log_interval=None)  # away from where everything is alike
        for parameter in model.critic_target.parameters():  # a target that cannot be mistaken for the online critic
            parameter.add_(0.05 * th.randn_like(parameter))
        self.batch, (examples, rows) = model.replay_buffer.sample(64), model.sample_examples()
        self.examples = examples[rows]
        self.penalized = th.rand(64, model.n_action_samples, 2) * 2 - 1
        self.losses = []
        monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: self.batch)
        monkeypatch.setattr(model, "sample_examples", lambda: (examples, rows))
        monkeypatch.setattr(model, "_sample_penalized_actions", lambda *_: self.penalized)
        monkeypatch.setattr(actor, "sample", lambda z: (th.tanh(actor.gaussian_parameters(z)[0]), th.full((len(z),), -3.0)))
        monkeypatch.setattr(model, "_optimize", lambda optimizer, loss: self.losses.append((optimizer, loss)))

    def logits(self, critic, observations, actions):
        with th.no_grad():
            return critic.values(critic.encode(observations), actions).double().numpy()

    def mode(self, observations):
        with th.no_grad():
            return self.model.actor(observations, deterministic=True)

    def train(self):
        self.model.train(1, 64)
        (critic_optimizer, critic_loss), (actor_optimizer, actor_loss) = self.losses
        assert critic_optimizer is self.model.critic.optimizer and actor_optimizer is self.model.actor.optimizer
        return critic_loss.item(), actor_loss.item()


def recursive(f, weight):
    return (weight * softplus(-f) + softplus(f)).mean(axis=-1).sum()


@pytest.mark.parametrize("advantage", ["return", "value", "mean"])
def test_in_sample_form(dataset, monkeypatch, advantage):
    n_steps, beta, prior, share, temperature, floor, weight_max, exponent = 3, 0.2, 0.5, 0.1, 0.5, 0.05, 1.2, 0.7
    model = CEBORL(
        "MlpPolicy",
        None,
        dataset / "states.h5",
        EXAMPLES,
        gamma=GAMMA,
        n_steps=n_steps,
        beta=beta,
        example_share=share,
        backup="dataset",
        temperature=temperature,
        state_exponent=exponent,
        advantage=advantage,
        initial_odds=0.5,
        n_action_samples=5,
        seed=0,
        policy_kwargs=SMALL,
    )
    model.class_prior, model._extraction.weight_max = prior, weight_max
    model._extraction.advantage_floor, model._extraction.promise_floor = floor, 10 * floor
    reading = Reading(model, monkeypatch)
    batch, examples, target = reading.batch, reading.examples, model.critic_target
    one, many = (np.exp(reading.logits(target, h.observations, h.next_actions).min(axis=0)) for h in batch.horizons)
    weight = 0.5 * (GAMMA * one + batch.horizons[1].discounts.numpy()[:, 0] * many)
    example_weight = GAMMA * np.exp(reading.logits(target, examples, reading.mode(examples)).min(axis=0))
    f = reading.logits(model.critic, batch.observations, batch.actions)
    f_examples = reading.logits(model.critic, examples, reading.mode(examples))
    f_penalized = reading.logits(model.critic, batch.observations, reading.penalized)
    with th.no_grad():
        v, v_examples = (
            model.critic.state_values(model.critic.encode(o)).double().numpy() for o in (batch.observations, examples)
        )
    a = (np.log(np.exp(sigmoid(f_penalized)).mean(axis=-1)) - sigmoid(f)).mean(axis=-1).sum()
    b = (1 - GAMMA) * prior * softplus(-f_examples).mean(axis=-1).sum() + share * recursive(f_examples, example_weight)
    state = recursive(v, weight) + (1 - GAMMA) * prior * softplus(-v_examples).mean()
    state += share * recursive(v_examples, example_weight)

    eps = floor * np.exp(f_examples.min(axis=0)).mean()
    of_actions = np.exp(f.min(axis=0))
    odds = {"return": weight, "value": of_actions, "mean": np.sqrt(weight * of_actions)}[advantage]
    weights = ((odds + eps) / (np.exp(v) + eps)) ** (1 / temperature)
    assert (weights > weight_max).any() and (weights < weight_max).any()
    delta = 10 * eps
    weights = np.minimum(weights, weight_max) * (odds / (odds + delta) * np.exp(v) / (np.exp(v) + delta)) ** exponent
    monkeypatch.setattr(model._extraction.pool, "draw", lambda n: batch.indices[:n].numpy())
    with th.no_grad():
        mean, log_std = (x.double().numpy() for x in model.actor.gaussian_parameters(model.actor.encode(batch.observations)))
    actions = batch.actions.double().numpy()
    inside = np.clip(actions, -0.999, 0.999)
    gaussian = -0.5 * ((np.arctanh(inside) - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
    log_prob = (gaussian - np.log(1 - inside**2)).sum(axis=1)
    regression = ((np.tanh(mean) - actions) ** 2).sum(axis=1) - log_prob

    critic_loss, actor_loss = reading.train()
    assert critic_loss == pytest.approx(beta * a + b + recursive(f, weight) + state, rel=1e-5)
    last = {int(index): weight for index, weight in zip(batch.indices, weights, strict=True)}  # a batch may hold one twice
    np.testing.assert_allclose(model._extraction.pool.weights[list(last)], list(last.values()), rtol=1e-4)
    assert actor_loss == pytest.approx(regression.mean(), rel=1e-3)


def test_episode_form(dataset, monkeypatch):
    """The default: omega is the best discounted detection in the rest of the episode, and nothing is bootstrapped."""
    beta, temperature, lengths = 0.2, 0.5, OfflineDataset(dataset / "states.h5").lengths
    rows = np.random.default_rng(1).random(lengths.sum() + len(lengths))
    detected = StepProbabilities(rows, lengths, Calibration(1, 0, 0), rows, rows)
    monkeypatch.setattr(backups, "success_probabilities", lambda *_, **__: detected)
    kwargs = {"gamma": GAMMA, "beta": beta, "temperature": temperature, "n_action_samples": 5, "example_share": 0.0}
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, seed=0, policy_kwargs=SMALL, **kwargs)
    reading = Reading(model, monkeypatch)
    batch, examples = model.replay_buffer.sample_pairs(64), reading.examples
    monkeypatch.setattr(model._backup, "sample", lambda _: batch)
    weight = np.empty(model.replay_buffer.size())
    for start, length in zip(np.cumsum(lengths) - lengths, lengths, strict=True):
        for t in range(start, start + length):
            weight[t] = GAMMA * max(GAMMA ** (k - t) * detected.after[k] for k in range(t, start + length))
    weight = weight[batch.indices]
    assert 0 < weight.min() < weight.max() <= GAMMA

    f = reading.logits(model.critic, batch.observations, batch.actions)
    f_examples = reading.logits(model.critic, examples, reading.mode(examples))
    f_penalized = reading.logits(model.critic, batch.observations, reading.penalized)
    with th.no_grad():
        v = model.critic.state_values(model.critic.encode(batch.observations)).double().numpy()
    a = (np.log(np.exp(sigmoid(f_penalized)).mean(axis=-1)) - sigmoid(f)).mean(axis=-1).sum()
    b = (1 - GAMMA) * softplus(-f_examples).mean(axis=-1).sum()
    eps = 0.01 * GAMMA
    odds = np.sqrt(weight * np.exp(f.min(axis=0)))
    weights = np.minimum(((odds + eps) / (np.exp(v) + eps)) ** (1 / temperature), 100.0)
    weights *= (odds / (odds + 10 * eps) * np.exp(v) / (np.exp(v) + 10 * eps)) ** 2
    critic_loss, _ = reading.train()
    assert critic_loss == pytest.approx(beta * a + b + recursive(f, weight) + recursive(v, weight), rel=1e-4)
    np.testing.assert_allclose(model._extraction.pool.weights[batch.indices], weights, rtol=1e-3)


def test_transitions_are_drawn_by_their_last_weights():
    th.manual_seed(0)
    kept = WeightedTransitions(30)
    for first, weights in ((0, [9.0, 9.0]), (0, [1.0, 3.0]), (20, [1.0, 3.0])):
        kept.add(th.arange(first, first + 2), th.tensor(weights))
    indices, counts = np.unique(kept.draw(8000), return_counts=True)
    np.testing.assert_array_equal(indices, [0, 1, 20, 21])
    np.testing.assert_allclose(counts / 8000, [0.125, 0.375, 0.125, 0.375], atol=0.03)
    assert kept.effective_share().item() == pytest.approx(0.8)


def test_with_another_dataset_no_transitions_of_the_old_one_are_drawn(dataset, tmp_path):
    write_dataset(tmp_path / "small.h5", 2, STATES)
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, batch_size=64, policy_kwargs=SMALL).learn(3)
    kept = model._extraction.pool.weights.clone()
    model.learn(1)
    assert len(kept) == model.replay_buffer.size() and (model._extraction.pool.weights[kept > 0] > 0).all()
    model.dataset = tmp_path / "small.h5"
    model.learn(1)
    assert len(model._extraction.pool.weights) == model.replay_buffer.size() < len(kept)


@pytest.mark.parametrize("n_steps", [1, 10])
def test_paper_form(dataset, monkeypatch, n_steps):
    form = {**PAPER_FORM, "gamma": GAMMA, "n_steps": n_steps, "ent_coef": 0.05, "n_action_samples": 5}
    form["policy_kwargs"] = {**PAPER_FORM["policy_kwargs"], **SMALL}
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, seed=0, **form)
    reading = Reading(model, monkeypatch)
    batch, examples = reading.batch, reading.examples
    after = [reading.logits(model.critic_target, h.observations, reading.mode(h.observations)) for h in batch.horizons]
    if n_steps == 1:  # the letter of Eq. 3
        omega = np.exp(after[0].min(axis=0))
    else:  # RCE's authors: the mean of two probabilities, then the lower of the critics
        c_bar = 0.5 * (sigmoid(after[0]) + batch.horizons[1].discounts.numpy()[:, 0] * sigmoid(after[1]))
        omega = (c_bar / (1 - c_bar)).min(axis=0)
    f = reading.logits(model.critic, batch.observations, batch.actions)
    f_penalized = reading.logits(model.critic, batch.observations, reading.penalized)
    f_examples = reading.logits(model.critic, examples, reading.mode(examples))
    f_policy = reading.logits(model.critic, batch.observations, reading.mode(batch.observations))
    a = (np.log(np.exp(sigmoid(f_penalized)).mean(axis=-1)) - sigmoid(f)).mean(axis=-1).sum()
    b = (1 - GAMMA) * softplus(-f_examples).mean(axis=-1).sum()
    critic_loss, actor_loss = reading.train()
    assert critic_loss == pytest.approx(0.1 * a + b + recursive(f, GAMMA * omega), rel=1e-5)
    assert actor_loss == pytest.approx((0.05 * -3.0 - sigmoid(f_policy.min(axis=0))).mean(), rel=1e-5)


def test_the_paper_form_names_every_setting():
    """A preset that leaves a setting out would change with the constructor's default."""
    about_the_run = {"policy", "env", "dataset", "examples", "dataset_storage", "stats_window_size", "tensorboard_log"}
    about_the_run |= {"example_keys"}  # of the data
    about_the_run |= {"self", "kwargs", "verbose", "seed", "device", "_init_setup_model"}
    assert PAPER_FORM.keys() == inspect.signature(CEBORL.__init__).parameters.keys() - about_the_run


def test_rce_is_the_paper_form_without_the_penalty(dataset):
    data = ("MlpPolicy", None, dataset / "states.h5", EXAMPLES)
    model, paper = RCE(*data), CEBORL(*data, **PAPER_FORM)
    settings = PAPER_FORM.keys() - {"policy_kwargs"}  # encoders and standard deviations are the paper's own
    assert {name: getattr(model, name) for name in settings if hasattr(model, name)}.items() <= PAPER_FORM.items()
    for part in ("_backup", "_extraction"):
        assert type(getattr(model, part)) is type(getattr(paper, part))
    with pytest.raises(TypeError, match="beta"):  # what means nothing to it is refused by name
        RCE(*data, beta=0.1)


def test_densities_of_actions_are_those_of_sb3(dataset):
    actor = BC("MlpPolicy", None, dataset / "states.h5", policy_kwargs=SMALL).actor
    features = th.randn(6, 3)
    mean, log_std = actor.gaussian_parameters(features)
    for n_samples in (None, 5):
        actions, log_prob = actor.sample(features, n_samples)
        for k in range(n_samples or 1):
            own = (actions, log_prob) if n_samples is None else (actions[:, k], log_prob[:, k])
            distribution = actor.action_dist.proba_distribution(mean, log_std)
            th.testing.assert_close(own[1], distribution.log_prob(own[0]), rtol=1e-3, atol=1e-3)
            th.testing.assert_close(own[1], actor.log_prob(features, own[0]), rtol=1e-3, atol=1e-3)


def test_bc_maximises_the_likelihood(dataset):
    model = BC("MlpPolicy", None, dataset / "states.h5", loss="log_prob", learning_rate=1e-2, policy_kwargs=SMALL, seed=0)
    batch = model.replay_buffer.sample(64)

    def likelihood():
        with th.no_grad():
            return float(model.actor.log_prob(model.actor.encode(batch.observations), batch.actions).mean())

    before = likelihood()
    model.learn(100)
    assert likelihood() > before + 0.5


def test_the_standard_deviation_has_a_floor(dataset):
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, policy_kwargs={**SMALL, "std_min": 0.2})
    th.nn.init.constant_(model.actor.log_std.bias, -50.0)
    assert model.actor.gaussian_parameters(th.zeros(1, 3))[1].exp().detach().numpy() == pytest.approx(0.2)


def test_learning_rate_follows_its_schedule_and_training_mode_is_on(dataset):
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, learning_rate=lambda p: 1e-3 * p, policy_kwargs=SMALL)
    model.predict(EXAMPLES)
    assert not model.policy.training
    model.learn(4)
    assert model.policy.training
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        assert optimizer.param_groups[0]["lr"] == pytest.approx(0.25e-3)


def test_batches_go_on_where_they_stopped_after_loading(dataset, tmp_path):
    model = BC("MlpPolicy", None, str(dataset / "states.h5"), policy_kwargs=SMALL, seed=0).learn(3)
    model.save(tmp_path / "model")
    loaded = BC.load(tmp_path / "model")
    assert th.equal(loaded.replay_buffer.sample(16).observations, model.replay_buffer.sample(16).observations)


def test_sources_can_be_replaced(dataset, tmp_path):
    model = CEBORL("MlpPolicy", None, str(dataset / "states.h5"), EXAMPLES, policy_kwargs=SMALL).learn(1)
    model.examples, model.dataset = np.full((3, 3), 0.5, np.float32), str(tmp_path / "nowhere.h5")
    with pytest.raises(RuntimeError, match="nowhere"):
        model.learn(1)
    model.dataset = str(dataset / "states.h5")
    assert (model.sample_examples()[0] == 0.5).all()


def test_examples_are_normalised_like_the_data(dataset):
    env = VecNormalize(DummyVecEnv([lambda: SpacesOnlyEnv(STATES, ACTIONS)]))
    model = CEBORL("MlpPolicy", env, dataset / "states.h5", EXAMPLES[:1], policy_kwargs=SMALL)
    np.testing.assert_allclose(model.sample_examples()[0], env.normalize_obs(EXAMPLES[:1]), rtol=1e-6)
    assert abs(env.obs_rms.var - 1).max() > 1e-3  # fitted before the examples were normalised
    plain = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, policy_kwargs=SMALL).learn(1)
    with pytest.raises(RuntimeError, match="VecNormalize"):
        plain.set_env(VecNormalize(DummyVecEnv([lambda: SpacesOnlyEnv(STATES, ACTIONS)])))


def test_an_encoder_of_the_actor_is_trained_by_the_actor(dataset):
    examples = make_observations(IMAGES, 4, np.random.default_rng(0))
    kwargs = {**SMALL, "share_features_extractor": False, "features_extractor_kwargs": {"features_dim": 16}}
    model = CEBORL(
        "CnnPolicy", None, dataset / "images.h5", examples, batch_size=8, example_batch_size=4, policy_kwargs=kwargs
    )
    encoders = model.actor.features_extractor, model.critic.features_extractor
    before = [copy.deepcopy(encoder.state_dict()) for encoder in encoders]
    model.learn(2)
    assert encoders[0] is not encoders[1]
    for encoder, old in zip(encoders, before, strict=True):
        assert any(not th.equal(value, old[name]) for name, value in encoder.state_dict().items())
    with pytest.raises(TypeError, match="no critic"):
        BC("CnnPolicy", None, dataset / "images.h5", policy_kwargs={"share_features_extractor": True})


class NormalizedFeatures(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, 3)
        self.norm = th.nn.BatchNorm1d(3)

    def forward(self, observations):
        return self.norm(observations)


BATCH_NORM = {**SMALL, "features_extractor_class": NormalizedFeatures}


def test_running_statistics_reach_the_target(dataset):
    model = CEBORL("MlpPolicy", None, dataset / "states.h5", EXAMPLES, policy_kwargs=BATCH_NORM).learn(3)
    online, target = model.critic.features_extractor.norm, model.critic_target.features_extractor.norm
    assert th.equal(online.running_mean, target.running_mean) and online.running_mean.abs().min() > 0


def test_images_given_to_an_mlp_are_only_scaled(dataset):
    examples = make_observations(IMAGES, 4, np.random.default_rng(0))
    model = CEBORL("MlpPolicy", None, dataset / "images.h5", examples, batch_size=8, policy_kwargs=SMALL).learn(1)
    features = model.critic.encode(model.replay_buffer.sample(8).observations)
    assert 0 <= features.min() < 0.1 and 0.9 < features.max() <= 1


def test_every_batch_of_images_is_shifted(dataset, monkeypatch):
    examples = make_observations(IMAGES, 4, np.random.default_rng(0))
    kwargs = {**SMALL, "features_extractor_kwargs": {"features_dim": 16}}
    kwargs = {"batch_size": 8, "example_batch_size": 4, "random_shift": 4, "policy_kwargs": kwargs}
    model = CEBORL("CnnPolicy", None, dataset / "images.h5", examples, seed=0, backup="dataset", **kwargs)
    sizes, augment = [], model.augment
    monkeypatch.setattr(model, "augment", lambda batch, *shift: sizes.append(len(batch)) or augment(batch, *shift))
    model.learn(1)
    assert sorted(sizes)[1:] == [8] * 4 and min(sizes) <= 4  # the examples drawn; s, s', the n-step state, the policy's batch
    batch = model.replay_buffer.sample(8).observations
    assert not th.equal(augment(batch), batch)


@pytest.mark.parametrize("max_shift", [0, 3])
def test_random_shift_repeats_edges(max_shift):
    images = th.randint(0, 256, (GROUP_SIZE + 5, 3, 9, 11), dtype=th.uint8)
    shifted = random_shift(images, max_shift, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    padded = np.pad(images.numpy(), ((0, 0), (0, 0), (max_shift, max_shift), (max_shift, max_shift)), mode="edge")
    for rows in (slice(0, GROUP_SIZE), slice(GROUP_SIZE, None)):
        down, right = rng.integers(-max_shift, max_shift + 1, size=2) + max_shift if max_shift else (0, 0)
        np.testing.assert_array_equal(shifted[rows], padded[rows, :, down : down + 9, right : right + 11])


def test_a_frozen_encoder_stays_frozen(dataset):
    model = CEBORL(
        "MlpPolicy", None, dataset / "states.h5", EXAMPLES, **{**PAPER_FORM, "batch_size": 8, "policy_kwargs": BATCH_NORM}
    )
    model.critic.features_extractor.requires_grad_(False)
    model.learn(2)
    assert not any(parameter.requires_grad for parameter in model.critic.features_extractor.parameters())
    assert all(parameter.requires_grad for net in model.critic.q_networks for parameter in net.parameters())
