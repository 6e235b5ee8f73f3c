"""Losses of the reward-based algorithms against plain NumPy float64 readings (to 1e-5), and where their rewards come from."""

import pickle
from functools import partial

import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, make_episode, make_observations, write_dataset
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline import AWAC, CQL, DCQL, IQL, ORIL, ReBRAC
from sb3_offline.awac.losses import sampled_advantages, softmax_weights
from sb3_offline.common.losses import bellman_loss, expectile_loss
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.cql.losses import conservative_gaps
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.iql.losses import exponential_weights
from sb3_offline.oril.losses import classifier_loss
from sb3_offline.rebrac.losses import penalized_actor_loss, penalized_values, squared_distances

STATES = spaces.Box(-5, 5, (3,), np.float32)
IMAGES = spaces.Box(0, 255, (36, 40, 3), np.uint8)
BOTH = spaces.Dict({"image": IMAGES, "state": STATES})
SMALL = {"net_arch": [16, 16], "mixed_precision": False}
RNG = np.random.default_rng(0)
EXAMPLES = RNG.normal(size=(20, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_dataset(folder / "states.h5", 12, STATES)
    write_dataset(folder / "images.h5", 6, IMAGES)
    write_dataset(folder / "both.h5", 6, BOTH)
    return folder


def double(tensor):
    return tensor.detach().numpy().astype(np.float64)


def tensor(array):
    return th.tensor(array, dtype=th.float32)


def softplus(f):
    return np.logaddexp(0, f)


# ------------------------------------------------------------------------- losses


def test_conservative_gap_is_the_importance_weighted_soft_maximum_above_the_data():
    data, sampled = RNG.normal(scale=3, size=(2, 64)), RNG.normal(scale=3, size=(2, 64, 12))
    densities = RNG.uniform(0.1, 2, size=(64, 12))
    expected = (np.log((np.exp(sampled) / densities).sum(axis=-1)) - data).mean(axis=1)
    got = conservative_gaps(tensor(data), tensor(sampled), tensor(np.log(densities)))
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_bellman_expectile_and_weights():
    values, targets = RNG.normal(size=(2, 64)), RNG.normal(size=64)
    expected = sum(((values[i] - targets) ** 2).mean() for i in range(2))
    np.testing.assert_allclose(bellman_loss(tensor(values), tensor(targets)), expected, rtol=1e-5)
    expected = np.where(targets < 0, 0.2, 0.8) @ targets**2 / 64
    np.testing.assert_allclose(expectile_loss(tensor(targets), 0.8), expected, rtol=1e-5)
    expected = np.minimum(np.exp(3 * targets), 5)
    np.testing.assert_allclose(exponential_weights(tensor(targets), 3.0, 5.0), expected, rtol=1e-5)
    assert exponential_weights(th.tensor([1e6]), 3.0, 100.0).item() == pytest.approx(100.0)


def test_awac_weights_are_normalised_over_the_batch():
    data, policy = RNG.normal(size=(2, 64)), RNG.normal(size=(2, 64, 5))
    advantages = data.min(axis=0) - policy.min(axis=0).mean(axis=1)
    np.testing.assert_allclose(sampled_advantages(tensor(data), tensor(policy)), advantages, rtol=1e-5, atol=1e-6)
    expected = np.exp(advantages / 0.3) / np.exp(advantages / 0.3).mean()
    np.testing.assert_allclose(softmax_weights(tensor(advantages), 0.3), expected, rtol=1e-5)
    assert softmax_weights(th.tensor([1e6, 0.0]), 0.3).tolist() == [2.0, 0.0]


def test_rebrac_penalties_of_critics_and_actor():
    values, actions, data_actions = RNG.normal(size=64), RNG.uniform(-1, 1, (64, 3)), RNG.uniform(-1, 1, (64, 3))
    squares = ((actions - data_actions) ** 2).sum(axis=1)
    distances = squared_distances(tensor(actions), tensor(data_actions))
    np.testing.assert_allclose(distances, squares, rtol=1e-5)
    np.testing.assert_allclose(penalized_values(tensor(values), distances, 0.3), values - 0.3 * squares, rtol=1e-5, atol=1e-6)
    v = tensor(values).requires_grad_()
    loss = penalized_actor_loss(v, distances, 0.3)
    assert loss.item() == pytest.approx((0.3 * squares - values / np.abs(values).mean()).mean(), rel=1e-5)
    loss.backward()  # the scale of the values has no gradient
    np.testing.assert_allclose(v.grad, np.full(64, -1 / 64 / np.abs(values).mean()), rtol=1e-5)


@pytest.mark.parametrize("eta", [None, 0.5])
def test_reward_classifier_loss(eta):
    examples, data = RNG.normal(scale=3, size=32), RNG.normal(scale=3, size=64)
    positive, negative = softplus(-examples).mean(), softplus(data).mean()
    expected = positive + negative if eta is None else eta * positive + negative - eta * softplus(examples).mean()
    np.testing.assert_allclose(classifier_loss(tensor(examples), tensor(data), eta), expected, rtol=1e-5)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_step_of_cql(n_steps, folder, monkeypatch):
    """The target, terminated and n-step; where actions come from, and their densities; entropy; the critics' minimum."""
    model = CQL(
        "MlpPolicy",
        None,
        folder / "states.h5",
        gamma=0.9,
        n_steps=n_steps,
        cql_alpha=0.7,
        ent_coef=0.2,
        n_action_samples=5,
        seed=0,
        policy_kwargs=SMALL,
    ).learn(20, log_interval=None)
    batch, losses, draws, sample = model.replay_buffer.sample(64), [], [], model.actor.sample
    for parameter in model.critic_target.parameters():
        parameter.add_(0.05 * th.randn_like(parameter))
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: batch)
    monkeypatch.setattr(model.actor, "sample", lambda z, n=None: draws.append((z, n, *sample(z, n))) or draws[-1][2:])
    monkeypatch.setattr(model, "_optimize", lambda optimizer, loss: losses.append(loss.item()))
    monkeypatch.setattr(model, "_update_target", lambda: None)
    uniform = th.rand(64, 5, 2)
    monkeypatch.setattr(th, "rand_like", lambda like: uniform)
    model.train(1, 64)

    assert len(batch.horizons) == (1 if n_steps == 1 else 2)
    following, rewards, dones, discounts, _ = batch.horizons[-1]
    assert dones.any()
    z, z_next = (model.critic.encode(o) for o in (batch.observations, following))
    own, current, after = draws
    assert [draw[1] for draw in draws] == [None, 5, 6]
    assert th.equal(own[0], z) and th.equal(current[0], z) and th.equal(after[0], z_next)
    target = double(model.critic_target.values(z_next, after[2][:, 0])).min(axis=0)
    y = double(rewards)[:, 0] + double(discounts)[:, 0] * (1 - double(dones)[:, 0]) * target
    q = double(model.critic.values(z, batch.actions))
    parts = [
        double(model.critic.values(z, uniform * 2 - 1)) + 2 * np.log(2),
        double(model.critic.values(z, current[2])) - double(current[3]),
        double(model.critic.values(z, after[2][:, 1:])) - double(after[3])[:, 1:],
    ]
    gap = np.log(np.exp(np.concatenate(parts, axis=2)).sum(axis=2)) - q
    assert losses[0] == pytest.approx((((q - y) ** 2).mean(axis=1) + 0.7 * gap.mean(axis=1)).sum(), rel=1e-5)
    q_pi = double(model.critic.values(z, own[2])).min(axis=0)
    assert losses[1] == pytest.approx((0.2 * double(own[3]) - q_pi).mean(), rel=1e-5)


def test_learned_coefficients_move_towards_their_goals_and_are_saved(folder, tmp_path):
    path = str(folder / "states.h5")
    for gap, ratio in ((-100.0, 1), (1000.0, -1)):  # always above it, always under it
        kwargs = {"ent_coef": "auto_0.5", "cql_alpha": "auto_2", "lagrange_threshold": gap, "target_entropy": 100 * ratio}
        model = CQL("MlpPolicy", None, path, learning_rate=1e-2, seed=0, policy_kwargs=SMALL, **kwargs).learn(5)
        assert (model.log_cql_alpha.item() - np.log(2)) * ratio > 0.04
        assert (model.log_ent_coef.item() - np.log(0.5)) * ratio > 0.04
        model.save(tmp_path / "model")
        loaded = CQL.load(tmp_path / "model")
        assert loaded.log_cql_alpha.item() == model.log_cql_alpha.item()
        assert loaded.log_ent_coef.item() == model.log_ent_coef.item() and loaded.target_entropy == 100 * ratio
        assert loaded.cql_alpha_optimizer.state_dict()["state"] and loaded.ent_coef_optimizer.state_dict()["state"]
    assert CQL("MlpPolicy", None, path).target_entropy == -2
    with pytest.raises(TypeError, match="ent_coef is 'automatic'"):
        CQL("MlpPolicy", None, path, ent_coef="automatic")


@pytest.mark.parametrize("n_steps", [1, 3])
def test_rebrac_leaves_out_steps_without_a_next_action_and_finds_that_of_the_others(n_steps, folder):
    model = ReBRAC("MlpPolicy", None, folder / "states.h5", n_steps=n_steps, critic_bc_coef=0.5, seed=0, policy_kwargs=SMALL)
    actions, wanted, start = model.replay_buffer.actions, {}, 0
    for episode in map(partial(make_episode, space=STATES), range(12)):
        last = start + len(episode["actions"]) - 1
        wanted |= {step: actions[min(step + n_steps, last)] for step in range(start, last)}
        if episode["terminated"][-1]:
            wanted[last] = None  # nothing is bootstrapped from
        start = last + 1
    assert 0 < sum(action is None for action in wanted.values()) and len(wanted) < start

    batch = model._sample_batch(5000)
    assert set(batch.indices.tolist()) == wanted.keys()
    policy_actions, values = th.rand(5000, 2) * 2 - 1, th.randn(5000)
    got = double(values - model._target_values(values, policy_actions, batch))
    for step, action, penalty in zip(batch.indices.tolist(), double(policy_actions), got, strict=True):
        if wanted[step] is not None:
            assert penalty == pytest.approx(0.5 * ((action - wanted[step]) ** 2).sum(), rel=1e-4, abs=1e-6)


def test_rebrac_says_where_the_steps_without_a_next_action_are_all_that_counts(tmp_path):
    for length, rewards in ((4, [0, 0, 0, 1]), (1, [1])):
        with DatasetWriter(tmp_path / f"{length}.h5", STATES, ACTIONS, success=False) as writer:
            for _ in range(3):
                observations = make_observations(STATES, length + 1, RNG)
                writer.add_episode(observations, np.stack([ACTIONS.sample() for _ in range(length)]), rewards=rewards)
    with pytest.warns(UserWarning, match=r"4\.h5: rewards: all of them are 0 but those of truncated episodes' last steps"):
        ReBRAC("MlpPolicy", None, tmp_path / "4.h5", policy_kwargs=SMALL).learn(1)
    with pytest.raises(DatasetError, match=r"1\.h5: episodes/length: are all 1"):
        ReBRAC("MlpPolicy", None, tmp_path / "1.h5", policy_kwargs=SMALL).learn(1)


@pytest.mark.parametrize("policy, name", [("MlpPolicy", "states"), ("CnnPolicy", "images"), ("MultiInputPolicy", "both")])
@pytest.mark.parametrize("algorithm", [AWAC, ReBRAC])
def test_mixed_precision_learns_as_float32_does(algorithm, policy, name, folder):
    losses = []
    for mixed_precision in (False, True):
        kwargs = {"net_arch": [16, 16], "mixed_precision": mixed_precision}
        model = algorithm(policy, None, folder / f"{name}.h5", batch_size=64, seed=0, policy_kwargs=kwargs)
        model.learn(4, log_interval=None)
        assert all(p.dtype == th.float32 and p.isfinite().all() for p in model.policy.parameters())
        losses.append([float(model._metrics[loss][0]) for loss in ("critic_loss", "actor_loss")])
    assert losses[0] != losses[1] and losses[1] == pytest.approx(losses[0], rel=0.05)


@pytest.mark.parametrize(
    ("algorithm", "kwargs", "problem"),
    [
        (AWAC, {"temperature": 0}, "AWAC: temperature is 0; give a number above 0"),
        (AWAC, {"n_action_samples": 0}, "AWAC: n_action_samples is 0; give a whole number of at least 1"),
        (ReBRAC, {"critic_bc_coef": -1}, "ReBRAC: critic_bc_coef is -1; give a number of at least 0"),
        (ReBRAC, {"actor_bc_coef": "high"}, "ReBRAC: actor_bc_coef is 'high'"),
        (ReBRAC, {"policy_delay": 0}, "ReBRAC: policy_delay is 0"),
        (ReBRAC, {"alpha": 2.5}, "unexpected keyword argument 'alpha'"),
    ],
)
def test_hyperparameters_of_awac_and_rebrac_without_sense_are_refused(algorithm, kwargs, problem, folder):
    with pytest.raises(TypeError, match=problem):
        algorithm("MlpPolicy", None, folder / "states.h5", **kwargs)


# ------------------------------------------------------------------------ rewards


@pytest.mark.parametrize("algorithm", [CQL, IQL])
def test_rewards_of_a_function_take_the_place_of_the_datasets(algorithm, folder, tmp_path):
    calls = []

    def reward(batch):
        calls.append(len(batch.actions))
        return batch.next_observations[:, 0] + 2 * batch.actions.sum(dim=1) + batch.rewards[:, 0]

    options = {"n_steps": 3, "gamma": 0.5, "policy_kwargs": SMALL, "seed": 0}
    plain = algorithm("MlpPolicy", None, str(folder / "states.h5"), **options).replay_buffer
    model = algorithm("MlpPolicy", None, str(folder / "states.h5"), reward_fn=reward, **options).learn(2)
    assert sum(calls) == plain.size()  # once each
    steps = np.arange(plain.size())
    old, new = plain.transitions(steps), model.replay_buffer.transitions(steps)
    wanted = old.next_observations[:, :1] + 2 * old.actions.sum(dim=1, keepdim=True) + old.rewards
    th.testing.assert_close(new.rewards, wanted)
    first = int(np.flatnonzero(plain._steps_left >= 3)[0])
    th.testing.assert_close(new.horizons[1].rewards[first, 0], (wanted[first : first + 3, 0] * tensor([1, 0.5, 0.25])).sum())

    model.save(tmp_path / "model")  # the function too
    np.testing.assert_array_equal(algorithm.load(tmp_path / "model").replay_buffer.rewards, model.replay_buffer.rewards)
    model.reward_fn = lambda batch: np.full(len(batch.actions), 7.0)
    assert (model.replay_buffer.rewards == 7).all()
    model.reward_fn = "success"
    labels = [episode["success"] for episode in map(partial(make_episode, space=STATES), range(12))]
    np.testing.assert_array_equal(model.replay_buffer.rewards, np.concatenate(labels))


def test_long_data_are_relabelled_in_pieces(folder):
    buffer = CQL("CnnPolicy", None, folder / "images.h5", dataset_storage="mmap").replay_buffer
    sizes = []
    buffer.relabel(
        lambda batch: sizes.append(len(batch.dones)) or batch.observations.float().mean(dim=(1, 2, 3)), batch_size=7
    )
    assert max(sizes) == 7 and sum(sizes) == buffer.size() and len(sizes) > 2
    means = buffer.transitions(np.arange(buffer.size())).observations.float().mean(dim=(1, 2, 3))
    np.testing.assert_allclose(buffer.rewards, means, rtol=1e-5)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(buffer)).rewards, buffer.rewards)


