"""Compare a dataset with the environment that a policy is to play in."""

from typing import Any

from sb3_offline.data.buffer import check_learner_spaces
from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.inspecting.dataset_warnings import DataWarning
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets


def check_environment(data: JoinedDatasets, env: Any) -> list[DataWarning]:
    """
    :param data: a dataset
    :param env: a gymnasium environment, which is neither reset nor stepped
    :return: what keeps a model of this environment from learning from these data: other shapes or kinds of observations, other
        bounds of actions, another time limit than the length of truncated episodes
    """
    found = []
    for name in ("observation_space", "action_space"):
        try:
            check_learner_spaces(data.parts[0], **{name: getattr(env, name)})
        except DatasetError as error:
            problem = error.problem.replace("the learner has", "the environment has")
            found.append(DataWarning(error.field, problem, error.remedy))
    limit = getattr(env.spec, "max_episode_steps", None)
    if limit is not None and len(data.lengths) and data.lengths.max() > limit:
        problem = f"reach {data.lengths.max()} steps, but the environment ends episodes after {limit}"
        found.append(DataWarning("episodes/length", problem, "Check that the data come from this environment"))
    return found
