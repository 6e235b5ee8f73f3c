"""
Neural networks at the speed of the machine.

The functions of this package compute what PyTorch's own modules compute. They alone decide in which precision, in which
memory order and by which operators, and they change no tensor of their callers. Where PyTorch traces, scripts, exports,
compiles or transforms a function, they call PyTorch's own layers.
"""

from sb3_offline.common.fast.convolutions import convolutions, prepare_convolutions
from sb3_offline.common.fast.heads import linear_heads, state_action_values
from sb3_offline.common.fast.layers import mlp
from sb3_offline.common.fast.precision import encode

__all__ = ["convolutions", "encode", "linear_heads", "mlp", "prepare_convolutions", "state_action_values"]
