"""
Images of a table for its documentation: the start of an episode, and every task solved by its script.

    python benchmarks/table_images.py second docs/images/second_table.png

Above, images for people; below, the 64x64 images that policies observe, enlarged.
"""

import argparse
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw

from sb3_offline.data_tools.collecting.scripted import SCRIPTS
from sb3_offline.envs import ENV_ID

SIZE, GAP, LABEL, SEED = 192, 4, 16, 0


def play(env: Any, task: str) -> None:
    """Play the undisturbed script from the start until it has solved the task."""
    env.reset(seed=SEED)
    script, index, solved = SCRIPTS[task], env.tasks.index(task), False
    policy = script.policy()
    while not solved:
        action = policy.get_action(env.stock_observation(task))
        action[:3] *= script.gain
        solved = env.step(np.clip(action, -1.0, 1.0))[4]["task_success"][index]


def draw(table: str, path: Path) -> None:
    """
    :param table: name of the table
    :param path: image file to write
    """
    env: Any = gym.make(ENV_ID, table=table, obs_type="state").unwrapped
    names = ("start", *env.tasks)
    sheet = Image.new("RGB", (len(names) * (SIZE + GAP) - GAP, 2 * SIZE + GAP + LABEL), "white")
    for column, name in enumerate(names):
        if name == "start":
            env.reset(seed=SEED)
        else:
            play(env, name)
        x = column * (SIZE + GAP)
        ImageDraw.Draw(sheet).text((x + 2, 2), name, fill="black")
        sheet.paste(Image.fromarray(env.get_image(SIZE, SIZE)), (x, LABEL))
        observed = Image.fromarray(env.get_frame()).resize((SIZE, SIZE), Image.Resampling.NEAREST)
        sheet.paste(observed, (x, LABEL + SIZE + GAP))
    # Few colours keep the file small; this method keeps the rare bright ones.
    sheet.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table")
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", message="Constant")  # the stock policies warn about every action that is clipped
    draw(arguments.table, arguments.output)
