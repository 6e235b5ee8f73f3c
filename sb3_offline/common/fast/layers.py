"""Linear layers and ReLUs, forward and backward: most of the time of a training step is spent here."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_offline.common.fast.operators import is_eager, product, relu_, relu_gradient_

#: Weight and bias of a linear layer. A bias of shape ``(b, out_features)`` has one row for each of b rows of the input, for
#: the next b rows again, and so on.
WeightAndBias = tuple[th.Tensor, th.Tensor | None]


def mlp(layers: Iterable[nn.Module | WeightAndBias], x: th.Tensor) -> th.Tensor:
    """
    Compute what ``nn.Sequential(*layers)`` computes.

    The dtype of ``x`` is that of all products but one: if the last layer is linear, its product and the result have the
    dtype of the weights. Around 1000, neighbouring numbers of bfloat16 are 4 or 8 apart, and the values of two actions
    differ by less.

    :param layers: linear layers, as modules or as weight and bias, and any other modules
    :param x: ``(rows, in_features)``
    :return: ``(rows, out_features)``
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
                x, relus, parameters = _run(x, relus, parameters, exact=False), [], []
            x = layer(x.to(layer.weight.dtype)).to(x.dtype) if isinstance(layer, nn.LayerNorm) else layer(x)
    return _run(x, relus, parameters, exact=not relus[-1]) if relus else x


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
    """
    Compute ``x @ weight.T + bias`` in the dtype of ``x``.

    :param x: ``(rows, in_features)``
    :param weight: ``(out_features, in_features)``
    :param bias: see :data:`WeightAndBias`
    :return: ``(rows, out_features)``
    """
    return _run(x, (False,), (weight, bias), exact=False)


def _run(x: th.Tensor, relus: Sequence[bool], parameters: Sequence[th.Tensor | None], exact: bool) -> th.Tensor:
    """
    Run linear layers, some of them followed by a ReLU.

    :param x: ``(rows, in_features)``
    :param relus: of each layer, whether a ReLU follows it
    :param parameters: weight and bias of the first layer, of the second, and so on
    :param exact: whether the last layer computes in the dtype of its weight, instead of that of ``x``
    :return: ``(rows, out_features)``
    """
    if not is_eager():
        return _run_plainly(x, relus, parameters, exact)
    if th.is_grad_enabled():
        return _Layers.apply(x, relus, exact, *parameters)  # type: ignore[no-untyped-call]
    return _forward(x, relus, parameters, exact)[0]


def _run_plainly(x: th.Tensor, relus: Sequence[bool], parameters: Sequence[th.Tensor | None], exact: bool) -> th.Tensor:
    """Do the same as :func:`_run` with PyTorch's own functions, which it can trace and differentiate any number of times."""
    dtype = x.dtype
    for layer, (relu, weight, bias) in enumerate(zip(relus, parameters[::2], parameters[1::2], strict=True)):
        assert weight is not None
        if exact and layer == len(relus) - 1:
            dtype = weight.dtype
        if bias is None or bias.dim() == 1:
            x = F.linear(x.to(dtype), weight.to(dtype), None if bias is None else bias.to(dtype))
        else:
            x = F.linear(x.to(dtype), weight.to(dtype))
            x = (x.view(-1, *bias.shape) + bias.to(dtype)).view(x.shape)
        if relu:
            x = F.relu(x)
    return x


def _forward(
    x: th.Tensor, relus: Sequence[bool], parameters: Sequence[th.Tensor | None], exact: bool
) -> tuple[th.Tensor, list[th.Tensor], list[th.Tensor]]:
    """:return: the result; the weights in the dtypes of the products; the output of each layer, ``(out_features, rows)``"""
    # Outputs lie in memory with their features first. So all three products, forward and backward, find the long axis of both
    # sides contiguous: transposing thousands of rows takes as long as multiplying them.
    dtype = x.dtype
    weights, outputs = [], []
    for layer, relu in enumerate(relus):
        weight, bias = parameters[2 * layer : 2 * layer + 2]
        assert weight is not None
        if exact and layer == len(relus) - 1:
            dtype = weight.dtype
        # A weight may be some columns of a wider matrix, but oneDNN is a thousand times slower where rows have gaps.
        weights.append(_in_dtype(weight, dtype).contiguous())
        output = product(weights[-1], _in_dtype(x, dtype))
        x = output.t()
        if bias is not None:
            (x if bias.dim() == 1 else x.view(-1, *bias.shape)).add_(_in_dtype(bias, dtype))
        outputs.append(relu_(output) if relu else output)
    return x, weights, outputs