def test_missing_and_broken_rewards_are_named(folder, tmp_path):
    with_none = tmp_path / "none.h5"
    with DatasetWriter(with_none, STATES, ACTIONS, rewards=False, success=False) as writer:
        writer.add_episode(make_observations(STATES, 5, RNG), np.stack([ACTIONS.sample() for _ in range(4)]))
    with pytest.raises(DatasetError, match=r"none\.h5: rewards: is missing.*reward_fn"):
        CQL("MlpPolicy", None, with_none, policy_kwargs=SMALL).learn(1)
    with pytest.raises(DatasetError, match=r"none\.h5: success: is missing"):
        CQL("MlpPolicy", None, with_none, policy_kwargs=SMALL, reward_fn="success").learn(1)
    with pytest.raises(TypeError, match="reward_fn is 'succes'"):
        CQL("MlpPolicy", None, with_none, reward_fn="succes")
    for algorithm in (DCQL, ORIL):
        with pytest.raises(TypeError, match="makes its rewards from the examples"):
            algorithm("MlpPolicy", None, with_none, EXAMPLES, reward_fn="success")
    CQL("MlpPolicy", None, with_none, policy_kwargs=SMALL, reward_fn=lambda batch: th.ones(len(batch.dones), 1)).learn(1)
    for broken in (lambda batch: batch.actions, lambda batch: batch.rewards * np.nan, lambda batch: 1.0):
        model = CQL("MlpPolicy", None, folder / "states.h5", policy_kwargs=SMALL, reward_fn=broken)
        for _ in range(2):  # nothing half-done is learned from at the second try
            with pytest.raises(DatasetError, match="reward_fn: gave"):
                model.learn(1)


