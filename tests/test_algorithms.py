"""One conformance test for every algorithm, over vector, image and dict observations."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, write_dataset
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline import ALGOS, RCE
from sb3_offline.common import example_based
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.common.torch_layers import StandardizedExtractor
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.training import create_model

STATES = spaces.Box(-5, 5, (3,), np.float32)
IMAGES = spaces.Box(0, 255, (36, 40, 3), np.uint8)
BOTH = spaces.Dict({"image": IMAGES, "state": STATES})
POLICIES = {"MlpPolicy": STATES, "CnnPolicy": IMAGES, "MultiInputPolicy": BOTH}
CASES = [(algo, policy) for algo in ALGOS for policy in POLICIES]


class ForbiddenEnv(gym.Env):
    """Fails the test if a learner steps or resets it; `allowed` lets an evaluation do so."""

    def __init__(self, observation_space, allowed=False):
        self.observation_space, self.action_space, self.allowed = observation_space, ACTIONS, allowed

    def reset(self, *, seed=None, options=None):
        assert self.allowed, "a learner reset the environment"
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.allowed, "a learner stepped the environment"
        assert self.action_space.contains(action)
        self.steps += 1
        return self.observation_space.sample(), 1.0, False, self.steps == 5, {"is_success": True}


class CountSteps(BaseCallback):
    """Checks the order of training and callbacks, and stops early."""

    def __init__(self, stop_at=10**9):
        super().__init__()
        self.stop_at = stop_at

    def _on_step(self):
        assert self.num_timesteps == self.model._n_updates  # trained before the callback
        return self.num_timesteps < self.stop_at


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small dataset and examples for each kind of observation."""
    folder = tmp_path_factory.mktemp("data")
    result = {}
    for policy, space in POLICIES.items():
        write_dataset(folder / f"{policy}.h5", 6, space)
        space.seed(0)
        samples = [space.sample() for _ in range(5)]
        examples = np.stack(samples) if not isinstance(space, spaces.Dict) else None
        if examples is None:
            examples = {key: np.stack([sample[key] for sample in samples]) for key in space}
        result[policy] = (str(folder / f"{policy}.h5"), examples)
    return result


def needs_examples(algo):
    return issubclass(ALGOS[algo], ExampleBasedAlgorithm)


def make(algo, policy, files, env=None, **kwargs):
    dataset, examples = files[policy]
    if needs_examples(algo):
        kwargs = {"examples": examples, **kwargs}
        if algo != "dcql":
            kwargs["example_batch_size"] = 4
    if algo == "oril":
        kwargs = {"reward_steps": 3, **kwargs}
    if policy != "MlpPolicy":
        kwargs = {"random_shift": 2, **kwargs}
    small = {"net_arch": [16, 16]}
    if policy == "CnnPolicy":
        small["features_extractor_kwargs"] = {"features_dim": 16}
    elif policy == "MultiInputPolicy":
        small["features_extractor_kwargs"] = {"cnn_output_dim": 16}
    return ALGOS[algo](policy, env, dataset, **{"batch_size": 8, "seed": 3, "policy_kwargs": small, **kwargs})


def batch_of(space, n=4):
    space.seed(1)
    samples = [space.sample() for _ in range(n)]
    return {k: np.stack([s[k] for s in samples]) for k in space} if isinstance(space, spaces.Dict) else np.stack(samples)


@pytest.mark.parametrize(("algo", "policy"), CASES)
def test_learn_predict_save_load_go_on(algo, policy, files, tmp_path):
    space = POLICIES[policy]
    model = make(algo, policy, files, env=ForbiddenEnv(space))
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(3, log_interval=1)
    changed = {name.split(".")[0] for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}
    assert changed == dict(model.policy.named_children()).keys()
    observations = batch_of(space)
    actions, _ = model.predict(observations, deterministic=True)
    assert actions.shape == (4, *ACTIONS.shape) and all(ACTIONS.contains(action) for action in actions)

    model.save(tmp_path / "model")
    loaded = ALGOS[algo].load(tmp_path / "model")  # no dataset, no environment: good for prediction
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], actions)
    kwargs = {"examples": files[policy][1]} if needs_examples(algo) else {}
    again = ALGOS[algo].load(tmp_path / "model", env=ForbiddenEnv(space), **kwargs)
    again.learn(2, reset_num_timesteps=False)
    assert again.num_timesteps == again._n_updates == 5


