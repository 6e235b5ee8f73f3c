"""The fast layers, against PyTorch's own layers in float64."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_offline.common.fast import mlp, operators
from sb3_offline.common.fast.layers import linear
from sb3_offline.common.policies import CnnPolicy, MlpPolicy
from sb3_offline.td3_bc.policies import TD3BCPolicy

# Relative errors. bfloat16 has 8 significant bits, and a gradient sums thousands of such roundings.
TOLERANCE = {th.float64: 1e-12, th.float32: 1e-4, th.bfloat16: 0.04}
DTYPES = list(TOLERANCE)
ACTIONS = spaces.Box(-1, 1, (4,), np.float32)


def distance(actual: th.Tensor, expected: th.Tensor) -> float:
    """:return: distance of two tensors, relative to the second"""
    return float((actual.detach().double() - expected.detach()).norm() / expected.detach().norm())


def gradients(module: nn.Module) -> th.Tensor:
    return th.cat([parameter.grad.double().flatten() for parameter in module.parameters() if parameter.grad is not None])


@pytest.fixture(params=["private", "public"])
def operator_kind(request, monkeypatch):
    """Private operators of PyTorch; or only public ones, as in a version that lacks the others."""
    if request.param == "public":
        monkeypatch.setattr(operators, "_linear_pointwise", None)
        monkeypatch.setattr(operators, "_threshold_backward", None)


@pytest.mark.usefixtures("operator_kind")
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
    actual = mlp(layers, x)
    assert actual.dtype == layers[-1].weight.dtype and distance(actual, expected) < TOLERANCE[dtype]
    actual.double().pow(2).mean().backward()
    assert distance(gradients(layers), gradients(plain)) < 2 * TOLERANCE[dtype]
    assert distance(x.grad, plain_x.grad) < 2 * TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_the_callers_tensors_stay_as_they_are(dtype):
    layers = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 8), nn.ReLU())
    x, gradient = th.randn(6, 5).to(dtype).requires_grad_(), th.randn(6, 8).to(dtype)
    output = mlp(layers, x)
    before = [tensor.detach().clone() for tensor in (x, output, gradient)]
    output.backward(gradient)
    assert all(th.equal(tensor, old) for tensor, old in zip((x, output, gradient), before, strict=True))
    output = mlp(layers, x)
    output.detach().zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        output.backward(gradient)


@pytest.mark.parametrize("last", [nn.LeakyReLU(inplace=True), nn.Hardtanh(inplace=True)])
def test_layers_between_may_work_in_place(last):
    layers, x = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 8), last), th.randn(6, 5)
    plain = copy.deepcopy(layers)
    mlp(layers, x).pow(2).sum().backward()
    plain(x).pow(2).sum().backward()
    assert distance(gradients(layers), gradients(plain)) < TOLERANCE[th.float32]


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_a_graph_may_be_kept_for_a_second_backward_pass(dtype):
    layers = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 8), nn.ReLU(), nn.Linear(8, 1))
    loss = mlp(layers, th.randn(6, 5).to(dtype)).pow(2).sum()
    loss.backward(retain_graph=True)
    once = gradients(layers)
    loss.backward()
    assert th.equal(gradients(layers), 2 * once)


@pytest.mark.parametrize("last", [nn.Linear(8, 1), nn.ReLU()])
@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_of_gradients(dtype, last):
    """As in a penalty on the gradient by the input, also with a bias for each row."""
    th.manual_seed(0)
    layers, row_biases = nn.Sequential(nn.Tanh(), nn.Linear(8, 8), nn.ReLU(), copy.deepcopy(last)).double(), th.randn(3, 8)
    found = {}
    for name, own in (("plain", th.float64), ("fast", dtype)):
        module = copy.deepcopy(layers).to(th.float64 if own == th.float64 else th.float32)
        weight = nn.Parameter(th.linspace(-1, 1, 40).view(8, 5).sin().to(module[1].weight.dtype))
        biases = nn.Parameter(row_biases.to(weight.dtype))
        x = th.linspace(-2, 2, 30).view(6, 5).to(own).requires_grad_()
        if name == "plain":
            output = module((x @ weight.T).view(2, 3, 8).add(biases).view(6, 8))
        else:
            output = mlp([(weight, biases), *module], x)
        (by_input,) = th.autograd.grad(output.sum(), x, create_graph=True)
        by_input.double().pow(2).sum().backward()
        tensors = [weight.grad, biases.grad, x.grad, *(p.grad for p in module.parameters() if p.grad is not None)]
        found[name] = th.cat([tensor.double().flatten() for tensor in tensors])
    assert found["plain"].norm() > 0 and distance(found["fast"], found["plain"]) < 2 * TOLERANCE[dtype]


def test_functions_of_torch_func():
    layers, x = nn.Sequential(nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 1)), th.randn(6, 5)

    def value(x: th.Tensor) -> th.Tensor:
        return mlp(layers, x.unsqueeze(0)).sum()

    plain_x = x.clone().requires_grad_()
    layers(plain_x).sum().backward()
    th.testing.assert_close(th.func.vmap(th.func.grad(value))(x), plain_x.grad)


@pytest.mark.parametrize("dtype", DTYPES)
def test_columns_of_a_matrix(dtype):
    matrix = th.randn(8, 6, dtype=th.float64)
    x = th.randn(4, 2, dtype=th.float64).to(dtype)
    assert distance(linear(x, matrix[:, 4:].to(dtype), None), x.double() @ matrix[:, 4:].T) < TOLERANCE[dtype]


@pytest.mark.parametrize("mixed_precision", [False, True])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_values_of_many_actions(mixed_precision, layer_norm):
    """Values and gradients are those of the network applied to each pair of state and action."""
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
def test_images_may_come_as_bytes(mixed_precision):
    """uint8 images lead to the same features and gradients as the images that SB3's preprocessing scales."""
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
def test_a_policy_acts_in_float32(policy_class):
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
