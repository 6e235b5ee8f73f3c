import itertools
import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import sb3_offline.envs  # noqa: F401

pytest.importorskip("metaworld")

from metaworld.asset_path_utils import full_V3_path_for
from metaworld.envs.sawyer_handle_pull_v3 import SawyerHandlePullEnvV3

from sb3_offline.data_tools.collecting.scripted import SCRIPTS
from sb3_offline.envs.multimodal_metaworld import STATE_NAMES, TABLES, MultimodalMetaworldEnv, rendering
from sb3_offline.envs.multimodal_metaworld.scene import JITTER, TableScene
from sb3_offline.envs.multimodal_metaworld.tables import find_table
from sb3_offline.envs.multimodal_metaworld.tasks import STOCK_TASKS

ALL_TASKS = [(table, task) for table, tasks in TABLES.items() for task in tasks]


def make(task=None, obs_type="state", **kwargs):
    return gym.make("MultimodalMetaworld-v0", task=task, obs_type=obs_type, **kwargs)


@pytest.fixture(scope="module")
def pixel_env():
    env = make(obs_type="pixels", render_mode="rgb_array", width=96, height=72)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pixel_envs(pixel_env):
    envs = {"paper": pixel_env, "second": make(obs_type="pixels", table="second")}
    yield envs
    envs["second"].close()


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("obs_type", ["pixels", "state"])
def test_passes_both_environment_checkers(obs_type, table):
    env = make(obs_type=obs_type, table=table, render_mode="rgb_array", width=32, height=32)
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


@pytest.mark.parametrize(("obs_type", "table"), [("pixels", "paper"), ("state", "paper"), ("state", "second")])
def test_the_task_does_not_show(obs_type, table):
    action = np.array([0.5, -0.2, -0.3, 1.0], dtype=np.float32)
    seen = set()
    for task in TABLES[table]:
        env = make(task, obs_type, table=table)
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
    "button-press": ("btnbox_joint",),
    "faucet-close": ("faucet_joint",),
    "faucet-open": ("faucet_joint",),
    "handle-press": ("handle_slide",),
    "window-open": ("window_slide",),
}


@pytest.mark.filterwarnings("ignore:Constant")
@pytest.mark.parametrize(("table", "task"), ALL_TASKS)
def test_the_stock_script_solves_its_task_alone_and_visibly(table, task, pixel_envs):
    index, script, env, pixel_env = (
        find_table(table).tasks.index(task),
        SCRIPTS[task],
        make(task, table=table),
        pixel_envs[table],
    )
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


STOCK_FILES = {
    "paper": {
        "dial-turn": "dial",
        "door-open": "door_pull",
        "drawer-open": "drawer",
        "lever-pull": "lever_pull",
        "plate-slide": "plate_slide",
    },
    "second": {
        "button-press": "button_press",
        "faucet-close": "faucet",
        "faucet-open": "faucet",
        "handle-press": "handle_press",
        "window-open": "window_horizontal",
    },
}


@pytest.mark.parametrize("table", TABLES)
def test_the_composed_scene_keeps_the_stock_bodies_and_options(table):
    scene = TableScene(find_table(table))
    for task, file in STOCK_FILES[table].items():
        stock = mujoco.MjModel.from_xml_path(full_V3_path_for(f"sawyer_xyz/sawyer_{file}.xml"))
        aliases = STOCK_TASKS[task].aliases
        names = {stock.body(i).name for i in range(1, stock.nbody)} - {""}
        assert len(names) > 20
        for name in names:
            body = scene.model.body(aliases.get(name, name))
            np.testing.assert_allclose(body.mass, stock.body(name).mass)
            np.testing.assert_allclose(body.inertia, stock.body(name).inertia)
        assert scene.model.opt.timestep == stock.opt.timestep and scene.model.opt.cone == stock.opt.cone


def test_a_recorded_scene_can_be_drawn_again(pixel_env):
    rollout(pixel_env, 2, 10)
    frame, state = pixel_env.unwrapped.get_frame(), pixel_env.unwrapped.scene.get_state()
    pixel_env.reset(seed=9)
    again = frame_with(pixel_env, state.astype(np.float32))
    assert np.abs(again - frame).mean() < 0.05
    assert pixel_env.render().shape == (72, 96, 3) and pixel_env.unwrapped.get_image(200, 150).shape == (150, 200, 3)
    with pytest.raises(ValueError, match=r"shape \(30,\)"):
        pixel_env.unwrapped.scene.set_state(state[:-1])


@pytest.mark.parametrize("table", TABLES)
def test_the_start_of_a_recorded_scene_is_that_of_its_episode(table):
    env = make(table=table).unwrapped
    env.reset(seed=2)
    start = env.scene.get_state()
    rollout(env, 2, 5)
    np.testing.assert_array_equal(env.scene.initial_state(env.scene.get_state()), start)
    parts = env.table.scene_state
    moved = start[parts["bodies"]].reshape(-1, 2) - np.array(list(env.table.positions.values()))[:, :2]
    assert (np.abs(moved) <= JITTER).all() and len(np.unique(moved)) == moved.size
    np.testing.assert_array_equal(start[parts["joints"]], env.scene.initial_state(start)[: env.scene.model.nq])


