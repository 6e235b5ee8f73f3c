"""SB3's SAC opens exported models, and mixes the dataset with the transitions that it collects."""

import numpy as np
import pytest
import torch as th
from data_files import make_episode, write_dataset
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.utils import set_random_seed
from test_algorithms import ACTIONS, CASES, POLICIES, STATES, ForbiddenEnv, batch_of, files, make  # noqa: F401

from sb3_offline import BC, CQL
from sb3_offline.common.online import export_sac
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.mixed import MixedDictReplayBuffer, MixedReplayBuffer
from sb3_offline.td3_bc.policies import DeterministicActor


@pytest.mark.parametrize(("algo", "policy"), [case for case in CASES if case[0] != "bc"])
def test_sac_goes_on_from_the_same_policy(algo, policy, files, tmp_path):  # noqa: F811
    space = POLICIES[policy]
    model = make(algo, policy, files).learn(2)
    export_sac(model, tmp_path / "sac", data_ratio=0.5, buffer_size=100)
    sac = SAC.load(tmp_path / "sac", env=ForbiddenEnv(space, allowed=True))
    observations = batch_of(space)
    is_deterministic = isinstance(model.actor, DeterministicActor)
    for deterministic in (True,) if is_deterministic else (True, False):
        set_random_seed(0)
        wanted = model.predict(observations, deterministic=deterministic)[0]
        set_random_seed(0)
        tolerance = 1e-6 if is_deterministic else 0  # SAC computes its deterministic actor by other products.
        np.testing.assert_allclose(
            sac.predict(observations, deterministic=deterministic)[0], wanted, rtol=tolerance, atol=tolerance
        )
    same = all(th.equal(value, sac.policy.state_dict()[f"critic.{name}"]) for name, value in model.critic.state_dict().items()
               if name.startswith("qf"))  # fmt: skip
    assert same == (algo not in ("ceborl", "rce"))
    before = {name: value.clone() for name, value in sac.policy.state_dict().items()}
    sac.learn(6)
    changed = {name.split(".")[0] for name, value in sac.policy.state_dict().items() if not th.equal(value, before[name])}
    assert changed == {"actor", "critic", "critic_target"} and sac._n_updates >= 5


def test_errors_name_what_cannot_be_exported(files, tmp_path):  # noqa: F811
    with pytest.raises(TypeError, match="BC has no critic"):
        export_sac(BC("MlpPolicy", None, files["MlpPolicy"][0]), tmp_path / "sac")
    with pytest.raises(ValueError, match=r"data_ratio is 1\.5"):
        export_sac(CQL("MlpPolicy", None, files["MlpPolicy"][0]), tmp_path / "sac", data_ratio=1.5)


@pytest.mark.parametrize("space", [STATES, POLICIES["MultiInputPolicy"]])
def test_batches_mix_dataset_and_environment_in_the_ratio(space, tmp_path):
    write_dataset(tmp_path / "d.h5", 5, space)
    kind = MixedDictReplayBuffer if isinstance(space, spaces.Dict) else MixedReplayBuffer
    buffer = kind(20, space, ACTIONS, "cpu", dataset=str(tmp_path / "d.h5"), data_ratio=0.25)
    recorded = set(np.concatenate([make_episode(i, space)["rewards"] for i in range(5)]))
    batch = buffer.sample(16)
    assert len(batch.rewards) == 16 and set(batch.rewards.numpy().ravel()) <= recorded  # SAC has collected nothing yet.
    observation = batch_of(space, 1)
    for _ in range(3):
        buffer.add(observation, observation, np.zeros((1, 2), np.float32), np.array([77.0]), np.array([False]), [{}])
    batch = buffer.sample(16)
    rewards = batch.rewards.numpy().ravel()
    assert (rewards[4:] == 77.0).all() and set(rewards[:4]) <= recorded
    parts = [batch.observations, batch.next_observations]
    arrays = [array for part in parts for array in (part.values() if isinstance(part, dict) else [part])]
    assert {len(array) for array in arrays} == {16} and batch.actions.shape == (16, 2) and batch.dones.shape == (16, 1)


def test_sac_goes_on_with_the_rewards_that_the_critic_learned_from(files, tmp_path):  # noqa: F811
    model = make("cql", "MlpPolicy", files, reward_fn="success").learn(1)
    export_sac(model, tmp_path / "sac", data_ratio=0.5, buffer_size=100)
    sac = SAC.load(tmp_path / "sac", env=ForbiddenEnv(STATES, allowed=True))
    assert set(np.unique(sac.replay_buffer.offline.rewards)) == {0, 1}
    n_steps = model.replay_buffer.size()
    for rewards, checksum in ((np.zeros(n_steps - 1), None), (np.zeros(n_steps), 1)):
        with pytest.raises(DatasetError, match=r"rewards: are of other data.*export the model again"):
            MixedReplayBuffer(20, STATES, ACTIONS, dataset=files["MlpPolicy"][0], rewards=rewards, checksum=checksum)


def test_mixed_batches_follow_the_seed(files):  # noqa: F811
    kwargs = {"dataset": files["MlpPolicy"][0]}
    ends = []
    for _ in range(2):
        env = ForbiddenEnv(STATES, allowed=True)
        env.observation_space.seed(0)
        sac = SAC("MlpPolicy", env, seed=0, learning_starts=2, batch_size=4, buffer_size=20, policy_kwargs={"net_arch": [4]},
                  replay_buffer_class=MixedReplayBuffer, replay_buffer_kwargs=kwargs)  # fmt: skip
        ends.append(th.cat([parameter.flatten() for parameter in sac.learn(5).policy.parameters()]))
    assert th.equal(*ends)


def test_a_dataset_without_rewards_cannot_be_mixed_in(tmp_path):
    from sb3_offline.data.writer import DatasetWriter

    with DatasetWriter(tmp_path / "d.h5", STATES, ACTIONS, rewards=False, success=False) as writer:
        writer.add_episode(**{name: make_episode(0, STATES)[name] for name in ("observations", "actions")})
    with pytest.raises(DatasetError, match=r"d\.h5: rewards: are missing"):
        MixedReplayBuffer(20, STATES, ACTIONS, "cpu", dataset=str(tmp_path / "d.h5"))
    write_dataset(tmp_path / "r.h5", 2, STATES)
    with pytest.raises(DatasetError, match=r"data_ratio: is 2\.0"):
        MixedReplayBuffer(20, STATES, ACTIONS, "cpu", dataset=str(tmp_path / "r.h5"), data_ratio=2.0)
