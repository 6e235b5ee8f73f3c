"""The products behind all heads, against PyTorch's own layers in float64."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_offline.common.linear import linear, run_layers
from sb3_offline.common.policies import CnnPolicy, MlpPolicy
from sb3_offline.td3_bc.policies import TD3BCPolicy

# bfloat16 has 8 significant bits; a gradient adds thousands of such roundings up, of either sign.
TOLERANCE = {th.float64: 1e-12, th.float32: 1e-4, th.bfloat16: 0.04}
DTYPES = list(TOLERANCE)
ACTIONS = spaces.Box(-1, 1, (4,), np.float32)


def distance(actual: th.Tensor, expected: th.Tensor) -> float:
    """:return: of two tensors, relative to the second"""
    return float((actual.detach().double() - expected.detach()).norm() / expected.detach().norm())


def gradients(module: nn.Module) -> th.Tensor:
    return th.cat([parameter.grad.double().flatten() for parameter in module.parameters() if parameter.grad is not None])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("rows", [7, 1100])
def test_layers(dtype, rows):
    th.manual_seed(0)
    layers = nn.Sequential(
        nn.Linear(5, 300), nn.ReLU(), nn.Linear(300, 40), nn.LayerNorm(40), nn.Tanh(), nn.Linear(40, 40), nn.Linear(40, 1)
    )
    x = th.randn(rows, 5)
    plain, plain_x = copy.deepcopy(layers).double(), x.double().requires_grad_()
    expected = plain(plain_x)
    expected.pow(2).mean().backward()
    layers = layers.double() if dtype == th.float64 else layers
    x = x.to(dtype).requires_grad_()
    actual = run_layers(list(layers), x)
    assert actual.dtype == layers[-1].weight.dtype and distance(actual, expected) < TOLERANCE[dtype]
    actual.double().pow(2).mean().backward()
    assert distance(gradients(layers), gradients(plain)) < 2 * TOLERANCE[dtype]
    assert distance(x.grad, plain_x.grad) < 2 * TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", DTYPES)
def test_columns_of_a_matrix(dtype):
    matrix = th.randn(8, 6, dtype=th.float64)
    x = th.randn(4, 2, dtype=th.float64).to(dtype)
    assert distance(linear(x, matrix[:, 4:].to(dtype)), x.double() @ matrix[:, 4:].T) < TOLERANCE[dtype]


@pytest.mark.parametrize("mixed_precision", [False, True])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_values_of_many_actions(mixed_precision, layer_norm):
    """The split first layer gives what the whole network gives for every pair, and the same gradients."""
    observation_space = spaces.Box(-1, 1, (9,), np.float32)
    policy = MlpPolicy(
        observation_space, ACTIONS, lambda _: 1e-3, mixed_precision=mixed_precision, critic_layer_norm=layer_norm
    )
    critic, plain = policy.critic, copy.deepcopy(policy.critic).double()
    observations, actions = th.randn(32, 9), th.rand(32, 5, 4) * 2 - 1
    values = critic.values(critic.encode(observations), actions)
    pairs = th.cat([observations.unsqueeze(1).expand(-1, 5, -1), actions], dim=2).double()
    expected = th.stack([q_net(pairs).squeeze(-1) for q_net in plain.q_networks])
    tolerance = TOLERANCE[th.bfloat16 if mixed_precision else th.float32]
    assert values.dtype == th.float32 and values.shape == (2, 32, 5) and distance(values, expected) < tolerance
    th.logsumexp(values, dim=2).mean().backward()
    th.logsumexp(expected, dim=2).mean().backward()
    assert distance(gradients(critic), gradients(plain)) < 2 * tolerance


@pytest.mark.parametrize("n_actions", [None, 5])
def test_large_values_keep_their_differences(n_actions):
    kwargs = {"mixed_precision": True, "critic_output_bias": -1000.0, "critic_state_value": True}
    critic = MlpPolicy(spaces.Box(-1, 1, (9,), np.float32), ACTIONS, lambda _: 1e-3, **kwargs).critic
    observations, actions = th.randn(32, 9), th.rand(*((32, n_actions, 4) if n_actions else (32, 4))) * 2 - 1
    features = critic.encode(observations)
    assert features.dtype == th.bfloat16
    rough = [critic.values(features, actions), critic.state_values(features)]
    exact = [critic.values(features.float(), actions), critic.state_values(features.float())]
    for values, expected in zip(rough, exact, strict=True):
        assert distance(values + 1000, expected + 1000) < TOLERANCE[th.bfloat16]


@pytest.mark.parametrize("mixed_precision", [False, True])
def test_pictures_may_come_as_bytes(mixed_precision):
    """The encoder takes bytes as they are, and what SB3 makes of them, to the same features and gradients."""
    space = spaces.Box(0, 255, (3, 40, 40), np.uint8)
    policy = CnnPolicy(space, ACTIONS, lambda _: 1e-3, mixed_precision=mixed_precision)
    plain = copy.deepcopy(policy.critic).double()
    images = th.randint(0, 256, (16, 3, 40, 40), dtype=th.uint8)
    features, expected = policy.critic.encode(images), plain.features_extractor(images.double() / 255)
    tolerance = TOLERANCE[th.bfloat16 if mixed_precision else th.float32]
    assert distance(features, expected) < tolerance
    features.float().pow(2).mean(dim=0)[:8].sum().backward()
    expected.pow(2).mean(dim=0)[:8].sum().backward()
    assert distance(gradients(policy.critic), gradients(plain)) < 3 * tolerance


@pytest.mark.parametrize("policy_class", [MlpPolicy, TD3BCPolicy])
def test_what_plays_is_computed_in_full_precision(policy_class):
    space = spaces.Box(-1, 1, (9,), np.float32)
    policy = policy_class(space, ACTIONS, lambda _: 1e-3, mixed_precision=True)
    actor, observation = copy.deepcopy(policy.actor).double(), np.linspace(-1, 1, 9, dtype=np.float32)
    action, _ = policy.predict(observation, deterministic=True)
    layers = actor.mu if policy_class is TD3BCPolicy else th.nn.Sequential(actor.latent_pi, actor.mu, th.nn.Tanh())
    np.testing.assert_allclose(action, layers(th.as_tensor(observation).double()).detach().numpy(), atol=1e-6)


@pytest.mark.parametrize("mixed_precision", [False, True])
def test_deterministic_actors_learn_in_the_precision_of_the_critics(mixed_precision):
    policy = TD3BCPolicy(spaces.Box(-1, 1, (9,), np.float32), ACTIONS, lambda _: 1e-3, mixed_precision=mixed_precision)
    observations, plain = th.randn(32, 9), copy.deepcopy(policy.actor).double()
    features = policy.actor.encode(observations)
    assert features.dtype == (th.bfloat16 if mixed_precision else th.float32)
    actions, expected = policy.actor.act(features), plain.mu(observations.double())
    tolerance = TOLERANCE[th.bfloat16 if mixed_precision else th.float32]
    assert actions.dtype == th.float32 and distance(actions, expected) < tolerance
    actions.pow(2).mean().backward()
    expected.pow(2).mean().backward()
    assert distance(gradients(policy.actor), gradients(plain)) < 3 * tolerance
