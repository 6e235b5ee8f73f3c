"""The precision in which networks learn."""

import functools
from collections.abc import Callable

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs


def encode(
    extract_features: Callable[[PyTorchObs], th.Tensor], observations: PyTorchObs, mixed_precision: bool | None
) -> th.Tensor:
    """
    Compute features to learn from. Their dtype is the precision of all that is computed from them.

    :param extract_features: maps observations to features, ``(batch, features_dim)``
    :param observations: a batch, or a dict of batches
    :param mixed_precision: compute in bfloat16, or in float32; ``None`` takes bfloat16 if the device has instructions for it
    :return: ``(batch, features_dim)``
    """
    device = (next(iter(observations.values())) if isinstance(observations, dict) else observations).device
    bfloat16 = has_fast_bfloat16(device) if mixed_precision is None else mixed_precision
    with th.autocast(device.type, th.bfloat16, enabled=bfloat16):
        features = extract_features(observations)
    return features.bfloat16() if bfloat16 else features


@functools.lru_cache
def has_fast_bfloat16(device: th.device) -> bool:
    """
    :param device: the device of the networks
    :return: whether its instructions suggest that it multiplies bfloat16 faster than float32
    """
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    checks = [getattr(th.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    return device.type == "cpu" and any(check() for check in checks if check is not None)