@pytest.mark.parametrize("algo", ALGOS)
def test_a_resumed_run_equals_an_uninterrupted_one(algo, files, tmp_path):
    whole = make(algo, "MlpPolicy", files).learn(6).policy.state_dict()
    model = make(algo, "MlpPolicy", files).learn(3)
    model.save(tmp_path / "model")
    kwargs = {"examples": files["MlpPolicy"][1]} if needs_examples(algo) else {}
    resumed = ALGOS[algo].load(tmp_path / "model", **kwargs)
    th.rand(1)  # such as an evaluation draws before the run goes on
    resumed.learn(3, reset_num_timesteps=False)
    for name, value in resumed.policy.state_dict().items():
        assert th.equal(value, whole[name]), name


@pytest.mark.parametrize(("algo", "policy"), CASES)
def test_the_seed_decides(algo, policy, files):
    weights = [make(algo, policy, files).learn(2).policy.state_dict() for _ in range(2)]
    for name, value in weights[0].items():
        assert th.equal(value, weights[1][name]), name


@pytest.mark.parametrize("algo", ALGOS)
def test_callbacks_logger_and_evaluation(algo, files, tmp_path):
    env = Monitor(ForbiddenEnv(STATES, allowed=True))
    evaluation = EvalCallback(env, eval_freq=4, n_eval_episodes=2, log_path=tmp_path, best_model_save_path=tmp_path)
    checkpoints = CheckpointCallback(save_freq=5, save_path=tmp_path)
    model = make(algo, "MlpPolicy", files, tensorboard_log=str(tmp_path / "tb"))
    model.learn(10, callback=[evaluation, checkpoints, CountSteps()], log_interval=5, progress_bar=True)
    assert (tmp_path / "rl_model_10_steps.zip").is_file() and (tmp_path / "best_model.zip").is_file()
    assert len(np.load(tmp_path / "evaluations.npz")["successes"]) == 2
    assert next((tmp_path / "tb").glob(f"{ALGOS[algo].__name__}_1/*")).stat().st_size > 0
    assert evaluate_policy(model, env, n_eval_episodes=2)[0] == 5.0
    model.learn(100, callback=CountSteps(stop_at=14), reset_num_timesteps=False)
    assert model.num_timesteps == 14


@pytest.mark.parametrize("algo", ALGOS)
def test_shipped_configs_fit_their_algorithm(algo, files):
    for name, policy in ((algo, "MlpPolicy"), (f"{algo}_pixels", "CnnPolicy")):
        config = load_config(name, "default")
        assert config["policy"] == policy
        dataset, examples = files[policy]
        create_model(algo, config, dataset, examples if needs_examples(algo) else None)


