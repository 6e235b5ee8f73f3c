"""
AWAC, CQL, IQL, ReBRAC and TD3+BC against d3rlpy: the same weights, batch and noise give the same losses.

Where the conventions differ, the tests say how:

- d3rlpy subtracts the Lagrange threshold from CQL's conservative term with a fixed weight too: a constant.
- d3rlpy's target of CQL takes the policy's mode where ours takes a sample (a sample of no noise is the mode).
- d3rlpy's loss of the entropy coefficient has the coefficient where SB3's has its logarithm: Adam's first step is the same.
- IQL's policy is a Gaussian around tanh(mean) there; ours is squashed, fitted by squared error. The weights are the same.
- SB3 adds 1e-6 inside of the logarithm of a squashed Gaussian's density.
- AWAC's policy is a Gaussian around tanh(mean) there, as IQL's. Its target has an entropy term, with a coefficient of 1, which
  neither the paper nor the authors' code has. Its actor's loss is a sum over the batch; ours, as the authors', is a mean.
- A LayerNorm stands behind the activation there, and in front of it here.
"""

import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, write_dataset
from gymnasium import spaces

from sb3_offline import AWAC, CQL, IQL, TD3BC, ReBRAC

d3rlpy = pytest.importorskip("d3rlpy", reason="see CONTRIBUTING.md for how to install it")

STATES = spaces.Box(-5, 5, (3,), np.float32)
N_ACTIONS, N_SAMPLES, GAMMA, RATE = ACTIONS.shape[0], 4, 0.9, 1e-3
ENCODER = d3rlpy.models.VectorEncoderFactory([16, 16])
CONFIG = {"actor_encoder_factory": ENCODER, "critic_encoder_factory": ENCODER, "gamma": GAMMA}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "states.h5"
    write_dataset(path, 40, STATES)
    return str(path)


def make(algorithm, dataset, monkeypatch, **kwargs):
    """:return: a model with a target of its own, its fixed batch, and the list that its losses go to"""
    kwargs = {"gamma": GAMMA, "batch_size": 64, "seed": 0, "learning_rate": RATE, **kwargs}
    model = algorithm("MlpPolicy", None, dataset, policy_kwargs={"net_arch": [16, 16], "mixed_precision": False}, **kwargs)
    batch, losses, optimize = model.replay_buffer.sample(64), [], model._optimize
    assert 0 < batch.dones.sum() < 64
    for parameter in model.critic_target.parameters():
        parameter.add_(0.1 * th.randn_like(parameter))

    def keep(optimizer, loss):
        """Networks stay as they are; learned coefficients move."""
        if optimizer in (model.actor.optimizer, model.critic.optimizer):
            losses.append(loss.item())
        else:
            optimize(optimizer, loss)

    monkeypatch.setattr(model, "_optimize", keep)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *_, **__: batch)
    return model, batch, losses


def copy_weights(source, target):
    """Linear and normalising layers in their order."""
    layers = [[m for m in module.modules() if isinstance(m, th.nn.Linear | th.nn.LayerNorm)] for module in (source, target)]
    for ours, theirs in zip(*layers, strict=True):
        theirs.load_state_dict(ours.state_dict())


def their_twin(config, model, batch):
    """:return: d3rlpy's algorithm with the model's weights, and the batch as it wants it"""
    algorithm = config.create()
    algorithm.create_impl(STATES.shape, N_ACTIONS)
    modules = algorithm.impl.modules
    for critic, functions in ((model.critic, modules.q_funcs), (model.critic_target, modules.targ_q_funcs)):
        for ours, theirs in zip(critic.q_networks, functions, strict=True):
            copy_weights(ours, theirs)
    # Standardised, as the networks see them
    observations, following = (model.critic.encode(o).detach() for o in (batch.observations, batch.next_observations))
    theirs = d3rlpy.torch_utility.TorchMiniBatch(
        observations=observations,
        actions=batch.actions,
        rewards=batch.rewards,
        next_observations=following,
        next_actions=batch.actions if batch.horizons[0].next_actions is None else batch.horizons[0].next_actions,
        returns_to_go=batch.rewards,
        terminals=batch.dones,
        intervals=th.ones_like(batch.rewards),
        device="cpu:0",
    )
    return algorithm.impl, modules, theirs


