import subprocess
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import sb3_offline.envs  # noqa: F401

pytest.importorskip("metaworld")

from metaworld.asset_path_utils import full_V3_path_for

from sb3_offline.data_tools.collecting.scripted import SCRIPTS
from sb3_offline.envs.multimodal_metaworld import STATE_NAMES, TASKS, MultimodalMetaworldEnv, rendering
from sb3_offline.envs.multimodal_metaworld.scene import TableScene


def make(task="door-open", obs_type="state", **kwargs):
    return gym.make("MultimodalMetaworld-v0", task=task, obs_type=obs_type, **kwargs)


@pytest.fixture(scope="module")
def pixel_env():
    env = make(obs_type="pixels", render_mode="rgb_array", width=96, height=72)
    yield env
    env.close()


@pytest.mark.parametrize("obs_type", ["pixels", "state"])
def test_passes_both_environment_checkers(obs_type):
    env = make(obs_type=obs_type, render_mode="rgb_array", width=32, height=32)
    check_gymnasium_env(env.unwrapped)
    check_sb3_env(env.unwrapped)
    env.close()


def rollout(env, seed, n_steps):
    observation, info = env.reset(seed=seed)
    rng = np.random.default_rng(0)
    trace = [observation.tobytes(), info["task_success"].tobytes()]
    for _ in range(n_steps):
        observation, reward, _, truncated, info = env.step(rng.uniform(-1.2, 1.2, 4).astype(np.float32))
        trace += [observation.tobytes(), reward, truncated, info["task_reward"].tobytes()]
    return trace


@pytest.mark.parametrize("obs_type", ["pixels", "state"])
def test_a_seed_repeats_a_rollout_bit_for_bit(obs_type):
    env, other = make(obs_type=obs_type, episode_length=15), make(obs_type=obs_type, episode_length=15)
    first = rollout(env, 3, 15)
    assert rollout(env, 3, 15) == first  # after other episodes
    assert rollout(other, 3, 15) == first  # and in another environment
    assert rollout(env, 4, 15)[0] != first[0]
    assert [truncated for truncated in first[4::4]] == [False] * 14 + [True]


@pytest.mark.parametrize("obs_type", ["pixels", "state"])
def test_the_task_does_not_show(obs_type):
    action = np.array([0.5, -0.2, -0.3, 1.0], dtype=np.float32)
    seen = set()
    for task in TASKS:
        env = make(task, obs_type)
        observation, _ = env.reset(seed=7)
        seen.add((observation.tobytes(), env.step(action)[0].tobytes()))
        env.close()
    assert len(seen) == 1


def frame_with(env, state, **joints):
    """The frame of a scene state in which some objects' joints are set otherwise."""
    state = state.copy()
    for name, position in joints.items():
        state[env.unwrapped.scene.model.joint(name).qposadr[0]] = position
    env.unwrapped.scene.set_state(state)
    return env.unwrapped.get_frame().astype(int)


JOINTS = {  # the joints that make a task's success
    "dial-turn": ("knob_Joint_1",),
    "door-open": ("doorjoint",),
    "drawer-open": ("drawer_slide",),
    "lever-pull": ("LeverAxis",),
    "plate-slide": ("goal_slidex", "goal_slidey"),
}


@pytest.mark.filterwarnings("ignore:Constant")
@pytest.mark.parametrize("task", TASKS)
def test_the_stock_script_solves_its_task_alone_and_visibly(task, pixel_env):
    index, script, env = TASKS.index(task), SCRIPTS[task], make(task)
    policy, solved, flags = script.policy(), False, np.zeros(5, dtype=bool)
    env.reset(seed=11)
    start = env.unwrapped.scene.get_state()
    while not solved:
        action = policy.get_action(env.unwrapped.stock_observation(task))
        action[:3] *= script.gain
        _, reward, terminated, truncated, info = env.step(np.clip(action, -1.0, 1.0))
        assert not terminated and not truncated
        assert info["success"] == info["is_success"] == info["task_success"][index]
        assert reward == pytest.approx(info["task_reward"][index])
        solved = info["success"]
        flags |= info["task_success"]
    assert flags.sum() == 1

    # The arm put back, what remains to be seen is the object.
    data = env.unwrapped.scene.data
    after = frame_with(pixel_env, start, **{name: data.joint(name).qpos[0] for name in JOINTS[task]})
    changed = np.abs(after - frame_with(pixel_env, start)).max(axis=-1) > 50
    assert changed.sum() >= 5


