"""
The operators behind the fast layers, with a plain PyTorch equivalent for each private one.

On CPUs, PyTorch gives float32 products to MKL, which leaves the wide vector units of some processors idle. oneDNN, which
PyTorch contains and uses for bfloat16, does not. Its product has no public name.
"""

from typing import Any

import torch as th


def is_eager() -> bool:
    """
    :return: whether PyTorch runs each operation as it is called. Otherwise it traces, exports, compiles or transforms them
        (``torch.func``), and knows its public operators only.
    """
    return not (th.compiler.is_compiling() or th.jit.is_tracing() or _is_transforming())


_is_transforming = getattr(th._C, "_are_functorch_transforms_active", lambda: False)


def _onednn_product() -> Any:
    """:return: oneDNN's product, or ``None`` if this PyTorch has none that works"""
    if not th.backends.mkldnn.is_available():
        return None
    operator = getattr(th.ops.mkldnn, "_linear_pointwise", None)
    try:
        ones = th.ones(2, 3, device="cpu", dtype=th.float32)
        works = bool((operator(ones, ones, None, "none", [], "") == 3).all())  # type: ignore[misc]
    except (RuntimeError, TypeError):  # missing, or with another signature
        return None
    return operator if works else None


_linear_pointwise = _onednn_product()
_threshold_backward = getattr(th.ops.aten.threshold_backward, "grad_input", None)


def product(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """
    :param left: ``(n, k)``
    :param right: ``(m, k)``
    :return: ``left @ right.T``, ``(n, m)``, contiguous in new memory, without a gradient
    """
    if _linear_pointwise is not None and left.dtype == th.float32 and left.device.type == "cpu" and right.numel() > 0:
        return _linear_pointwise(left, right, None, "none", [], "")  # type: ignore[no-any-return]
    return th.mm(left, right.t())


def relu_(x: th.Tensor) -> th.Tensor:
    """
    :param x: any shape, overwritten
    :return: ``x``, with 0 where it was negative
    """
    _as_integers(x).clamp_min_(0)
    return x


def relu_gradient_(gradient: th.Tensor, output: th.Tensor) -> th.Tensor:
    """
    :param gradient: gradient of a ReLU's output, overwritten
    :param output: output of the ReLU, of the same shape and dtype
    :return: ``gradient``, with 0 where the output is 0
    """
    values, outputs = _as_integers(gradient), _as_integers(output)
    if _threshold_backward is not None:
        _threshold_backward(values, outputs, 0, grad_input=values)
    else:
        values.masked_fill_(outputs <= 0, 0)
    return gradient


def _as_integers(x: th.Tensor) -> th.Tensor:
    """
    :return: the same memory. The sign of bfloat16 numbers is that of the integers with the same bits, and PyTorch compares
        integers six times as fast, because it converts bfloat16 to float32 for it.
    """
    return x.view(th.int16) if x.dtype == th.bfloat16 else x
