"""The formulas of a camera's XML: parsed here, never handed to Python.

In: text from the device. Out: a :class:`Formula` that numbers can be put into. Called by the features.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from acquisition.errors import ProtocolError

__all__ = ["Formula"]

Number = int | float
Node = Callable[[Mapping[str, Number]], Number]

LONGEST = 4096  # characters
DEEPEST = 64  # brackets and operators in each other
_TOKEN = re.compile(
    r"\s*(?:(?P<number>0[xX][0-9A-Fa-f]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_.]*)"
    r"|(?P<sign>\*\*|<<|>>|<>|<=|>=|&&|\|\||[-+*/%&|^~<>=()?:,!]))"
)
# operators by how tightly they bind, loosest first
_LEVELS = (("||",), ("&&",), ("|",), ("^",), ("&",), ("=", "<>"), ("<", ">", "<=", ">="), ("<<", ">>"), ("+", "-"),
           ("*", "/", "%"))  # fmt: skip


def _sign(x: Number) -> int:
    return (x > 0) - (x < 0)


def _rounded(x: Number, digits: Number = 0) -> float:
    """Halves away from zero, as in C."""
    scale = 10.0 ** max(-20, min(20, int(digits)))
    return math.copysign(math.floor(abs(x) * scale + 0.5), x) / scale


_FUNCTIONS: dict[str, tuple[tuple[int, ...], Callable[..., Number]]] = {
    "SGN": ((1,), _sign),
    "NEG": ((1,), lambda x: -x),
    "ABS": ((1,), abs),
    "SQRT": ((1,), math.sqrt),
    "TRUNC": ((1,), math.trunc),
    "FLOOR": ((1,), math.floor),
    "CEIL": ((1,), math.ceil),
    "ROUND": ((1, 2), _rounded),
    "SIN": ((1,), math.sin),
    "COS": ((1,), math.cos),
    "TAN": ((1,), math.tan),
    "ASIN": ((1,), math.asin),
    "ACOS": ((1,), math.acos),
    "ATAN": ((1,), math.atan),
    "EXP": ((1,), math.exp),
    "LN": ((1,), math.log),
    "LG": ((1,), math.log10),
}
_CONSTANTS = {"PI": math.pi, "E": math.e}


@dataclass(frozen=True)
class Formula:
    """A formula of the standard's language, for whole numbers of 64 bits or for floating ones.

    Operators as in C, with ``=`` and ``<>`` for equality and ``**`` for powers; functions and the constants PI and E
    in capitals. ``variables``: names that occur. Raises ProtocolError for text that is no formula, too long or too
    deep.

    >>> Formula("(RAW & 0xFF) * 10 + (N > 2 ? 1 : 0)", whole=True)({"RAW": 0x1205, "N": 3})
    51
    >>> Formula("SQRT(X) / 2")({"X": 9})
    1.5
    """

    text: str
    whole: bool = False
    variables: frozenset[str] = field(init=False, default=frozenset())
    _node: Node = field(init=False, repr=False, compare=False, default=lambda _: 0)

    def __post_init__(self) -> None:
        if len(self.text) > LONGEST:
            raise ProtocolError(f"a formula of {len(self.text)} characters is refused; at most {LONGEST}.")
        parser = _Parser(self.text, self.whole)
        object.__setattr__(self, "_node", parser.parsed())
        object.__setattr__(self, "variables", frozenset(parser.names))

    def __call__(self, values: Mapping[str, Number]) -> Number:
        """The value; ProtocolError where it does not exist (division by zero, overflow, an unknown name)."""
        try:
            found = self._node(values)
        except KeyError as error:
            raise ProtocolError(f"formula {self.text!r} needs {error.args[0]!r}, which is not given.") from error
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ProtocolError(f"formula {self.text!r} has no value for {dict(values)}: {error}.") from error
        if self.whole:
            return _signed(int(found)) if math.isfinite(found) else self._endless(values)
        return float(found) if math.isfinite(found) else self._endless(values)

    def _endless(self, values: Mapping[str, Number]) -> Number:
        raise ProtocolError(f"formula {self.text!r} is not finite for {dict(values)}.")


def _signed(value: int) -> int:
    """Two's complement of 64 bits."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value