def test_any_tasks_share_a_table_that_is_a_dict_of_positions(monkeypatch):
    place = itertools.count(3.0, 3.0)  # far from each other
    positions = {task: {name: (next(place), 0.0, 0.0) for name in stock.objects} for task, stock in STOCK_TASKS.items()}
    positions["faucet-open"] = {}  # the faucet has been placed for faucet-close
    monkeypatch.setitem(TABLES, "all of them", positions)
    env = make("window-open", table="all of them").unwrapped
    state, info = env.reset(seed=0)
    assert env.tasks == tuple(STOCK_TASKS) and not info["task_success"].any() and len(info["task_success"]) == len(env.tasks)
    named = dict(zip(env.state_names, state, strict=True))
    entries = dict.fromkeys(entry for stock in STOCK_TASKS.values() for entry in stock.state)
    assert env.state_names[4:] == tuple(entries)
    start = env.scene.initial_state(env.scene.get_state())
    for entry, (kind, name, _) in env.table.state.items():
        if kind == "joint":
            address = env.scene.model.joint(name).qposadr[0]
            env.scene.data.qpos[address] = 0.01 * address
            assert named[entry] == start[address]
    changed = dict(zip(env.state_names, env.get_state(), strict=True))
    joints = [changed[entry] for entry, quantity in env.table.state.items() if quantity.kind == "joint"]
    assert len(set(joints)) == len(joints) and min(joints) > 0  # each entry reads a joint of its own

    monkeypatch.setitem(TABLES, "incomplete", {"faucet-close": {}})
    with pytest.raises(ValueError, match=r"'incomplete' places .*but its tasks need faucetBase"):
        make(table="incomplete")


def test_a_new_task_is_one_entry_and_may_start_with_a_joint_elsewhere(monkeypatch):
    press = STOCK_TASKS["handle-press"]
    box = replace(press.objects["handle_box"], sites={"goalPull": (0.0, -0.216, 0.172)}, start={"handle_slide": -0.1})
    pull = replace(press, env_class=SawyerHandlePullEnvV3, objects={"handle_box": box})
    monkeypatch.setitem(STOCK_TASKS, "handle-pull", pull)
    monkeypatch.setitem(TABLES, "with a new task", {"handle-pull": {"handle_box": (0.1, 0.85, 0.0)}})
    env = make(table="with a new task").unwrapped
    for _ in range(2):
        state, info = env.reset(seed=0)
        assert env.task == "handle-pull" and not info["success"]
        assert state[env.state_names.index("handle_slide")] == pytest.approx(-0.1)
        env.scene.data.joint("handle_slide").qpos[:] = 0.0
        mujoco.mj_forward(env.scene.model, env.scene.data)
        assert env.step(np.zeros(4, dtype=np.float32))[4]["success"]


@pytest.mark.filterwarnings("ignore:Constant")
def test_success_at_any_control_step_counts_as_the_paper_counts():
    lasting, passing, fine = (
        make("handle-press", table="second", success=success, action_repeat=repeat, episode_length=200).unwrapped
        for success, repeat in (("last", 4), ("any", 4), ("last", 1))
    )
    policy, seen = SCRIPTS["handle-press"].policy(), set()
    for env in (lasting, passing, fine):
        env.reset(seed=6)
    for _ in range(30):
        action = np.clip(policy.get_action(lasting.stock_observation("handle-press")), -1.0, 1.0)
        observation, reward, *_, info = lasting.step(action)
        other, other_reward, *_, other_info = passing.step(action)
        np.testing.assert_array_equal(observation, other)
        np.testing.assert_array_equal(info["task_reward"], other_info["task_reward"])
        assert reward == other_reward
        steps = [fine.step(action)[4]["task_success"] for _ in range(4)]
        np.testing.assert_array_equal(info["task_success"], steps[-1])
        np.testing.assert_array_equal(other_info["task_success"], np.any(steps, axis=0))
        assert other_info["success"] == other_info["task_success"][env.tasks.index("handle-press")]
        seen.add((info["success"], other_info["success"]))
    assert seen == {(False, False), (False, True), (True, True)}
    assert info["is_success"] and other_info["is_success"]


def test_a_camera_has_a_name_or_entries(pixel_env):
    pixel_env.reset(seed=0)
    images = {"default": pixel_env.unwrapped.get_frame()}
    paper = {"lookat": (0.075, 0.75, 0.15), "distance": 1.75, "azimuth": 160.0, "elevation": -45.0}
    for name, camera in (("paper", "paper"), ("entries", paper), ("one entry", {"azimuth": 160.0})):
        env = make(obs_type="pixels", camera=camera)
        images[name] = env.reset(seed=0)[0]
        assert env.unwrapped.camera["azimuth"] == 160.0
        env.close()
    np.testing.assert_array_equal(images["paper"], images["entries"])
    assert all((images["paper"] != images[name]).any() for name in ("default", "one entry"))
    np.testing.assert_array_equal(make(obs_type="pixels", camera="default").reset(seed=0)[0], images["default"])


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


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"task": "open-door"}, "'paper' has no task 'open-door'; choose one of dial-turn, door-open, drawer-open"),
        ({"task": "door-open", "table": "second"}, "'second' has no task 'door-open'; choose one of button-press, faucet"),
        ({"table": "third"}, "Unknown table 'third'; choose one of paper, second"),
        ({"obs_type": "image"}, "obs_type 'image'"),
        ({"render_mode": "depth_array"}, "render_mode 'depth_array'"),
        ({"success": "first"}, 'success \'first\'; choose "last" or "any"'),
        ({"camera": "papers"}, "camera 'papers'; choose one of default, paper"),
        ({"camera": {"zoom": 2}}, "entries \\['zoom'\\] of camera"),
    ],
)
def test_wrong_arguments_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        MultimodalMetaworldEnv(**wrong)


def test_each_table_has_a_default_task():
    assert MultimodalMetaworldEnv(obs_type="state").task == "door-open"
    assert MultimodalMetaworldEnv(obs_type="state", table="second").task == "button-press"