def same_noise(model, monkeypatch):
    """One action from `single`, K actions from `many`, K + 1 actions from the mode and `many`; uniform ones from `uniform`."""
    from d3rlpy.models.torch.distributions import SquashedGaussianDistribution

    single, many = th.randn(64, N_ACTIONS), th.randn(64, N_SAMPLES, N_ACTIONS)
    uniform = th.rand(64, N_SAMPLES, N_ACTIONS)
    noises = {None: single.unsqueeze(1), N_SAMPLES: many, N_SAMPLES + 1: th.cat([th.zeros(64, 1, N_ACTIONS), many], dim=1)}

    def our_sample(features, n=None):
        mean, log_std = model.actor.gaussian_parameters(features)
        raw = mean.unsqueeze(1) + log_std.exp().unsqueeze(1) * noises[n]
        flat = raw.flatten(0, 1)
        mean, log_std = (x.repeat_interleave(raw.shape[1], dim=0) for x in (mean, log_std))
        log_prob = model.actor.action_dist.proba_distribution(mean, log_std).log_prob(flat.tanh(), flat).view(raw.shape[:2])
        return (raw.tanh().squeeze(1), log_prob.squeeze(1)) if n is None else (raw.tanh(), log_prob)

    def one(self):
        raw = self._mean + self._std * single
        return raw.tanh(), self._log_prob_from_raw_y(raw)

    def several(self, n):
        assert n == N_SAMPLES
        raw = self._mean + self._std * many.transpose(0, 1)
        return raw.tanh().transpose(0, 1), self._log_prob_from_raw_y(raw).transpose(0, 1)

    monkeypatch.setattr(model.actor, "sample", our_sample)
    monkeypatch.setattr(th, "rand_like", lambda _: uniform)
    monkeypatch.setattr(th.Tensor, "uniform_", lambda self, low, high: (uniform * (high - low) + low).view(-1, N_ACTIONS))
    monkeypatch.setattr(SquashedGaussianDistribution, "sample_with_log_prob", one)
    monkeypatch.setattr(SquashedGaussianDistribution, "sample_n_with_log_prob", several)


@pytest.mark.parametrize("cql_alpha", [0.7, "auto_0.7"])
def test_cql(cql_alpha, dataset, monkeypatch):
    gap = 2.5
    model, batch, losses = make(
        CQL, dataset, monkeypatch, cql_alpha=cql_alpha, lagrange_threshold=gap, n_action_samples=N_SAMPLES, ent_coef="auto_0.3"
    )
    config = d3rlpy.algos.CQLConfig(
        **CONFIG,
        n_action_samples=N_SAMPLES,
        conservative_weight=1.0,
        alpha_threshold=gap,
        initial_alpha=0.7,
        alpha_learning_rate=RATE if isinstance(cql_alpha, str) else 0.0,
        initial_temperature=0.3,
        temp_learning_rate=RATE,
    )
    impl, modules, theirs = their_twin(config, model, batch)
    copy_weights(model.actor, modules.policy)
    same_noise(model, monkeypatch)
    model.learn(1, log_interval=None)

    critic = impl.compute_critic_loss(theirs, impl.compute_target(theirs))
    constant = 0.0 if isinstance(cql_alpha, str) else 2 * cql_alpha * gap
    assert losses[0] == pytest.approx(critic.critic_loss.item() + constant, rel=1e-5)
    assert model.log_cql_alpha.exp().item() == pytest.approx(critic.alpha.item(), rel=1e-5)
    assert (model.log_cql_alpha.exp().item() == pytest.approx(0.7)) == (cql_alpha == 0.7)

    actor = impl.compute_actor_loss(theirs, modules.policy(theirs.observations))
    assert losses[1] == pytest.approx(actor.actor_loss.item(), rel=1e-5)
    assert model.log_ent_coef.exp().item() == pytest.approx(actor.temp.item(), rel=1e-5) != pytest.approx(0.3, rel=1e-5)


def test_iql(dataset, monkeypatch):
    from d3rlpy.models.torch.distributions import GaussianDistribution

    options = {"expectile": 0.8, "inverse_temperature": 4.0, "weight_max": 1.1}
    model, batch, losses = make(IQL, dataset, monkeypatch, **options)
    config = d3rlpy.algos.IQLConfig(**CONFIG, value_encoder_factory=ENCODER, expectile=0.8, weight_temp=4.0, max_weight=1.1)
    impl, modules, theirs = their_twin(config, model, batch)
    copy_weights(model.critic.get_submodule("vf"), modules.value_func)
    model.learn(1, log_interval=None)

    critic = impl.compute_critic_loss(theirs, impl.compute_target(theirs))
    assert losses[0] == pytest.approx(critic.critic_loss.item(), rel=1e-5)
    weights = impl._compute_weight(theirs)
    assert (weights == 1.1).any() and (weights < 1.1).any()
    fit = -model.actor.regression_loss(theirs.observations, batch.actions).detach().unsqueeze(1)
    monkeypatch.setattr(GaussianDistribution, "log_prob", lambda *_: fit)
    actor = impl.compute_actor_loss(theirs, modules.policy(theirs.observations))
    assert losses[1] == pytest.approx(actor.actor_loss.item(), rel=1e-5)


