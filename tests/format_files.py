"""Tiny files of random numbers in the layouts that other libraries publish."""

import io
import json

import h5py
import numpy as np
from PIL import Image

LENGTHS = (5, 3, 4)


def rng(seed=0):
    return np.random.default_rng(seed)


def images(n, generator, shape=(6, 7, 3)):
    return generator.integers(0, 256, (n, *shape), dtype=np.uint8)


def write_robomimic(path, lengths=LENGTHS, next_obs=True, dtype=np.float64, image_shape=(6, 7, 3), **changes):
    """As robomimic documents it. :return: the arrays of each demonstration"""
    generator, demos = rng(), []
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_type": 1, "env_kwargs": {"horizon": 9}})
        data.attrs["total"] = sum(lengths)
        for index in reversed(range(len(lengths))):
            n = lengths[index]
            demo = {
                "actions": generator.uniform(-1, 1, (n, 2)),
                "dones": (np.arange(n) == n - 1).astype(np.int64),
                "rewards": (np.arange(n) == n - 1).astype(np.float64),
                "states": generator.normal(size=(n, 4)),
            }
            rows = {
                "eef_pos": generator.normal(size=(n + 1, 3)).astype(dtype),
                "agentview_image": images(n + 1, generator, image_shape),
            }
            demo |= {f"obs/{key}": array[:-1] for key, array in rows.items()}
            if next_obs:
                demo |= {f"next_obs/{key}": array[1:] for key, array in rows.items()}
            demo |= {name: array[:n] for name, array in changes.items() if array is not None}
            demo = {name: array for name, array in demo.items() if name not in changes or changes[name] is not None}
            demos.insert(0, demo)
            group = data.create_group(f"demo_{index}")
            group.attrs["num_samples"] = n
            group.attrs["model_file"] = "<mujoco/>"
            for name, array in demo.items():
                group[name] = array
        file["mask/train"] = np.array([b"demo_0", b"demo_2"])
        file["mask/valid"] = np.array([b"demo_1"])
        file["mask/better"] = np.array([b"demo_0"])
    return demos


def write_maniskill(path, lengths=LENGTHS, nested=True, flags=True, with_json=True):
    generator, trajectories, entries = rng(), [], []
    with h5py.File(path, "w") as file:
        for index, n in enumerate(lengths):
            last = np.arange(n) == n - 1
            trajectory = {"actions": generator.uniform(-1, 1, (n, 2)).astype(np.float32)}
            trajectory["env_states/actors/cube"] = generator.normal(size=(n + 1, 3)).astype(np.float32)
            if nested:
                trajectory["obs/agent/qpos"] = generator.normal(size=(n + 1, 4)).astype(np.float32)
                trajectory["obs/extra/grasped"] = generator.integers(0, 2, n + 1).astype(bool)
                trajectory["obs/sensor_data/hand/rgb"] = images(n + 1, generator, (36, 40, 3))
            else:
                trajectory["obs"] = generator.normal(size=(n + 1, 4)).astype(np.float32)
            if flags:
                trajectory |= {"success": last & (index != 1), "terminated": last & (index != 1), "truncated": last}
                trajectory["rewards"] = generator.normal(size=n).astype(np.float32)
            trajectories.append(trajectory)
            for name, array in trajectory.items():
                file[f"traj_{index}/{name}"] = array
            entry = {"episode_id": index, "reset_kwargs": {"seed": 10 + index}, "control_mode": "pd_joint_pos"}
            entries.append({**entry, "elapsed_steps": n, "success": index != 1})
    if with_json:
        environment = {"env_id": "PickCube-v1", "max_episode_steps": 5, "env_kwargs": {"obs_mode": "rgb"}}
        path.with_suffix(".json").write_text(json.dumps({"env_info": environment, "episodes": entries}))
    return trajectories


def ogbench_arrays(visual=False, lengths=LENGTHS):
    generator, n = rng(), sum(lengths) + len(lengths)
    terminals = np.zeros(n, bool)
    terminals[np.cumsum(np.array(lengths) + 1) - 1] = True
    observations = images(n, generator, (8, 8, 3)) if visual else generator.normal(size=(n, 4)).astype(np.float32)
    actions = generator.uniform(-1, 1, (n, 2)).astype(np.float32)
    return {"observations": observations, "actions": actions, "terminals": terminals, "qpos": generator.normal(size=(n, 3))}


def ogbench_loader(file):
    """The regular dataset that OGBench's ``load_dataset`` gives: next observations by shifting, without the last rows."""
    steps = ~file["terminals"]
    after = np.concatenate([[False], steps[:-1]])
    ends = np.concatenate([file["terminals"][1:], [True]])[steps]
    return {
        "observations": file["observations"][steps],
        "actions": file["actions"][steps],
        "next_observations": file["observations"][after],
        "terminals": ends.astype(np.float32),
    }


def dmc_episode(n, generator, terminal=False, key="observation", image=False):
    rows = images(n + 1, generator, (3, 8, 8)) if image else generator.normal(size=(n + 1, 4)).astype(np.float32)
    discount = np.ones((n + 1, 1), np.float32)
    discount[-1] = not terminal
    actions = generator.uniform(-1, 1, (n + 1, 2)).astype(np.float32)
    actions[0] = 77  # the dummy
    rewards = generator.random((n + 1, 1)).astype(np.float32)
    return {
        key: rows,
        "action": actions,
        "reward": rewards,
        "discount": discount,
        "physics": generator.normal(size=(n + 1, 3)),
    }


def write_dmc(folder, lengths=LENGTHS):
    generator = rng()
    folder.mkdir()
    episodes = [dmc_episode(n, generator, terminal=index == 1) for index, n in enumerate(lengths)]
    for index, episode in enumerate(episodes):
        np.savez(folder / f"episode_{index:06d}_{lengths[index]}.npz", **episode)
    return episodes


def write_aloha(folder, lengths=LENGTHS, compress=False, joints=3):
    generator, episodes = rng(), []
    folder.mkdir()
    for index, n in enumerate(lengths):
        episode = {
            "action": generator.uniform(-3, 3, (n, joints)).astype(np.float32),
            "observations/qpos": generator.normal(size=(n, joints)),
            "observations/images/top": images(n, generator, (16, 24, 3)),
        }
        episodes.append(episode)
        with h5py.File(folder / f"episode_{index}.hdf5", "w") as file:
            file.attrs["sim"], file.attrs["compress"] = True, compress
            for name, array in episode.items():
                file[name] = encoded(array) if compress and "images" in name else array
    return episodes


def encoded(frames):
    """PNG instead of JPEG, to compare exactly; OpenCV takes the last channel for the first one."""
    texts = []
    for frame in frames:
        Image.fromarray(np.ascontiguousarray(frame[..., ::-1])).save(stream := io.BytesIO(), "PNG")
        texts.append(np.frombuffer(stream.getvalue(), np.uint8))
    return np.stack([np.pad(text, (0, max(map(len, texts)) - len(text))) for text in texts])
