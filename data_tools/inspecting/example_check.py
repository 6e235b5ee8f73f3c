"""Compare success examples with a dataset: do the data hold similar observations?"""

import json
import os
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from sb3_offline.data.example_gap import example_gap
from sb3_offline.data.examples import load_examples
from sb3_offline.data_tools.inspecting.dataset_warnings import DataWarning
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets

FEW_EPISODES = 10
"""Number of episodes from which examples show success in enough ways."""


def check_examples(
    data: JoinedDatasets, examples: str | os.PathLike | np.ndarray, seed: int = 0
) -> tuple[dict[str, Any], list[DataWarning]]:
    """
    Find the nearest observation to each example in a sample of the data. The data set the scale: the usual distance is that
    from an observation of one episode to the nearest observation of another episode.

    :param data: a dataset of at least one episode
    :param examples: in any form that learners take; raises ``DatasetError`` if they do not fit the observation space
    :param seed: seed of the sample
    :return: a summary in JSON types, and warnings. Distances are root mean squares over the values of an observation, each in
        standard deviations of the data.
    """
    observations = load_examples(examples, data.observation_space)
    gap = example_gap(data.observation_space, data.arrays, data.lengths, observations, success=data.success, seed=seed)
    provenance = _provenance(examples)
    summary = {
        "examples": str(examples) if isinstance(examples, str | os.PathLike) else "array",
        "count": len(gap.distances),
        "provenance": provenance,
        "compared_observations": gap.compared,
        "identical": gap.identical,
        "distances": gap.distances.tolist(),
        "usual_distances": gap.usual_distances.tolist(),
        "far": gap.far.tolist(),
    }
    warnings = []
    if found := gap.problem():
        warnings.append(DataWarning("examples", *found))
    warnings += few_episodes(provenance)
    if provenance.get("held_out") and gap.identical:
        problem = (
            f"{gap.identical} of {len(gap.distances)} are observations of this data, but are recorded as held out from it"
        )
        warnings.append(DataWarning("examples", problem, "Draw them from other episodes, or without --held-out"))
    return summary, warnings


def few_episodes(provenance: Mapping[str, Any]) -> list[DataWarning]:
    """
    :param provenance: of examples that ``extract_examples`` drew; others say nothing of
        their episodes
    :return: a warning where many examples come from few episodes
    """
    n_episodes = sum(len(origin["episodes"]) for origin in provenance.get("datasets", []))
    n_examples = provenance.get("n", 0)
    if not 0 < n_episodes < min(FEW_EPISODES, n_examples):
        return []
    problem = (
        f"{n_examples} come from {n_episodes} episode{'s' * (n_episodes > 1)}, and frames of one episode are nearly alike"
    )
    return [DataWarning("examples", f"{problem}: they teach hardly more than {n_episodes}", "Draw them from more episodes")]


def _provenance(examples: Any) -> dict[str, Any]:
    if not (isinstance(examples, str | os.PathLike) and h5py.is_hdf5(examples)):
        return {}
    with h5py.File(examples, "r", locking=False) as file:
        return json.loads(file.attrs["provenance"])
