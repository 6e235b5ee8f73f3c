"""The real RL Zoo (``rl_zoo3``) for offline algorithms. Importing this package registers all of them with it."""

from functools import partial

try:
    import rl_zoo3
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f'{error}; install it with: pip install "sb3-offline[zoo]"', name=error.name) from error

from sb3_offline import ALGOS
from sb3_offline.zoo.hyperparams import convert_params, sample_params

rl_zoo3.ALGOS.update(ALGOS)  # one dict, which all programs of rl_zoo3 share
for _name, _class in ALGOS.items():
    HYPERPARAMS_SAMPLER[_name] = partial(sample_params, _class.search_space)
    HYPERPARAMS_CONVERTER[_name] = convert_params
