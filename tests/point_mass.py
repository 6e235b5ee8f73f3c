"""A small world in which several goals are mixed in the data: learning in it takes seconds."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_offline.data.writer import DatasetWriter

GOALS = np.array([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.0, -0.8]], dtype=np.float32)
STATES = spaces.Box(-2, 2, (2,), np.float32)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
N_STEPS, SPEED, RADIUS = 20, 0.1, 0.15


class PointMass(gym.Env):
    """Starts in the middle; solved near `GOALS[goal]`."""

    observation_space, action_space = STATES, ACTIONS

    def __init__(self, goal=0):
        self.goal = goal

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.normal(scale=0.05, size=2).astype(np.float32)
        self.t, self.solved = 0, False
        return self.position.copy(), {}

    def step(self, action):
        self.position = np.clip(self.position + SPEED * np.clip(action, -1, 1), -2, 2).astype(np.float32)
        self.t += 1
        self.solved = self.solved or bool(np.linalg.norm(self.position - GOALS[self.goal]) < RADIUS)
        return self.position.copy(), 0.0, False, self.t == N_STEPS, {"is_success": self.solved}


gym.register("TestPointMass-v0", entry_point=PointMass)


def write_point_mass(path, n_episodes=400, seed=0):
    """Each episode heads for a random goal with noise; half of them give up on the way."""
    rng = np.random.default_rng(seed)
    env = PointMass()
    with DatasetWriter(path, STATES, ACTIONS, env_id="TestPointMass-v0", rewards=False, success=False) as writer:
        for index in range(n_episodes):
            goal, gives_up = GOALS[rng.integers(len(GOALS))], rng.integers(3, 2 * N_STEPS)
            observations, actions = [env.reset(seed=seed * n_episodes + index)[0]], []
            for t in range(N_STEPS):
                direction = (goal - observations[-1]) / SPEED if t < gives_up else np.zeros(2)
                actions.append(np.clip(np.clip(direction, -0.7, 0.7) + 0.3 * rng.normal(size=2), -1, 1).astype(np.float32))
                observations.append(env.step(actions[-1])[0])
            writer.add_episode(np.stack(observations), np.stack(actions))


def goal_examples(n=50, goal=0, seed=1):
    """Positions near the goal: all that a learner is told of the task."""
    rng = np.random.default_rng(seed)
    return (GOALS[goal] + rng.uniform(-0.1, 0.1, size=(n, 2))).astype(np.float32)