def _in_dtype(tensor: th.Tensor, dtype: th.dtype) -> th.Tensor:
    """:return: ``tensor.to(dtype)``, but PyTorch takes longer to find that there is nothing to do"""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


class _Layers(th.autograd.Function):
    # All layers are one node of the graph: with a few hundred rows, PyTorch's work around a node takes as long as the node's.

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, relus: Sequence[bool], exact: bool, *parameters: th.Tensor | None) -> th.Tensor:
        result, weights, outputs = _forward(x, relus, parameters, exact)
        result = result.data  # PyTorch forbids operations in place on a view that a function returns.
        ctx.relus, ctx.exact = relus, exact
        # A last ReLU's output is saved as the result, so that PyTorch notices if the caller changes it.
        ctx.save_for_backward(x, *parameters, *weights, *outputs[:-1], result if relus[-1] else None)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        n_layers = len(ctx.relus)
        x, *saved = ctx.saved_tensors
        parameters, weights, outputs = saved[: 2 * n_layers], saved[2 * n_layers : 3 * n_layers], saved[3 * n_layers :]
        needed = ctx.needs_input_grad
        if th.is_grad_enabled():  # The gradient itself is to be differentiated.
            return _differentiable_gradients(ctx, gradient, x, parameters)
        gradients: list[th.Tensor | None] = [None] * len(needed)
        # From here on gradients are (out_features, rows). They have no offset, so the three digits of bfloat16 are enough.
        by_feature = _in_dtype(gradient, x.dtype).t().contiguous()
        if ctx.relus[-1]:
            outputs[-1] = outputs[-1].t()
            by_feature = by_feature.clone()  # The ReLU's gradient is written over it, and it may be the caller's.
        for layer in reversed(range(n_layers)):
            weight, bias = parameters[2 * layer : 2 * layer + 2]
            of_weight, of_bias = 3 + 2 * layer, 4 + 2 * layer
            if ctx.relus[layer]:
                relu_gradient_(by_feature, outputs[layer])
            if needed[of_bias]:
                gradients[of_bias] = _in_dtype(_bias_gradient(by_feature, bias.shape), bias.dtype)
            if needed[of_weight]:
                inputs = outputs[layer - 1] if layer else x.t()
                # oneDNN is faster with the larger number of features on its right.
                swap = inputs.shape[0] < by_feature.shape[0]
                of_weights = product(inputs, by_feature).t() if swap else product(by_feature, inputs)
                gradients[of_weight] = _in_dtype(of_weights, weight.dtype)
            if not any(needed[:of_weight]):
                break
            by_feature = product(_in_dtype(weights[layer], x.dtype).t(), by_feature.t())
        else:
            gradients[0] = by_feature.t()
        return tuple(gradients)


def _bias_gradient(by_feature: th.Tensor, shape: Sequence[int]) -> th.Tensor:
    """
    :param by_feature: gradient of a layer's output, ``(out_features, rows)``
    :param shape: shape of the bias, see :data:`WeightAndBias`
    :return: gradient of the bias, of its shape
    """
    if len(shape) == 1:
        return by_feature.sum(dim=1)
    return by_feature.view(by_feature.shape[0], -1, shape[0]).sum(dim=1).t().reshape(shape)


def _differentiable_gradients(
    ctx: Any, gradient: th.Tensor, x: th.Tensor, parameters: Sequence[th.Tensor | None]
) -> tuple[th.Tensor | None, ...]:
    """:return: what the backward pass of :class:`_Layers` returns, with a graph, so that it can be differentiated again"""
    inputs = (x, None, None, *parameters)
    needed = [tensor for tensor, is_needed in zip(inputs, ctx.needs_input_grad, strict=True) if is_needed]
    output = _run_plainly(x, ctx.relus, parameters, ctx.exact)
    gradients = iter(th.autograd.grad(output, needed, gradient, create_graph=True))  # type: ignore[arg-type]
    return tuple(next(gradients) if is_needed else None for is_needed in ctx.needs_input_grad)