class _Parser:
    def __init__(self, text: str, whole: bool) -> None:
        self.text, self.whole = text, whole
        self.names: set[str] = set()
        self.tokens = self._tokens()
        self.place = 0
        self.depth = 0

    def _tokens(self) -> list[tuple[str, str]]:
        found, place = [], 0
        end = len(self.text.rstrip())
        while place < end:
            match = _TOKEN.match(self.text, place)
            if match is None:
                raise ProtocolError(
                    f"formula {self.text!r} has {self.text[place : place + 8]!r}, which is no operator."
                )
            found.append((str(match.lastgroup), match.group(str(match.lastgroup))))
            place = match.end()
        return found

    def parsed(self) -> Node:
        node = self._choice()
        if self.place < len(self.tokens):
            raise ProtocolError(f"formula {self.text!r} goes on after its end, at {self.tokens[self.place][1]!r}.")
        return node

    def _peek(self) -> str:
        return self.tokens[self.place][1] if self.place < len(self.tokens) else ""

    def _take(self, sign: str) -> bool:
        if self.place < len(self.tokens) and self.tokens[self.place] == ("sign", sign):
            self.place += 1
            return True
        return False

    def _expect(self, sign: str) -> None:
        if not self._take(sign):
            raise ProtocolError(f"formula {self.text!r} wants {sign!r} before {self._peek() or 'its end'!r}.")

    def _deeper(self) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ProtocolError(f"a formula nested deeper than {DEEPEST} is refused.")

    def _choice(self) -> Node:
        self._deeper()
        condition = self._binary(0)
        if self._take("?"):
            yes = self._choice()
            self._expect(":")
            no = self._choice()
            self.depth -= 1
            return lambda v: yes(v) if condition(v) else no(v)
        self.depth -= 1
        return condition

    def _binary(self, level: int) -> Node:
        if level == len(_LEVELS):
            return self._unary()
        left = self._binary(level + 1)
        while self.place < len(self.tokens) and self.tokens[self.place][0] == "sign" and self._peek() in _LEVELS[level]:
            sign = self._peek()
            self.place += 1
            left = self._joined(sign, left, self._binary(level + 1))
        return left

    def _joined(self, sign: str, left: Node, right: Node) -> Node:
        if sign == "&&":
            return lambda v: int(bool(left(v)) and bool(right(v)))
        if sign == "||":
            return lambda v: int(bool(left(v)) or bool(right(v)))
        whole = self.whole
        operation = _OPERATIONS[sign]
        return lambda v: operation(left(v), right(v), whole)

    def _unary(self) -> Node:
        self._deeper()
        if self._take("-"):
            one = self._unary()
            node: Node = lambda v: -one(v)  # noqa: E731
        elif self._take("+"):
            node = self._unary()
        elif self._take("~"):
            one = self._unary()
            node = lambda v: ~int(one(v))  # noqa: E731
        elif self._take("!"):
            one = self._unary()
            node = lambda v: int(not one(v))  # noqa: E731
        else:
            node = self._power()
        self.depth -= 1
        return node

    def _power(self) -> Node:
        base = self._atom()
        if self._take("**"):
            exponent, whole = self._unary(), self.whole
            return lambda v: _power(base(v), exponent(v), whole)
        return base

    def _atom(self) -> Node:
        if self._take("("):
            node = self._choice()
            self._expect(")")
            return node
        if self.place >= len(self.tokens):
            raise ProtocolError(f"formula {self.text!r} ends where a number or a name must be.")
        kind, text = self.tokens[self.place]
        self.place += 1
        if kind == "number":
            value = _number(text, self.whole)
            return lambda _: value
        if kind != "name":
            raise ProtocolError(f"formula {self.text!r} has {text!r} where a number or a name must be.")
        if text in _FUNCTIONS and self._take("("):
            return self._call(text)
        if text in _CONSTANTS:
            constant = _CONSTANTS[text]
            return lambda v: v.get(text, constant)
        self.names.add(text)
        return lambda v: v[text]

    def _call(self, name: str) -> Node:
        arguments = [self._choice()]
        while self._take(","):
            arguments.append(self._choice())
        self._expect(")")
        counts, function = _FUNCTIONS[name]
        if len(arguments) not in counts:
            raise ProtocolError(f"formula {self.text!r} gives {name} {len(arguments)} arguments.")
        return lambda v: function(*(a(v) for a in arguments))


def _number(text: str, whole: bool) -> Number:
    if text[:2] in ("0x", "0X"):
        return int(text, 16)
    if whole and text.isdigit():
        return int(text)
    value = float(text)
    return int(value) if text.isdigit() and abs(value) < 2**53 else value


def _power(base: Number, exponent: Number, whole: bool) -> Number:
    if whole and isinstance(base, int) and isinstance(exponent, int) and exponent >= 0:
        return pow(base, exponent, 1 << 64) if exponent <= 1 << 16 else 0
    return math.pow(base, exponent)


def _divided(a: Number, b: Number, whole: bool) -> Number:
    if whole:
        quotient = abs(int(a)) // abs(int(b))
        return quotient if (a < 0) == (b < 0) else -quotient
    return a / b


def _remainder(a: Number, b: Number, whole: bool) -> Number:
    return math.fmod(a, b) if not whole else int(a) - int(b) * int(_divided(int(a), int(b), True))


def _shifted(a: Number, b: Number) -> int:
    if not -64 < b < 64:
        raise ValueError(f"a shift by {b}")
    return _signed(int(a) << int(b)) if b >= 0 else int(a) >> -int(b)


_OPERATIONS: dict[str, Callable[[Any, Any, bool], Number]] = {
    "|": lambda a, b, _: int(a) | int(b),
    "^": lambda a, b, _: int(a) ^ int(b),
    "&": lambda a, b, _: int(a) & int(b),
    "=": lambda a, b, _: int(a == b),
    "<>": lambda a, b, _: int(a != b),
    "<": lambda a, b, _: int(a < b),
    ">": lambda a, b, _: int(a > b),
    "<=": lambda a, b, _: int(a <= b),
    ">=": lambda a, b, _: int(a >= b),
    "<<": lambda a, b, _: _shifted(a, b),
    ">>": lambda a, b, _: _shifted(a, -b),
    "+": lambda a, b, whole: _signed(int(a) + int(b)) if whole else a + b,
    "-": lambda a, b, whole: _signed(int(a) - int(b)) if whole else a - b,
    "*": lambda a, b, whole: _signed(int(a) * int(b)) if whole else a * b,
    "/": _divided,
    "%": _remainder,
}
