"""The tests of Stable-Baselines3 that are left out, each for a reason."""

COLLECTS = "collects steps of an environment, which an offline learner never does"
MADE_UP = "asks for a return in its environment, but the dataset here is made up"
OWN_WINDOWS = "wants SB3's NStepReplayBuffer: windows of several steps are the dataset buffer's own"
SDE = "gSDE explores; there is nothing to explore offline"

EXCLUSIONS = {
    "test_callbacks.py::test_callbacks": "asserts that `dones` of an environment step are among learn()'s local variables",
    "test_gae.py::test_infinite_horizon": MADE_UP,
    "test_her.py": f"hindsight relabelling {COLLECTS}",
    "test_identity.py::test_continuous": MADE_UP,
    "test_n_step_replay.py": OWN_WINDOWS,
    "test_run.py::test_train_freq": f"train_freq {COLLECTS}",
    "test_run.py::test_train_freq_fail": f"train_freq {COLLECTS}",
    "test_run.py::test_offpolicy_multi_env": COLLECTS,
    "test_save_load.py::test_set_env": f"looks at the last observation: {COLLECTS}",
    "test_save_load.py::test_save_load_pytorch_var": "looks at the entropy coefficient by the name that SAC gives it",
    "test_save_load.py::test_save_load_replay_buffer": "compares a buffer's arrays; ours pickles as paths of files",
    "test_save_load.py::test_warn_buffer": f"warns of a reset while the buffer fills: {COLLECTS}",
    "test_sde.py": SDE,
    "test_spaces.py::test_action_spaces[CartPole-v1": "wants an AssertionError, which Optuna would prune",
    "test_train_eval_mode.py::test_offpolicy_collect_rollout_batch_norm": COLLECTS,
}

NO_CRITIC = "is about critics, which BC has none of"

#: Of one algorithm
FURTHER_EXCLUSIONS = {
    "bc": {
        "test_cnn.py::test_features_extractor_target_net": NO_CRITIC,
        "test_train_eval_mode.py::test_predict_with_dropout_batch_norm": NO_CRITIC,
        "test_train_eval_mode.py::test_sac_train_with_batch_norm": NO_CRITIC,
    },
}


def reason(algorithm: str, test: str) -> str | None:
    """
    :param algorithm: its name in ``sb3_offline.ALGOS``
    :param test: node id, ``file::test[parameters]``
    :return: why it does not apply
    """
    reasons = {**EXCLUSIONS, **FURTHER_EXCLUSIONS.get(algorithm, {})}
    return next((why for start, why in reasons.items() if test.split("/")[-1].startswith(start)), None)