@pytest.mark.parametrize(("text", "at_the_end"), [("lin_1e-2", 0.0), ("1e-2", 1e-2)])  # PyYAML takes 1e-2 for text
def test_a_config_may_let_the_learning_rate_fall(text, at_the_end, files, tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text(f"default: {{policy: MlpPolicy, n_timesteps: 1, batch_size: 4, learning_rate: {text}}}")
    config = load_config(str(path), "any")
    model = create_model("bc", config, files["MlpPolicy"][0])
    assert model.actor.optimizer.param_groups[0]["lr"] == 1e-2
    assert model.learn(10).actor.optimizer.param_groups[0]["lr"] == pytest.approx(at_the_end, abs=2e-3)
    with pytest.raises(RuntimeError, match="learning_rate is 'cosine'; give a number"):
        create_model("bc", {**config, "learning_rate": "cosine"}, files["MlpPolicy"][0])


@pytest.mark.parametrize("algo", ALGOS)
def test_actions_of_two_axes_and_networks_without_hidden_layers(algo, tmp_path):
    actions, rng = spaces.Box(-1, 1, (2, 3), np.float32), np.random.default_rng(0)
    with DatasetWriter(tmp_path / "d.h5", STATES, actions, success=False) as writer:
        writer.add_episode(rng.normal(size=(10, 3)), rng.uniform(-1, 1, (9, 2, 3)), rewards=np.zeros(9))
    kwargs = {"examples": rng.normal(size=(4, 3))} if needs_examples(algo) else {}
    model = ALGOS[algo]("MlpPolicy", None, tmp_path / "d.h5", batch_size=4, policy_kwargs={"net_arch": []}, **kwargs).learn(2)
    assert model.predict(STATES.sample())[0].shape == (2, 3)


@pytest.mark.parametrize("algo", ["ceborl", "cql", "oril"])
@pytest.mark.parametrize("env", [None, "given"])
def test_each_source_is_opened_once(algo, env, files, monkeypatch):
    opened, open_dataset, read = [], OfflineDataset._read, example_based.load_examples
    monkeypatch.setattr(OfflineDataset, "_read", lambda self, *args: opened.append(self.path) or open_dataset(self, *args))
    monkeypatch.setattr(example_based, "load_examples", lambda *args: opened.append("examples") or read(*args))
    make(algo, "MlpPolicy", files, env=env and ForbiddenEnv(STATES)).learn(2).learn(1, reset_num_timesteps=False)
    assert sorted(map(str, opened)) == sorted([files["MlpPolicy"][0], *["examples"] * needs_examples(algo)])


def test_no_environment_says_so(files):
    model = make("bc", "MlpPolicy", files)
    assert model.observation_space == STATES and model.action_space == ACTIONS
    with pytest.raises(RuntimeError, match="no environment"):
        model.get_env().reset()
    model.set_env(ForbiddenEnv(STATES, allowed=True))
    model.get_env().reset()


def test_what_is_missing_or_wrong_is_named(files, tmp_path):
    dataset, examples = files["MlpPolicy"]
    with pytest.raises(TypeError, match="CEBORL needs `dataset=` or `env=`"):
        ALGOS["ceborl"]("MlpPolicy")
    with pytest.raises(DatasetError, match=r"nowhere\.h5"):
        ALGOS["ceborl"]("MlpPolicy", None, str(tmp_path / "nowhere.h5"), examples)
    with pytest.raises(RuntimeError, match="has no success examples"):
        ALGOS["ceborl"]("MlpPolicy", None, dataset).learn(1)
    with pytest.raises(RuntimeError, match="has no dataset"):
        ALGOS["ceborl"]("MlpPolicy", ForbiddenEnv(STATES), examples=examples).learn(1)
    with pytest.raises(DatasetError, match="the learner has"):
        ALGOS["bc"]("MlpPolicy", ForbiddenEnv(spaces.Box(-1, 1, (7,), np.float32)), dataset).learn(1)
    with pytest.raises(TypeError, match=r"backup is 'expert'.*dataset.*policy"):
        ALGOS["ceborl"]("MlpPolicy", None, dataset, examples, backup="expert")


def test_vectors_are_standardised_by_the_dataset_and_stay_so_after_loading(files, tmp_path):
    model = make("ceborl", "MlpPolicy", files).learn(1)
    mean, variance, _ = model.replay_buffer.observation_statistics()
    encoder = model.actor.features_extractor
    assert isinstance(encoder, StandardizedExtractor) and encoder is model.critic.features_extractor
    np.testing.assert_allclose(encoder.mean, mean, rtol=1e-5)
    np.testing.assert_allclose(encoder.std, np.sqrt(variance), rtol=1e-5)
    assert th.equal(encoder.mean, model.critic_target.features_extractor.mean)
    model.save(tmp_path / "model")
    assert th.equal(ALGOS["ceborl"].load(tmp_path / "model").actor.features_extractor.mean, encoder.mean)


def test_the_users_policy_kwargs_stay_as_they_are(files):
    dataset, examples = files["MlpPolicy"]
    policy_kwargs = {"net_arch": [8]}
    ALGOS["ceborl"]("MlpPolicy", None, dataset, examples, policy_kwargs=policy_kwargs)
    rce = ALGOS["rce"]("MlpPolicy", None, dataset, examples, policy_kwargs=policy_kwargs)
    assert policy_kwargs == {"net_arch": [8]}
    assert rce.critic.q_networks[0][-1].bias.item() == 0.0  # odds of 1, not CEBORL's


@pytest.mark.parametrize(
    "policy, space",
    [
        ("MlpPolicy", spaces.Discrete(5)),
        ("MlpPolicy", spaces.MultiDiscrete([3, 4])),
        ("MultiInputPolicy", spaces.Dict({"colour": spaces.Discrete(5), "shape": spaces.MultiDiscrete([3, 4])})),
    ],
)
def test_one_hot_observations_are_not_standardised(policy, space, tmp_path):
    def samples(n):
        drawn = [space.sample() for _ in range(n)]
        is_dict = isinstance(space, spaces.Dict)
        return {key: np.stack([one[key] for one in drawn]) for key in space} if is_dict else np.stack(drawn)

    with DatasetWriter(tmp_path / "d.h5", space, ACTIONS, rewards=False, success=False) as writer:
        space.seed(0)
        writer.add_episode(samples(9), np.stack([ACTIONS.sample() for _ in range(8)]))
    model = ALGOS["ceborl"](policy, None, tmp_path / "d.h5", samples(4), n_action_samples=2).learn(2)
    assert not model.policy.standardizes
    assert model.predict(space.sample())[0].shape == ACTIONS.shape


def test_vec_normalize_is_fitted_to_the_dataset(files):
    env = VecNormalize(DummyVecEnv([lambda: ForbiddenEnv(STATES, allowed=True)]))
    model = make("ceborl", "MlpPolicy", files, env=env).learn(1)
    mean, variance, count = model.replay_buffer.observation_statistics()
    np.testing.assert_allclose(env.obs_rms.mean, mean)
    np.testing.assert_allclose(env.obs_rms.var, variance)
    assert env.obs_rms.count == count
    assert not model.actor.features_extractor.fitted  # not twice


def test_pixels_the_critic_trains_the_encoder_and_the_actor_does_not(files):
    model = make("rce", "CnnPolicy", files)
    batch = model.replay_buffer.sample(8)
    before = [p.clone() for p in model.critic.features_extractor.parameters()]
    features = model.actor.encode(batch.observations)
    assert not features.requires_grad and model.critic.encode(batch.observations).requires_grad
    model._optimize(model.actor.optimizer, model.actor.regression_loss(features, batch.actions).mean())
    assert all(th.equal(a, b) for a, b in zip(before, model.critic.features_extractor.parameters(), strict=True))


def test_critic_values_many_actions_as_one_by_one(files):
    model = make("ceborl", "MlpPolicy", files)
    features = th.randn(5, 3)
    actions = th.rand(5, 7, ACTIONS.shape[0]) * 2 - 1
    many = model.critic.values(features, actions)
    one_by_one = th.stack([model.critic.values(features, actions[:, k]) for k in range(7)], dim=-1)
    th.testing.assert_close(many, one_by_one)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_rce_target_is_that_of_its_paper(n_steps, files):
    model = make("rce", "MlpPolicy", files, n_steps=n_steps)
    batch = model.replay_buffer.sample(8)
    model._backup.target_logits = lambda *_: th.cat(
        [th.logit(th.full((2, 8), probability)) for probability in (0.6, 0.8)[: len(batch.horizons)]], dim=1
    )
    omega = model._backup.discounted_omega(batch).numpy()
    mean = np.full(8, 0.6)
    if n_steps == 3:
        mean = 0.5 * (0.6 + batch.horizons[1].discounts.numpy()[:, 0] * 0.8)
    np.testing.assert_allclose(omega, 0.99 * mean / (1 - mean), rtol=1e-4)
    assert isinstance(model, RCE)


def test_expectile_backup_takes_the_odds_of_states(files):
    """The state head goes to an upper expectile of the target's logits, and omega is its odds at the next state."""
    model = make("ceborl", "MlpPolicy", files, backup="expectile", gamma=0.99, n_steps=1, learning_rate=3e-3)
    model._backup.expectile = 0.99
    batch = model.replay_buffer.sample(8)
    expected = model.critic_target.state_values(model.critic_target.encode(batch.next_observations)).exp()
    th.testing.assert_close(model._backup.discounted_omega(batch), 0.99 * expected)
    model._update_target = lambda: None
    model.learn(300)
    batch = model.replay_buffer.transitions(np.arange(model.replay_buffer.size()))
    targets = model.critic_target.values(model.critic_target.encode(batch.observations), batch.actions).amin(dim=0)
    above = (model.critic.state_values(model.critic.encode(batch.observations)) > targets).float().mean()
    assert above > 0.8


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"backup": "dataset", "mu": "mixture"},
        {"backup": "expectile"},
        {"mu": "policy", "penalty_space": "logit"},
        {"backup": "policy", "policy_extraction": "maximize", "n_steps": 1},
        {"beta": 0.0, "example_share": 0.0},
    ],
)
def test_ceborl_variants_learn_and_log(kwargs, files):
    model = make("ceborl", "MlpPolicy", files, n_action_samples=4, **kwargs)
    model.learn(50, log_interval=None)
    wanted = {
        "classifier_data",
        "classifier_examples",
        "classifier_policy",
        "omega_p50",
        "omega_p99",
        "log_prob",
    }
    if model.backup != "episode":
        wanted |= {"omega_clipped"}
    if model.beta:
        wanted |= {"penalty", "classifier_penalized"}
    assert wanted <= model._metrics.keys()
    assert all(np.isfinite(float(total)) for total, _ in model._metrics.values())


