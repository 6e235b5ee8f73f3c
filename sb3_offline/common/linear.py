"""
Linear layers at the speed of the machine: the products behind the critics' heads, where most of a step's time goes.

On CPUs, PyTorch gives float32 products to MKL, which leaves the wide vector units of some processors idle; oneDNN, which
PyTorch brings along and uses for bfloat16, does not. :func:`linear` takes oneDNN's product where it exists.
"""

import functools
from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn


def _onednn_product() -> Any:
    """:return: oneDNN's product, or ``None`` in a PyTorch without it"""
    if not th.backends.mkldnn.is_available():
        return None
    return getattr(th.ops.mkldnn, "_linear_pointwise", None)


_linear_pointwise = _onednn_product()


def _product(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """:return: ``left @ right.T``; no gradient"""
    if _linear_pointwise is not None and left.device.type == "cpu" and left.dtype == th.float32 and right.numel() > 0:
        return _linear_pointwise(left, right, None, "none", [], "")  # type: ignore[no-any-return]
    return left @ right.t()


class _Linear(th.autograd.Function):
    # Outputs lie in memory with their features first, (out_features, rows). So all three products, forward and backward, find
    # the long axis of both sides contiguous: transposing thousands of rows takes as long as multiplying them.

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, relu: bool) -> th.Tensor:
        ctx.relu, ctx.parameter_dtype = relu, weight.dtype
        # A first layer's weights may be columns of a wider matrix: oneDNN is a thousand times slower where rows have gaps.
        weight = weight.to(x.dtype).contiguous()
        output = _product(weight, x).t()
        if bias is not None:
            output.view(-1, *bias.shape).add_(bias.to(x.dtype))
        if relu:
            output.relu_()
        if bias is not None:
            ctx.bias_shape, ctx.bias_dtype = bias.shape, bias.dtype
        ctx.save_for_backward(x, weight, output if relu else None)
        return output

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        x, weight, output = ctx.saved_tensors
        needs_x, needs_weight, needs_bias, _ = ctx.needs_input_grad
        if ctx.relu:
            # Into the output, which no one reads any more: fresh memory would cost more than the operation.
            gradient = th.ops.aten.threshold_backward.grad_input(gradient, output, 0, grad_input=output)
        by_feature = gradient.t().contiguous()
        bias_gradient = None
        if needs_bias:
            rows = ctx.bias_shape[0] if len(ctx.bias_shape) == 2 else 1
            bias_gradient = by_feature.view(len(by_feature), -1, rows).sum(dim=1).t().reshape(ctx.bias_shape)
        return (
            _product(weight.t(), by_feature.t()).t() if needs_x else None,
            _product(by_feature, x.t()).to(ctx.parameter_dtype) if needs_weight else None,
            None if bias_gradient is None else bias_gradient.to(ctx.bias_dtype),
            None,
        )


@functools.lru_cache
def has_fast_bfloat16(device: th.device) -> bool:
    """
    :param device: of the networks
    :return: whether it multiplies bfloat16 faster than float32, as far as its instructions say
    """
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    checks = [getattr(th.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    return device.type == "cpu" and any(check() for check in checks if check is not None)


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None, relu: bool = False) -> th.Tensor:
    """
    ``x @ weight.T + bias``, in the dtype of ``x``; gradients of the parameters come in the parameters' own dtype.

    :param x: ``(rows, in_features)``
    :param weight: ``(out_features, in_features)``
    :param bias: ``(out_features,)``; or ``(b, out_features)``, one for each of b rows, for the next b rows again, and so on
    :param relu: whether a ReLU follows
    :return: ``(rows, out_features)``
    """
    return _Linear.apply(x, weight, bias, relu)  # type: ignore[no-untyped-call]


def run_layers(layers: Sequence[nn.Module], x: th.Tensor) -> th.Tensor:
    """
    What ``nn.Sequential(*layers)`` does.

    :param layers: linear layers and whatever stands between them
    :param x: ``(rows, in_features)``; its dtype is that of the products
    :return: ``(rows, out_features)``
    """
    skip = False
    for index, layer in enumerate(layers):
        if skip:
            skip = False
        elif isinstance(layer, nn.Linear):
            skip = index + 1 < len(layers) and type(layers[index + 1]) is nn.ReLU
            x = linear(x, layer.weight, layer.bias, relu=skip)
        elif isinstance(layer, nn.LayerNorm):
            x = layer(x.to(layer.weight.dtype)).to(x.dtype)
        else:
            x = layer(x)
    return x
