"""Numbers that are known while code is traced: they leave nothing of themselves in the compiled code.

A compiler may not drop ``0 * x``, since x may be infinite. Here 0 is dropped, and a factor of 1: a parameter that a
model fixes, such as D = 0, leaves the code that one would have written without it. Operators return a :class:`Known` if
both sides are known, or one is 0, else an array; a JAX tree sees no array in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax

__all__ = ["ZERO", "Known"]


@dataclass(frozen=True)
class Known:
    """A number.

    >>> x = Known(0.0) * 3.5 + Known(2.0)
    >>> x, x + 1
    (Known(value=2.0), Known(value=3.0))
    """

    value: float

    __array_ufunc__ = None  # NumPy leaves the operators to this class

    def __add__(self, other: Any) -> Any:
        if (number := _number(other)) is not None:
            return Known(self.value + number)
        return other if self.value == 0 else self.value + other

    def __neg__(self) -> Known:
        return Known(-self.value)

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        if (number := _number(other)) is not None:
            return Known(self.value * number)
        if self.value in (0, 1):
            return self if self.value == 0 else other
        return -other if self.value == -1 else self.value * other

    def __truediv__(self, other: Any) -> Any:
        if (number := _number(other)) is not None:
            return Known(self.value / number)
        return self if self.value == 0 else self.value / other

    def __rtruediv__(self, other: Any) -> Any:
        return other * Known(1 / self.value)

    def __pow__(self, power: int) -> Known:
        return Known(self.value**power)

    __radd__, __rmul__ = __add__, __mul__


def _number(x: Any) -> float | None:
    if isinstance(x, Known):
        return x.value
    return float(x) if isinstance(x, int | float) else None


ZERO = Known(0.0)
jax.tree_util.register_pytree_node(Known, lambda x: ((), x.value), lambda value, _: Known(value))
