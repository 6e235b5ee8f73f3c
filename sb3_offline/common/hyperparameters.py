"""Constraints on the arguments of the algorithms' constructors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any


@dataclass(frozen=True)
class Interval:
    """
    A constraint: a number within bounds.

    :param low: lower bound
    :param high: upper bound, which is included
    :param whole: whether the number is an integer
    :param includes_low: whether the lower bound is included
    :param infinite: whether the number may be infinite
    """

    low: float
    high: float = math.inf
    whole: bool = False
    includes_low: bool = True
    infinite: bool = False

    def allows(self, value: Any) -> bool:
        """:return: whether the value satisfies the constraint"""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        number = float(value)
        above = number >= self.low if self.includes_low else number > self.low
        return above and number <= self.high and (self.infinite or math.isfinite(number))

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a number"
        if self.high < math.inf:
            return f"{kind} between {self.low:g} and {self.high:g}"
        return f"{kind} of at least {self.low:g}" if self.includes_low else f"{kind} above {self.low:g}"


@dataclass(frozen=True)
class Options:
    """
    A constraint: one of several strings.

    :param names: the strings
    """

    names: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        """:return: whether the value satisfies the constraint"""
        return isinstance(value, str) and value in self.names

    def __str__(self) -> str:
        return f"one of {self.names}"


#: The constraints of one argument, of which one must be satisfied; ``None`` among them allows ``None``.
Constraints = Sequence[Interval | Options | None]

COUNT = Interval(1, whole=True)
WHOLE = Interval(0, whole=True)
POSITIVE = Interval(0, includes_low=False, infinite=True)
NOT_NEGATIVE = Interval(0)
SHARE = Interval(0, 1)


def check_parameters(model: Any) -> None:
    """
    Check the attributes that ``_parameter_constraints`` of a model's class and its bases name. A subclass may replace the
    constraints of its bases.

    :param model: raises ``TypeError`` if one of its attributes does not satisfy its constraints
    """
    constraints: dict[str, Constraints] = {}
    for cls in type(model).__mro__:
        for name, allowed in vars(cls).get("_parameter_constraints", {}).items():
            constraints.setdefault(name, allowed)
    for name, allowed in constraints.items():
        value = getattr(model, name)
        if not any(value is None if constraint is None else constraint.allows(value) for constraint in allowed):
            wanted = ", or ".join(str(constraint) for constraint in allowed)
            raise TypeError(f"{type(model).__name__}: {name} is {value!r}; give {wanted}")