def test_td3_bc(dataset, monkeypatch):
    model, batch, losses = make(TD3BC, dataset, monkeypatch, alpha=1.5, target_policy_noise=0.3, target_noise_clip=0.4)
    for parameter in model.actor_target.mu.parameters():
        parameter.add_(0.1 * th.randn_like(parameter))
    config = d3rlpy.algos.TD3PlusBCConfig(**CONFIG, alpha=1.5, target_smoothing_sigma=0.3, target_smoothing_clip=0.4)
    impl, modules, theirs = their_twin(config, model, batch)
    copy_weights(model.actor, modules.policy)
    copy_weights(model.actor_target, modules.targ_policy)
    noise = th.randn(64, N_ACTIONS)
    monkeypatch.setattr(th, "randn_like", lambda _: noise)
    monkeypatch.setattr(th, "randn", lambda *_, **__: noise)
    targets = impl.compute_target(theirs)
    model.learn(1, log_interval=None)
    assert len(losses) == 1  # the policy is delayed
    model._n_updates = model.policy_delay - 1
    model.learn(1, log_interval=None)
    assert losses[1] == losses[0] == pytest.approx(impl.compute_critic_loss(theirs, targets).critic_loss.item(), rel=1e-5)
    actor = impl.compute_actor_loss(theirs, modules.policy(theirs.observations))
    assert losses[2] == pytest.approx(actor.actor_loss.item(), rel=1e-5)


def test_awac(dataset, monkeypatch):
    from d3rlpy.models.torch.distributions import GaussianDistribution, SquashedGaussianDistribution

    model, batch, losses = make(AWAC, dataset, monkeypatch, temperature=0.05, n_action_samples=N_SAMPLES)
    config = d3rlpy.algos.AWACConfig(**CONFIG, lam=0.05, n_action_samples=N_SAMPLES)
    impl, modules, theirs = their_twin(config, model, batch)
    modules.log_temp._parameter.data.fill_(-th.inf)
    following, own = th.rand(64, N_ACTIONS) * 2 - 1, th.rand(64, N_SAMPLES, N_ACTIONS) * 2 - 1
    monkeypatch.setattr(model.actor, "sample", lambda _, n=None: (following if n is None else own, None))
    monkeypatch.setattr(SquashedGaussianDistribution, "sample_with_log_prob", lambda _: (following, th.ones(64, 1)))
    monkeypatch.setattr(GaussianDistribution, "sample_n", lambda _, n: own)
    model.learn(1, log_interval=None)

    critic = impl.compute_critic_loss(theirs, impl.compute_target(theirs))
    assert losses[0] == pytest.approx(critic.critic_loss.item(), rel=1e-5)
    weights = impl._compute_weights(theirs.observations, theirs.actions)
    assert weights.min() < 0.5 and weights.max() > 2
    fit = -model.actor.regression_loss(theirs.observations, batch.actions).detach().unsqueeze(1)
    monkeypatch.setattr(GaussianDistribution, "log_prob", lambda *_: fit)
    actor = impl.compute_actor_loss(theirs, modules.policy(theirs.observations))
    assert losses[1] == pytest.approx(actor.actor_loss.item() / 64, rel=1e-5)


def test_rebrac(dataset, monkeypatch):
    options = {"actor_bc_coef": 0.3, "critic_bc_coef": 0.2, "target_policy_noise": 0.3, "target_noise_clip": 0.4}
    model, _, losses = make(ReBRAC, dataset, monkeypatch, **options)
    batch = model._sample_batch(64)
    assert 0 < batch.dones.sum() < 64
    monkeypatch.setattr(model, "_sample_batch", lambda _: batch)
    for parameter in model.actor_target.mu.parameters():
        parameter.add_(0.1 * th.randn_like(parameter))
    config = d3rlpy.algos.ReBRACConfig(
        actor_encoder_factory=ENCODER,
        critic_encoder_factory=d3rlpy.models.VectorEncoderFactory([16, 16], use_layer_norm=True),
        gamma=GAMMA,
        actor_beta=0.3,
        critic_beta=0.2,
        target_smoothing_sigma=0.3,
        target_smoothing_clip=0.4,
    )
    impl, modules, theirs = their_twin(config, model, batch)
    for function in (*modules.q_funcs, *modules.targ_q_funcs):
        linear, activation, norm, *others = function._encoder._layers
        function._encoder._layers = th.nn.Sequential(linear, norm, activation, others[0], others[2], others[1])
    copy_weights(model.actor, modules.policy)
    copy_weights(model.actor_target, modules.targ_policy)
    noise = th.randn(64, N_ACTIONS)
    monkeypatch.setattr(th, "randn_like", lambda _: noise)
    monkeypatch.setattr(th, "randn", lambda *_, **__: noise)
    targets = impl.compute_target(theirs)
    model.learn(1, log_interval=None)
    assert len(losses) == 1  # the policy is delayed
    model._n_updates = model.policy_delay - 1
    model.learn(1, log_interval=None)
    assert losses[1] == losses[0] == pytest.approx(impl.compute_critic_loss(theirs, targets).critic_loss.item(), rel=1e-5)
    actor = impl.compute_actor_loss(theirs, modules.policy(theirs.observations))
    assert losses[2] == pytest.approx(actor.actor_loss.item(), rel=1e-5)
