"""A grid on a real Ray cluster of two nodes, one of which is killed in the middle."""

import threading
import time

import pytest

pytest.importorskip("metaworld")
pytest.importorskip("ray")

import ray
from grids import assert_same, collect_data, rows_of, write_grid
from ray.cluster_utils import Cluster

from sb3_offline.benchmark.grid import load_grid, plan
from sb3_offline.benchmark.on_ray import train_on_ray
from sb3_offline.benchmark.worker import complete_run
from sb3_offline.experiment.training import RESUME_FILE, load_run

pytestmark = pytest.mark.slow


def test_a_killed_node_loses_nothing(tmp_path):
    data = collect_data(tmp_path)
    grid = load_grid(write_grid(tmp_path, data, n_timesteps=1000))
    chosen = grid.cells(["ceborl", "cql"], ["door-open"])
    lost, whole = (plan(grid, tmp_path / name, chosen) for name in ("lost", "whole"))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        other = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        cluster.wait_for_nodes()
        over = []
        training = threading.Thread(target=lambda: over.extend(train_on_ray(list(lost.values()), "auto")))
        training.start()
        for _ in range(1200):  # until both nodes have saved something
            if all((run.folder / RESUME_FILE).exists() for run in lost.values()):
                break
            time.sleep(0.1)
        assert not over and all((run.folder / RESUME_FILE).exists() for run in lost.values())
        cluster.remove_node(other, allow_graceful=False)
        training.join(timeout=400)
        assert not training.is_alive()
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert {run.label for run in over} == {run.label for run in lost.values()}
    for run in whole.values():
        complete_run(run)
    assert rows_of(lost) == rows_of(whole)
    for one, same in zip(lost.values(), whole.values(), strict=True):
        assert_same(*(load_run(run.folder / "model.zip")[0].get_parameters() for run in (one, same)))
