"""CEBORL on the real scene. It trains for minutes, so only `make test-slow` runs it."""

from dataclasses import replace

import pytest

from sb3_offline.demo.pipeline import DemoSettings, collect, training_run
from sb3_offline.envs import ENV_ID
from sb3_offline.experiment.evaluation import evaluate_success
from sb3_offline.experiment.training import train_run


@pytest.mark.slow
@pytest.mark.parametrize("task", ["drawer-open", "door-open"])
def test_ceborl_solves_the_task_of_its_examples(task, tmp_path):
    settings = DemoSettings(task=task, n_timesteps=2000, judged_episodes=1)
    run = training_run("CEBORL", tmp_path, collect(tmp_path, settings), settings)
    model = train_run(replace(run, eval_freq=0), progress_bar=False)
    result = evaluate_success(model, ENV_ID, {"task": task, "obs_type": "state"}, 50)
    assert result.success_rate >= 0.7