@pytest.mark.parametrize(
    ("algo", "kwargs", "problem"),
    [
        ("ceborl", {"temperature": 0}, "temperature is 0; give a number above 0"),
        ("ceborl", {"beta": "high"}, "beta is 'high'; give a number of at least 0"),
        ("ceborl", {"n_action_samples": 1, "mu": "mixture"}, "give n_action_samples >= 2"),
        ("ceborl", {"random_shift": 2}, "random_shift shifts images, and there are none"),
        ("bc", {"batch_size": 2.5}, "batch_size is 2.5; give a whole number of at least 1"),
        ("cql", {"cql_alpha": "auto_nan"}, "cql_alpha is 'auto_nan'; give a number of at least 0, 'auto'"),
        ("cql", {"ent_coef": "auto_0"}, "ent_coef is 'auto_0'"),
        ("dcql", {"example_batch_size": 4}, "compares each observation with all examples"),
        ("iql", {"expectile": 1.5}, "expectile is 1.5; give a number between 0 and 1"),
        ("oril", {"positive_prior": -1}, "positive_prior is -1; give a number between 0 and 1, or None"),
        ("td3_bc", {"policy_delay": 0}, "policy_delay is 0; give a whole number of at least 1"),
    ],
)
def test_hyperparameters_without_sense_are_refused(algo, kwargs, problem, files, tmp_path):
    with pytest.raises(TypeError, match=problem):
        make(algo, "MlpPolicy", files, **kwargs)
    make(algo, "MlpPolicy", files).save(tmp_path / "model")
    if not kwargs.keys() & {"ent_coef", "cql_alpha", "example_batch_size"}:  # those are of another kind, see below
        with pytest.raises(TypeError, match=problem):
            ALGOS[algo].load(tmp_path / "model", **kwargs)