@pytest.mark.filterwarnings("ignore:Constant")
def test_success_and_state_agree_with_the_joints():
    env = make("lever-pull")
    state, _ = env.reset(seed=5)
    script = SCRIPTS["lever-pull"]
    policy, seen = script.policy(), set()
    for _ in range(50):
        named = dict(zip(STATE_NAMES, state, strict=True))
        for name, joint in (("dial_angle", "knob_Joint_1"), ("door_angle", "doorjoint"), ("lever_angle", "LeverAxis")):
            assert named[name] == pytest.approx(env.unwrapped.scene.data.joint(joint).qpos[0], abs=1e-6)
        action = policy.get_action(env.unwrapped.stock_observation("lever-pull"))
        action[:3] *= script.gain
        state, *_, info = env.step(np.clip(action, -1.0, 1.0))
        upright = abs(-state[STATE_NAMES.index("lever_angle")] - np.pi / 2) <= np.pi / 24
        assert info["success"] == upright
        seen.add(upright)
    assert seen == {True, False}
    assert info["is_success"] and not info["success"]  # the lever has been pulled over: what counts is that it stood


def test_the_composed_scene_keeps_the_stock_bodies_and_options():
    scene = TableScene()
    for file in ("sawyer_door_pull", "sawyer_drawer", "sawyer_lever_pull", "sawyer_plate_slide", "sawyer_dial"):
        stock = mujoco.MjModel.from_xml_path(full_V3_path_for(f"sawyer_xyz/{file}.xml"))
        names = [stock.body(i).name for i in range(1, stock.nbody) if stock.body(i).name]
        for name in names:
            np.testing.assert_allclose(scene.model.body(name).mass, stock.body(name).mass)
            np.testing.assert_allclose(scene.model.body(name).inertia, stock.body(name).inertia)
        assert scene.model.opt.timestep == stock.opt.timestep and scene.model.opt.cone == stock.opt.cone


def test_a_recorded_scene_can_be_drawn_again(pixel_env):
    rollout(pixel_env, 2, 10)
    frame, state = pixel_env.unwrapped.get_frame(), pixel_env.unwrapped.scene.get_state()
    pixel_env.reset(seed=9)
    again = frame_with(pixel_env, state.astype(np.float32))
    assert np.abs(again - frame).mean() < 0.05
    assert pixel_env.render().shape == (72, 96, 3) and pixel_env.unwrapped.get_picture(200, 150).shape == (150, 200, 3)
    with pytest.raises(ValueError, match=r"shape \(30,\)"):
        pixel_env.unwrapped.scene.set_state(state[:-1])


def test_states_need_no_opengl():
    code = (
        "import sys, sb3_offline.envs, gymnasium; env = gymnasium.make('MultimodalMetaworld-v0', obs_type='state');"
        "env.reset(seed=0); env.step(env.action_space.sample()); assert 'OpenGL' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("libraries", "egl_works", "expected"),
    [
        ({"EGL"}, None, "egl"),
        ({"OSMesa"}, None, "osmesa"),
        ({"EGL", "OSMesa"}, True, "egl"),
        ({"EGL", "OSMesa"}, False, "osmesa"),
    ],
)
def test_the_backend_is_chosen_by_what_is_installed(monkeypatch, libraries, egl_works, expected):
    monkeypatch.setattr(rendering.sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "find_library", lambda name: name if name in libraries else None)
    monkeypatch.setattr(rendering, "_works", lambda backend: egl_works)
    assert rendering._choose_backend() == expected
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert rendering._choose_backend() == "glfw"


def test_missing_opengl_is_explained(monkeypatch):
    monkeypatch.setattr(rendering, "_choose_backend", lambda: "missing")
    with pytest.raises(RuntimeError, match=r"libegl1 libegl-mesa0 libgl1-mesa-dri\n.*libosmesa6"):
        make(obs_type="pixels").reset()


@pytest.mark.parametrize("wrong", [{"task": "open-door"}, {"obs_type": "image"}, {"render_mode": "depth_array"}])
def test_wrong_arguments_are_named(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong.values()))):
        MultimodalMetaworldEnv(**wrong)
