"""collect-sac on a real Ray cluster of two nodes, one of which is killed in the middle."""

import threading
import time

import pytest

pytest.importorskip("metaworld")
pytest.importorskip("ray")

import ray
from ray.cluster_utils import Cluster

from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data_tools.collecting.on_ray import collect_on_ray
from sb3_offline.data_tools.collecting.sac import Collection, collect_shard, content_hash, shard_path

pytestmark = pytest.mark.slow

EPISODES = 300
COLLECTION = Collection(EPISODES, ("door-open",), seed=5)


def test_a_killed_node_loses_nothing_and_nothing_is_written_twice(tmp_path):
    path = tmp_path / "data.h5"
    shards = [shard_path(path, i, 2) for i in range(2)]
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        other = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        cluster.wait_for_nodes()
        collecting = threading.Thread(target=collect_on_ray, args=(path, COLLECTION, 2), kwargs={"address": "auto"})
        collecting.start()
        for _ in range(600):  # until both nodes have written some episodes
            if all(shard.exists() and OfflineDataset(shard).n_episodes >= 3 for shard in shards):
                break
            time.sleep(0.1)
        written = [OfflineDataset(shard).n_episodes for shard in shards]
        assert all(3 <= n < EPISODES // 2 for n in written)
        cluster.remove_node(other, allow_graceful=False)
        collecting.join(timeout=300)
        assert not collecting.is_alive()
    finally:
        ray.shutdown()
        cluster.shutdown()
    datasets = open_datasets(str(tmp_path / "data-*.h5"))
    assert [dataset.n_episodes for dataset in datasets] == [EPISODES // 2] * 2
    whole = collect_shard(tmp_path / "whole.h5", COLLECTION, n_workers=2, progress=False)
    assert content_hash(datasets) == content_hash(whole)