def test_vec_normalize_scales_rewards_by_the_dataset(folder):
    env = VecNormalize(DummyVecEnv([lambda: SpacesOnlyEnv(STATES, ACTIONS)]), gamma=0.8, clip_reward=100.0)
    model = CQL("MlpPolicy", env, folder / "states.h5", policy_kwargs=SMALL, reward_fn=lambda batch: 30 * batch.rewards + 20)
    returns = []
    for episode in map(partial(make_episode, space=STATES), range(12)):
        total = 0.0
        for reward in episode["rewards"]:
            total = 0.8 * total + 30 * reward + 20
            returns.append(total)
    rewards = model.replay_buffer.transitions(np.arange(4), env).rewards
    np.testing.assert_allclose(rewards[:, 0], model.replay_buffer.rewards[:4] / np.std(returns), rtol=1e-5)


@pytest.mark.parametrize("distance", ["l2", "mse"])
@pytest.mark.parametrize("observations", ["states", "images", "both", "normalised"])
def test_dcql_rewards_are_distances_to_the_examples(distance, observations, folder):
    name = "states" if observations == "normalised" else observations
    space = {"states": STATES, "images": IMAGES, "both": BOTH}[name]
    examples = make_observations(space, 9, np.random.default_rng(5))
    env = VecNormalize(DummyVecEnv([lambda: SpacesOnlyEnv(STATES, ACTIONS)])) if observations == "normalised" else None
    policy = {"states": "MlpPolicy", "images": "CnnPolicy", "both": "MultiInputPolicy"}[name]
    model = DCQL(policy, env, folder / f"{name}.h5", examples, distance=distance, reward_scale=0.5)
    buffer = model.replay_buffer
    batch = buffer.transitions(np.arange(buffer.size())).observations

    def vectors(observations, key=None):
        x = np.asarray(observations, dtype=np.float64)
        if x.ndim == 4:
            return (x if x.shape[1] == 3 else x.transpose(0, 3, 1, 2)).reshape(len(x), -1) / 255
        mean, variance, _ = buffer.observation_statistics()[key] if key else buffer.observation_statistics()
        return (x - mean) / np.maximum(np.sqrt(variance), 0.05)

    if name == "both":
        s, goals = (np.concatenate([vectors(o["image"]), vectors(o["state"], "state")], axis=1) for o in (batch, examples))
    else:
        s, goals = vectors(batch), vectors(examples)
    squares = ((s[:, None] - goals[None]) ** 2).sum(axis=2)
    expected = -0.5 * (np.sqrt(squares) if distance == "l2" else squares / s.shape[1]).mean(axis=1)
    np.testing.assert_allclose(buffer.rewards, expected, rtol=1e-4)  # float32, through |s|^2 - 2 s g + |g|^2
    model.examples = examples if name == "both" else examples[:1]
    assert (model.replay_buffer.rewards == buffer.rewards).all() == (name == "both")


