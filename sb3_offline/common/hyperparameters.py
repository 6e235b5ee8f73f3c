"""What numbers and names the constructors of the algorithms take."""

import math
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

COUNT = "a whole number of at least 1"
WHOLE = "a whole number of at least 0"
POSITIVE = "a number above 0"
NOT_NEGATIVE = "a number of at least 0"
SHARE = "a number between 0 and 1"
OR_NONE = ", or None"

_FITS: dict[str, Callable[[Any], bool]] = {
    COUNT: lambda value: isinstance(value, Integral) and int(value) >= 1,
    WHOLE: lambda value: isinstance(value, Integral) and int(value) >= 0,
    POSITIVE: lambda value: value > 0,
    NOT_NEGATIVE: lambda value: value >= 0 and math.isfinite(value),
    SHARE: lambda value: 0 <= value <= 1,
}


def check_numbers(model: Any, kinds: Mapping[str, str]) -> None:
    """
    :param model: has them as attributes; raises ``TypeError`` where one is something else
    :param kinds: what each is to be: one of the texts above, with or without ``OR_NONE``
    """
    for name, kind in kinds.items():
        value = getattr(model, name)
        if value is None and kind.endswith(OR_NONE):
            continue
        if not isinstance(value, Real) or isinstance(value, bool) or not _FITS[kind.removesuffix(OR_NONE)](value):
            raise TypeError(f"{type(model).__name__}: {name} is {value!r}; give {kind}")


def check_choices(model: Any, choices: Mapping[str, Sequence[str]]) -> None:
    """
    :param model: has them as attributes; raises ``TypeError`` where one is something else
    :param choices: by name
    """
    for name, allowed in choices.items():
        if getattr(model, name) not in allowed:
            raise TypeError(f"{type(model).__name__}: {name} is {getattr(model, name)!r}; choose one of {allowed}")
