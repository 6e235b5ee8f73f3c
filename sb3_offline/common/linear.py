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


def _signed(tensor: th.Tensor) -> th.Tensor:
    """:return: the same memory, to look for signs: PyTorch looks at bfloat16 by way of float32, and takes six times as long"""
    return tensor.view(th.int16) if tensor.dtype == th.bfloat16 else tensor


def _forward(
    x: th.Tensor, relus: Sequence[bool], parameters: Sequence[th.Tensor | None], exact: bool
) -> tuple[list[th.Tensor], list[th.Tensor]]:
    """:return: weights in the dtype of ``x``; and ``x`` with the outputs of all layers, the last one's exact if so"""
    # Outputs lie in memory with their features first, (out_features, rows). So all three products, forward and backward, find
    # the long axis of both sides contiguous: transposing thousands of rows takes as long as multiplying them.
    weights, inputs = [], [x]
    for relu, weight, bias in zip(relus, parameters[::2], parameters[1::2], strict=True):
        assert weight is not None
        # A first layer's weights may be columns of a wider matrix: oneDNN is a thousand times slower where rows have gaps.
        weights.append(weight.to(x.dtype).contiguous())
        if exact and len(weights) == len(relus):
            output = _product(weight, inputs[-1].to(weight.dtype)).t()
        else:
            output = _product(weights[-1], inputs[-1]).t()
        if bias is not None:
            output.view(-1, *bias.shape).add_(bias.to(output.dtype))
        if relu:
            _signed(output).clamp_min_(0)
        inputs.append(output)
    return weights, inputs


class _Layers(th.autograd.Function):
    # All layers are one node of the graph: with a few hundred rows, PyTorch's work around a node takes as long as the node's.

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, relus: Sequence[bool], exact: bool, *parameters: th.Tensor | None) -> th.Tensor:
        weights, inputs = _forward(x, relus, parameters, exact)
        ctx.relus = relus
        ctx.shapes = [() if parameter is None else parameter.shape for parameter in parameters]
        ctx.dtypes = [None if parameter is None else parameter.dtype for parameter in parameters]
        ctx.save_for_backward(*weights, *(inputs if relus[-1] else inputs[:-1]))
        return inputs[-1]

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        n_layers = len(ctx.relus)
        weights, inputs = ctx.saved_tensors[:n_layers], ctx.saved_tensors[n_layers:]
        gradients: list[th.Tensor | None] = [None] * len(ctx.needs_input_grad)
        gradient = gradient.to(weights[-1].dtype)  # it has no offset, so three digits are enough
        for layer in reversed(range(n_layers)):
            if ctx.relus[layer]:
                # Into the output, which no one reads any more: fresh memory would cost more than the operation.
                output = _signed(inputs[layer + 1])
                th.ops.aten.threshold_backward.grad_input(_signed(gradient), output, 0, grad_input=output)
                gradient = inputs[layer + 1]
            by_feature = gradient.t().contiguous()
            of_weight, of_bias = 3 + 2 * layer, 4 + 2 * layer
            if ctx.needs_input_grad[of_bias]:
                shape, dtype = ctx.shapes[2 * layer + 1], ctx.dtypes[2 * layer + 1]
                rows = shape[0] if len(shape) == 2 else 1
                gradients[of_bias] = by_feature.view(len(by_feature), -1, rows).sum(dim=1).t().reshape(shape).to(dtype)
            if ctx.needs_input_grad[of_weight]:
                x = inputs[layer].t()
                # oneDNN likes the many features on its right
                of_weights = _product(x, by_feature).t() if len(x) < len(by_feature) else _product(by_feature, x)
                gradients[of_weight] = of_weights.to(ctx.dtypes[2 * layer])
            if not any(ctx.needs_input_grad[:of_weight]):
                break
            gradient = _product(weights[layer].t(), by_feature.t()).t()
        else:
            gradients[0] = gradient
        return tuple(gradients)


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


def _run(x: th.Tensor, relus: Sequence[bool], parameters: Sequence[th.Tensor | None], exact: bool = False) -> th.Tensor:
    if th.is_grad_enabled():
        return _Layers.apply(x, relus, exact, *parameters)  # type: ignore[no-untyped-call]
    return _forward(x, relus, parameters, exact)[1][-1]


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    ``x @ weight.T + bias``, in the dtype of ``x``; gradients of the parameters come in the parameters' own dtype.

    :param x: ``(rows, in_features)``
    :param weight: ``(out_features, in_features)``
    :param bias: ``(out_features,)``; or ``(b, out_features)``, one for each of b rows, for the next b rows again, and so on
    :return: ``(rows, out_features)``
    """
    return _run(x, (False,), (weight, bias))


def run_layers(layers: Sequence[nn.Module | tuple[th.Tensor, th.Tensor | None]], x: th.Tensor) -> th.Tensor:
    """
    What ``nn.Sequential(*layers)`` does. A product at the end, without a ReLU, is in the dtype of its weights: around 1000
    bfloat16 has steps of 4 and 8, and the values of two actions differ by less.

    :param layers: linear layers, as modules or as weight and bias as :func:`linear` takes them, and whatever stands between
    :param x: ``(rows, in_features)``; its dtype is that of the products
    :return: ``(rows, out_features)``; of the weights' dtype where a linear layer is the last one
    """
    relus: list[bool] = []
    parameters: list[th.Tensor | None] = []
    for layer in layers:
        if isinstance(layer, nn.Linear | tuple):
            relus.append(False)
            parameters += layer if isinstance(layer, tuple) else (layer.weight, layer.bias)
        elif type(layer) is nn.ReLU and relus and not relus[-1]:
            relus[-1] = True
        else:
            if relus:
                x, relus, parameters = _run(x, relus, parameters), [], []
            x = layer(x.to(layer.weight.dtype)).to(x.dtype) if isinstance(layer, nn.LayerNorm) else layer(x)
    return _run(x, relus, parameters, exact=not relus[-1]) if relus else x
