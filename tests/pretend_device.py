"""
A pretended device. Its tensors compute on the CPU, but operations on them and on the CPU's own tensors fail, as with a GPU.
Its name is "meta", because PyTorch's CPU build runs backward passes only for devices named "cpu" or "meta".
"""

from typing import Any

import torch as th
from torch.optim import optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = "meta"
WAITING = {"aten::_local_scalar_dense", "aten::nonzero", "aten::equal", "aten::is_nonzero", "aten::masked_select"}
MAY_MIX = {"aten::copy_", "aten::_to_copy", "aten::index"}  # A GPU accepts indices on the CPU.

#: Operations in which the CPU waited for a result of the device
waits: list[str] = []


class DeviceTensor(th.Tensor):
    """A tensor that reports the pretended device, and holds a tensor of the CPU."""

    held: th.Tensor
    __torch_function__ = th._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: th.Tensor) -> "DeviceTensor":
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        return th.Tensor._make_wrapper_subclass(cls, held.shape, device=DEVICE, **layout)

    def __init__(self, held: th.Tensor):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _compute(func, args, kwargs or {})


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _compute(func, args, kwargs or {})


def _put(value: Any) -> Any:
    return DeviceTensor(value.detach()) if isinstance(value, th.Tensor) and not isinstance(value, DeviceTensor) else value


def _held(value: Any) -> Any:
    return value.held if isinstance(value, DeviceTensor) else value


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = func._schema.name
    tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, th.Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, DeviceTensor)]
    here = [tensor for tensor in tensors if tensor.dim() and not isinstance(tensor, DeviceTensor)]
    refused = here if name not in MAY_MIX else name == "aten::index" and not isinstance(tensors[0], DeviceTensor)
    if there and refused:
        raise RuntimeError(f"{name} of two devices: {[(tuple(tensor.shape), str(tensor.device)) for tensor in tensors]}")
    asked = kwargs.get("device")
    lands_there = bool(there) if asked is None else th.device(asked).type == DEVICE
    if name == "aten::copy_":
        lands_there = isinstance(args[0], DeviceTensor)
    if there and (name in WAITING or not lands_there):
        waits.append(name)
    if lands_there and asked is not None:
        kwargs = {**kwargs, "device": "cpu"}
    out = func(*tree_map(_held, args), **tree_map(_held, kwargs))
    if not lands_there:
        return out
    own = {id(tensor.held): tensor for tensor in there}  # Operations in place return their argument.
    return tree_map(lambda value: own.get(id(value)) if id(value) in own else _put(value), out)


def pretend(monkeypatch: Any) -> _Mode:
    """
    :param monkeypatch: pytest's fixture, which replaces the functions of PyTorch that do not know the device
    :return: context in which the device exists: ``with pretend(monkeypatch): ...``
    """
    autocast, tensor, save, load = th.autocast, th.tensor, th.save, th.load

    def to_cpu(name: str) -> str:
        return "cpu" if name == DEVICE else name

    for query in ("is_autocast_enabled", "get_autocast_dtype"):
        ask = getattr(th, query)
        monkeypatch.setattr(th, query, lambda device, ask=ask: ask(to_cpu(device)))
    monkeypatch.setattr(th, "autocast", lambda device, *args, **kwargs: autocast(to_cpu(device), *args, **kwargs))
    monkeypatch.setattr(th, "tensor", lambda data, device=None, **kwargs: tensor(data, **kwargs).to(device or "cpu"))
    monkeypatch.setattr(optimizer, "_get_fused_kernels_supported_devices", lambda: ["cpu", DEVICE])
    monkeypatch.setattr(th, "save", lambda values, *args, **kwargs: save(tree_map(_held, values), *args, **kwargs))

    def load_there(file: Any, map_location: Any = "cpu", **kwargs: Any) -> Any:
        values = load(file, map_location="cpu", **kwargs)
        return tree_map(_put, values) if th.device(map_location).type == DEVICE else values

    monkeypatch.setattr(th, "load", load_there)
    return _Mode()