@pytest.mark.parametrize("positive_prior", [None, 0.5])
def test_oril_rewards_tell_examples_apart_and_come_back_with_the_model(positive_prior, folder, tmp_path):
    examples = EXAMPLES / 10 + np.array([2, -2, 2], np.float32)
    options = {"reward_steps": 300, "reward_learning_rate": 1e-2, "positive_prior": positive_prior, "policy_kwargs": SMALL}
    model = ORIL("MlpPolicy", None, str(folder / "states.h5"), examples, batch_size=32, seed=0, **options).learn(2)
    buffer = model.replay_buffer
    states = buffer.transitions(np.arange(buffer.size())).observations
    with th.no_grad():
        np.testing.assert_allclose(buffer.rewards, model.reward_model(states).sigmoid(), rtol=1e-5)
        assert model.reward_model(th.tensor(examples)).sigmoid().min() > 0.8 and buffer.rewards.mean() < 0.3
    assert th.equal(model.reward_model.features_extractor.mean, model.critic.features_extractor.mean)
    assert model.reward_model.features_extractor is not model.critic.features_extractor

    model.save(tmp_path / "model")
    loaded = ORIL.load(tmp_path / "model")  # no examples: the classifier is kept, not trained again
    loaded.learn(1, reset_num_timesteps=False)
    np.testing.assert_array_equal(loaded.replay_buffer.rewards, buffer.rewards)
    ORIL.load(tmp_path / "model", examples=examples, reward_steps=model.reward_steps)
    for name, value in (("examples", examples + 1), ("reward_steps", 7)):
        with pytest.raises(TypeError, match=f"ORIL: {name} of .*model cannot be replaced"):
            ORIL.load(tmp_path / "model", **{name: value})
    with pytest.raises(DatasetError, match=r"nowhere\.h5"):
        ORIL.load(tmp_path / "model", examples="nowhere.h5")


def test_oril_shifts_images_of_both_kinds_alike(folder, monkeypatch):
    examples = make_observations(IMAGES, 4, RNG)
    model = ORIL("CnnPolicy", None, folder / "images.h5", examples, batch_size=8, example_batch_size=4, reward_steps=2)
    sizes, augment = [], model.augment
    monkeypatch.setattr(model, "augment", lambda batch: sizes.append(len(batch)) or augment(batch))
    assert model.replay_buffer.rewards.shape == (model.replay_buffer.size(),)
    assert len(sizes) == 4 and sizes[0] == sizes[2] == 8 and max(sizes[1], sizes[3]) <= 4  # data, examples, data, examples
