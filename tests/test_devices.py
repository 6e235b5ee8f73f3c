"""Operations on tensors of two devices, which fail on a GPU, fail on a pretended device too."""

import numpy as np
import pytest
import torch as th
from pretend_device import DEVICE, DeviceTensor, pretend, waits
from test_algorithms import CASES, POLICIES, batch_of, files, make, needs_examples  # noqa: F401

from sb3_offline import ALGOS


def test_the_pretended_device_refuses_the_cpus_tensors(monkeypatch):
    with pretend(monkeypatch):
        there = th.ones(3, device=DEVICE)
        assert (there * 2).sum().item() == 6 and there.device.type == DEVICE
        for wrong in (lambda: there + th.ones(3), lambda: th.ones(3)[there.long()], lambda: there.numpy()):
            with pytest.raises((RuntimeError, TypeError)):
                wrong()


@pytest.mark.parametrize(("algo", "policy"), CASES)
def test_an_algorithm_keeps_to_its_device(algo, policy, files, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr("sb3_offline.ceborl.classifier.DIAGNOSTICS_INTERVAL", 1)  # RCE uses it too.
    with pretend(monkeypatch):
        model = make(algo, policy, files, device=DEVICE).learn(2, log_interval=1)
        assert all(isinstance(parameter, DeviceTensor) for parameter in model.policy.parameters())
        waits.clear()
        model.learn(3, log_interval=None, reset_num_timesteps=False)
        # CEBORL draws the batches of its policy by weights on the device, and reads them from the dataset on the CPU.
        assert len(waits) == (3 if algo == "ceborl" else 0), waits
        actions, _ = model.predict(batch_of(POLICIES[policy]), deterministic=True)
        model.save(tmp_path / "model")
        kwargs = {"examples": files[policy][1]} if needs_examples(algo) else {}
        again = ALGOS[algo].load(tmp_path / "model", device=DEVICE, **kwargs).learn(1, reset_num_timesteps=False)
        assert all(isinstance(parameter, DeviceTensor) for parameter in again.policy.parameters())
    loaded = ALGOS[algo].load(tmp_path / "model", device="cpu")  # A policy that was trained on the device acts on the CPU.
    np.testing.assert_allclose(
        loaded.predict(batch_of(POLICIES[policy]), deterministic=True)[0], actions, rtol=1e-3, atol=1e-3
    )