def test_a_loaded_model_has_the_coefficients_that_it_is_given(files, tmp_path):
    make("cql", "MlpPolicy", files, cql_alpha=5.0, ent_coef=0.1).save(tmp_path / "fixed")
    model = ALGOS["cql"].load(tmp_path / "fixed", cql_alpha=0.5)
    assert model.log_cql_alpha.exp().item() == pytest.approx(0.5) and model.log_ent_coef.exp().item() == pytest.approx(0.1)
    make("cql", "MlpPolicy", files, cql_alpha="auto_5.0").save(tmp_path / "learned")
    assert ALGOS["cql"].load(tmp_path / "learned").log_cql_alpha.exp().item() == pytest.approx(5.0)
    for name, alpha, was in (("fixed", "auto", "fixed"), ("learned", 0.5, "learned")):
        with pytest.raises(TypeError, match=f"cql_alpha is {alpha!r}, and the saved model's was {was}"):
            ALGOS["cql"].load(tmp_path / name, cql_alpha=alpha)


@pytest.mark.parametrize("algo", ALGOS)
def test_load_takes_the_policy_kwargs_of_the_constructor(algo, files, tmp_path):
    make(algo, "MlpPolicy", files).save(tmp_path / "model")
    ALGOS[algo].load(tmp_path / "model", policy_kwargs={"net_arch": [16, 16]})
