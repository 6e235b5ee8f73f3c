"""Trained policies leave Python as PyTorch's own modules do: traced, scripted, exported."""

import io

import numpy as np
import pytest
import torch as th
from test_algorithms import CASES, POLICIES, batch_of, files, make  # noqa: F401

from sb3_offline import ALGOS

# PyTorch recommends torch.export instead, but SB3's guide traces.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")

#: One algorithm for each policy class; exporting takes a second.
DISTINCT = list({ALGOS[algo].policy_aliases[policy]: (algo, policy) for algo, policy in CASES}.values())


class DeterministicPolicy(th.nn.Module):
    """What SB3's guide on exporting wraps an actor in."""

    def __init__(self, actor):
        super().__init__()
        self.actor = actor

    def forward(self, observation):
        return self.actor(observation, deterministic=True)


def trained(algo, policy, files):  # noqa: F811
    """:return: a model, observations as tensors, and the actions that it predicts for them"""
    model, observations = make(algo, policy, files).learn(2), batch_of(POLICIES[policy])
    tensors = model.policy.obs_to_tensor(observations)[0]
    return model, tensors, model.predict(observations, deterministic=True)[0]


def rows(observations, n):
    return {key: part[:n] for key, part in observations.items()} if isinstance(observations, dict) else observations[:n]


def saved_and_loaded(module):
    file = io.BytesIO()
    th.jit.save(module, file)
    file.seek(0)
    return th.jit.load(file)


@pytest.mark.parametrize(("algo", "policy"), CASES)
def test_a_traced_actor_acts_as_the_model(algo, policy, files):  # noqa: F811
    model, observations, expected = trained(algo, policy, files)
    actor = saved_and_loaded(th.jit.trace(DeterministicPolicy(model.actor), (rows(observations, 2),)))
    actions = model.policy.unscale_action(actor(observations).detach().numpy())
    np.testing.assert_allclose(actions, expected, atol=1e-5)


@pytest.mark.parametrize(("algo", "policy"), DISTINCT)
def test_an_exported_actor_acts_as_the_model(algo, policy, files):  # noqa: F811
    model, observations, expected = trained(algo, policy, files)
    program = th.export.export(DeterministicPolicy(model.actor), (observations,))
    private = [str(node.target) for node in program.graph.nodes if "mkldnn" in str(node.target)]
    assert not private, "only PyTorch with oneDNN could run it"
    actions = model.policy.unscale_action(program.module()(observations).detach().numpy())
    np.testing.assert_allclose(actions, expected, atol=1e-5)


@pytest.mark.parametrize("policy", POLICIES)
def test_an_actor_in_onnx_acts_as_the_model(policy, files, tmp_path):  # noqa: F811
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    model, observations, expected = trained("cql", policy, files)
    module, arguments = DeterministicPolicy(model.actor).eval(), {"observation": observations}
    th.onnx.export(module, (), tmp_path / "actor.onnx", kwargs=arguments, dynamo=True)
    session = runtime.InferenceSession(tmp_path / "actor.onnx")
    parts = observations.values() if isinstance(observations, dict) else [observations]
    inputs = {known.name: part.numpy() for known, part in zip(session.get_inputs(), parts, strict=True)}
    np.testing.assert_allclose(model.policy.unscale_action(session.run(None, inputs)[0]), expected, atol=1e-5)


class Values(th.nn.Module):
    def __init__(self, critic):
        super().__init__()
        self.critic = critic

    def forward(self, observations, actions):
        features = self.critic.encode(observations)
        return self.critic.values(features, actions), self.critic.state_values(features)


@pytest.mark.parametrize("n_samples", [None, 3])
@pytest.mark.parametrize("policy", POLICIES)
def test_traced_critics_give_the_same_values(policy, n_samples, files):  # noqa: F811
    model = make("iql", policy, files)
    model.critic.mixed_precision = False
    module = Values(model.critic)
    observations = model.policy.obs_to_tensor(batch_of(POLICIES[policy]))[0]
    actions = th.rand(*((4, 2) if n_samples is None else (4, n_samples, 2))) * 2 - 1
    traced = saved_and_loaded(th.jit.trace(module, (rows(observations, 2), actions[:2])))
    for values, expected in zip(traced(observations, actions), module(observations, actions), strict=True):
        th.testing.assert_close(values, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("policy", POLICIES)
def test_encoders_are_scripted_as_those_of_sb3(policy, files):  # noqa: F811
    model = make("cql", policy, files)
    encoder = model.actor.features_extractor
    observations = model.policy.obs_to_tensor(batch_of(POLICIES[policy]))[0]
    scripted = saved_and_loaded(th.jit.script(encoder))
    th.testing.assert_close(scripted(observations), encoder(observations), rtol=1e-5, atol=1e-5)
