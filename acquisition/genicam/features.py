"""The feature tree of a camera: ExposureTime, Width and the like, evaluated from the XML that the device brings.

In: XML bytes from the device and a port to its registers. Out: :class:`Features`, values by name with limits, units and
access. Called by the camera's driver. The XML is untrusted: no entities, no document types, bounded size, depth and
number of nodes; its formulas are parsed by us.

Node types: Category, Integer, IntReg, MaskedIntReg, Float, FloatReg, StringReg, Register, Boolean, Enumeration,
Command, Converter, IntConverter, SwissKnife, IntSwissKnife, Port; StructReg, ports within chunks, and events are not
read.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

from acquisition.errors import ProtocolError, SettingError
from acquisition.genicam.description import VALUE_NODES, WHOLE, every, first, integer_of, number_of, read_nodes
from acquisition.genicam.formula import Formula, Number
from acquisition.genicam.registers import Port, Registers

__all__ = ["Feature", "Features"]

DEEPEST = 40  # nodes that refer to each other in a chain


@dataclass(frozen=True)
class Feature:
    """What is known of a feature now. kind: as in :class:`acquisition.Setting`; unit: as the XML says it; low, high,
    step: limits; choices: of an enumeration, those available now; access: "rw", "ro", "wo", or "" for none."""

    name: str
    kind: str
    unit: str
    low: float | None
    high: float | None
    step: float | None
    choices: tuple[str, ...]
    access: str


class Features:
    """Features of a device by name.

    Values are read from and written to ``port`` every time; nothing is cached. Raises ProtocolError for XML that is
    foreign, damaged, too large or refers to itself.
    """

    def __init__(self, xml: bytes, port: Port) -> None:
        self.port = port
        self.nodes = read_nodes(xml)
        self._formulas: dict[tuple[str, str], Formula] = {}
        self._depth = 0
        self._registers = Registers(lambda: self.port, self._number, self._variables)

    def __contains__(self, name: str) -> bool:
        return name in self.nodes and self.nodes[name].tag in VALUE_NODES

    def names(self) -> list[str]:
        """Features that the categories show, from Root downwards, in order; all values where there is no Root."""
        if "Root" not in self.nodes:
            return [name for name in self.nodes if name in self]
        found: dict[str, None] = {}
        stack, seen = ["Root"], set()
        while stack:
            name = stack.pop()
            if name in seen or name not in self.nodes:
                continue
            seen.add(name)
            if self.nodes[name].tag == "Category":
                stack.extend(list(every(self.nodes[name], "pFeature"))[::-1])
            else:
                found[name] = None
        return list(found)

    def feature(self, name: str) -> Feature:
        """Kind, unit, limits, choices and access as they are now."""
        node = self._node(name)
        tag = node.tag
        kind = {"Boolean": "switch", "Enumeration": "choice", "Command": "action", "StringReg": "text",
                "Register": "bytes"}.get(tag, "integer" if tag in WHOLE else "number")  # fmt: skip
        low, high, step = self.limits(name) if kind in ("integer", "number") else (None, None, None)
        choices = tuple(self._entries(node)) if kind == "choice" else ()
        return Feature(name, kind, self._unit(node), low, high, step, choices, self.access(name))

    def access(self, name: str) -> str:
        """ "rw", "ro", "wo", or "" where it is not implemented or not available now."""
        with _Deeper(self):
            node = self._node(name)
            for tag in ("pIsImplemented", "pIsAvailable"):
                one = first(node, tag)
                if one is not None and not self._number(one):
                    return ""
            imposed = {"RO": "ro", "WO": "wo"}.get(first(node, "ImposedAccessMode") or "", "rw")
            below = self._access_below(node)
            both = "".join(c for c in "rw" if self._allows(imposed, c) and self._allows(below, c))
            access = {"r": "ro", "w": "wo", "rw": "rw", "": ""}[both]
            lock = first(node, "pIsLocked")
            if lock is not None and access in ("rw", "wo") and self._number(lock):
                return "ro" if access == "rw" else ""
            return access

    @staticmethod
    def _allows(access: str, what: str) -> bool:
        return access == "rw" or access == {"r": "ro", "w": "wo"}[what]

    def _access_below(self, node: Element) -> str:
        tag = node.tag
        if tag in ("SwissKnife", "IntSwissKnife"):
            return "ro"
        if tag in ("IntReg", "MaskedIntReg", "FloatReg", "StringReg", "Register"):
            return {"RO": "ro", "WO": "wo", "RW": "rw"}.get(first(node, "AccessMode") or "RO", "ro")
        below = first(node, "pValue")
        return self.access(below) if below is not None else "rw"

    def get(self, name: str) -> Any:
        """The value: int, float, bool, str (of a choice or text), or bytes. A command: whether it still runs."""
        node = self._node(name)
        if not self._allows(self.access(name), "r"):
            raise SettingError(f"{name} cannot be read now.")
        tag = node.tag
        if tag == "Boolean":
            return self._number(name) == self._on_off(node)[0]
        if tag == "Enumeration":
            value = self._number(name)
            for entry, number in self._entries(node, everything=True).items():
                if number == value:
                    return entry
            raise ProtocolError(f"{name} has the value {value}, which is none of its choices.")
        if tag == "StringReg":
            raw = self._registers.raw(node)
            return raw.split(b"\0")[0].decode("utf-8", "replace")
        if tag == "Register":
            return self._registers.raw(node)
        return self._number(name)

    def set(self, name: str, value: Any) -> None:
        """Write; SettingError out of limits, unknown choices, or what is locked now."""
        node = self._node(name)
        if not self._allows(self.access(name), "w"):
            raise SettingError(f"{name} cannot be written now (read-only, locked or not available).")
        tag = node.tag
        if tag == "Boolean":
            self._put(name, self._on_off(node)[0 if value else 1])
        elif tag == "Enumeration":
            entries = self._entries(node)
            if value not in entries:
                raise SettingError(f"{name} must be one of {', '.join(entries)}, got {value!r}.")
            self._put(name, entries[value])
        elif tag == "StringReg":
            self._put_text(node, name, value)
        elif tag == "Register":
            raise SettingError(f"{name} is a plain register; it is not written here.")
        else:
            self._put_number(name, tag, value)

    def _put_text(self, node: Element, name: str, value: Any) -> None:
        length = self._registers.length(node)
        raw = value.encode() if isinstance(value, str) else None
        if raw is None or len(raw) > length:
            raise SettingError(f"{name} must be text of at most {length} bytes, got {value!r}.")
        self.port.write(self._registers.address(node), raw.ljust(length, b"\0"))

    def _put_number(self, name: str, tag: str, value: Any) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingError(f"{name} must be a number, got {value!r}.")
        low, high, step = self.limits(name)
        if not math.isfinite(value) or (low is not None and value < low) or (high is not None and value > high):
            raise SettingError(f"{name} must be from {low} to {high}, got {value!r}.")
        if tag in WHOLE and (value != int(value) or (step and low is not None and (int(value) - int(low)) % int(step))):
            raise SettingError(f"{name} must be {low} plus a multiple of {step}, got {value!r}.")
        self._put(name, int(value) if tag in WHOLE else float(value))

    def execute(self, name: str) -> None:
        """Do what a command stands for."""
        node = self._node(name)
        if node.tag != "Command":
            raise SettingError(f"{name} is no command.")
        if not self._allows(self.access(name), "w"):
            raise SettingError(f"{name} cannot be executed now.")
        self._put(name, self._command_value(node))

    def running(self, name: str) -> bool:
        """Whether a command has not finished yet; False where that cannot be read."""
        node = self._node(name)
        below = first(node, "pValue")
        if below is None or not self._allows(self.access(below), "r"):
            return False
        return self._number(below) == self._command_value(node)

    def limits(self, name: str) -> tuple[float | None, float | None, float | None]:
        """Smallest and largest value and increment, None where there is none."""
        with _Deeper(self):
            node = self._node(name)
            tag = node.tag
            whole = tag in WHOLE
            bounds = [self._bound(node, part, whole) for part in ("Min", "Max", "Inc")]
            if tag in ("IntReg", "MaskedIntReg"):
                bits, signed = self._registers.bits(node)[1], first(node, "Sign") == "Signed"
                natural = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
                bounds[:2] = [own if own is not None else n for own, n in zip(bounds[:2], natural, strict=True)]
            below = first(node, "pValue")
            if below is not None and tag in ("Integer", "Float"):
                inner = self.limits(below)
                bounds = [own if own is not None else i for own, i in zip(bounds, inner, strict=True)]
            elif below is not None and tag in ("Converter", "IntConverter"):
                bounds = [*self._converted(node, name, below), None]
            low, high, step = bounds
            return low, high, step

    def _converted(self, node: Element, name: str, below: str) -> list[float | None]:
        low, high, _ = self.limits(below)
        if low is None or high is None:
            return [None, None]
        formula, variables = self._formula(name, node, "FormulaFrom"), self._variables(node)
        ends = [formula(variables | {"TO": end}) for end in (low, high)]
        return [min(ends), max(ends)]

    def _bound(self, node: Element, part: str, whole: bool) -> Number | None:
        own = first(node, part)
        if own is not None:
            return integer_of(own) if whole else number_of(own)
        other = first(node, "p" + part)
        return None if other is None else self._number(other)

    def _unit(self, node: Element) -> str:
        with _Deeper(self):
            own = first(node, "Unit")
            below = first(node, "pValue")
            if own is not None or below is None or below not in self.nodes:
                return (own or "")[:32]
            return self._unit(self._node(below))

    def _node(self, name: str) -> Element:
        if name not in self.nodes and self._depth > 1:
            return self._referred(name)
        if name not in self.nodes:
            raise SettingError(f"name must be a feature of the camera, got {str(name)[:80]!r}.")
        return self.nodes[name]

    def _referred(self, name: str) -> Element:
        if name not in self.nodes:
            raise ProtocolError(f"the camera's XML refers to {name[:80]!r}, which it does not hold.")
        return self.nodes[name]

    def _on_off(self, node: Element) -> tuple[int, int]:
        return integer_of(first(node, "OnValue") or "1"), integer_of(first(node, "OffValue") or "0")

    def _command_value(self, node: Element) -> int:
        own, other = first(node, "CommandValue"), first(node, "pCommandValue")
        return int(self._number(other)) if other is not None else integer_of(own or "1")

    def _entries(self, node: Element, everything: bool = False) -> dict[str, int]:
        found = {}
        for child in node:
            if child.tag != "EnumEntry":
                continue
            conditions = [first(child, tag) for tag in ("pIsImplemented", "pIsAvailable")]
            if not everything and any(c is not None and not self._number(c) for c in conditions):
                continue
            found[child.get("Name", "")] = integer_of(first(child, "Value") or "0")
        return found

    # numbers

    def _number(self, name: str) -> Number:
        """The number behind any node."""
        with _Deeper(self):
            node = self._referred(name)
            tag = node.tag
            if tag in ("IntReg", "MaskedIntReg"):
                return self._registers.value(node)
            if tag == "FloatReg":
                raw = self._registers.raw(node)
                value = float(
                    struct.unpack(self._registers.order(node) + self._registers.float_code(name, len(raw)), raw)[0]
                )
                if not math.isfinite(value):
                    raise ProtocolError(f"{name} is {value} in the device.")
                return value
            if tag in ("SwissKnife", "IntSwissKnife"):
                return self._formula(name, node, "Formula")(self._variables(node))
            if tag in ("Converter", "IntConverter"):
                below = self._number(self._below(node))
                return self._formula(name, node, "FormulaFrom")(self._variables(node) | {"TO": below})
            if tag in ("StringReg", "Register", "Category", "Port"):
                raise ProtocolError(f"the camera's XML uses {name[:80]!r}, a {tag}, as a number.")
            return self._plain(node, tag)

    def _plain(self, node: Element, tag: str) -> Number:
        index = first(node, "pIndex")
        if index is not None:
            chosen = int(self._number(index))
            for child in node:
                if child.tag in ("ValueIndexed", "pValueIndexed") and child.get("Index", "") == str(chosen):
                    text = (child.text or "").strip()
                    if child.tag == "pValueIndexed":
                        return self._number(text)
                    return number_of(text) if tag == "Float" else integer_of(text)
            other, own = first(node, "pValueDefault"), first(node, "ValueDefault")
        else:
            other, own = first(node, "pValue"), first(node, "Value")
        if other is not None:
            return self._number(other)
        if own is None:
            raise ProtocolError(f"the camera's XML gives {node.get('Name', '')[:80]!r} no value.")
        if own.lower() in ("true", "false"):
            return int(own.lower() == "true")
        return number_of(own) if tag == "Float" else integer_of(own)

    def _put(self, name: str, value: Number) -> None:
        """Write the number behind any node."""
        with _Deeper(self):
            node = self._referred(name)
            tag = node.tag
            if tag in ("IntReg", "MaskedIntReg"):
                self._registers.put(node, int(value))
            elif tag == "FloatReg":
                code = self._registers.float_code(name, self._registers.length(node))
                self.port.write(self._registers.address(node), struct.pack(self._registers.order(node) + code, value))
            elif tag in ("Converter", "IntConverter"):
                found = self._formula(name, node, "FormulaTo")(self._variables(node) | {"FROM": value})
                below = self._below(node)
                whole = self._referred(below).tag in WHOLE
                self._put(below, round(found) if whole else found)
            elif tag in ("SwissKnife", "IntSwissKnife", "StringReg", "Register", "Category", "Port"):
                raise ProtocolError(f"the camera's XML writes a number to {name[:80]!r}, a {tag}.")
            elif first(node, "pValue") is not None:
                self._put(self._below(node), value)
                for copy in every(node, "pValueCopy"):
                    self._put(copy, value)
            elif first(node, "Value") is not None:
                element = next(child for child in node if child.tag == "Value")
                element.text = repr(value)
            else:
                raise SettingError(f"{name} cannot be written.")

    def _below(self, node: Element) -> str:
        below = first(node, "pValue")
        if below is None:
            raise ProtocolError(f"the camera's XML gives {node.get('Name', '')[:80]!r} no pValue.")
        return below

    def _formula(self, name: str, node: Element, tag: str) -> Formula:
        key = (name, tag)
        if key not in self._formulas:
            text = first(node, tag)
            if text is None:
                raise ProtocolError(f"the camera's XML gives {name[:80]!r} no {tag}.")
            whole = node.tag in ("IntSwissKnife", "IntConverter")
            named = {}
            for child in node:
                if child.tag == "Expression":
                    named[child.get("Name", "")] = Formula((child.text or "").strip(), whole)
            formula = Formula(text, whole)
            if named:
                formula = _WithExpressions(text, whole, named)
            self._formulas[key] = formula
        return self._formulas[key]

    def _variables(self, node: Element) -> dict[str, Number]:
        found: dict[str, Number] = {}
        for child in node:
            text = (child.text or "").strip()
            if child.tag == "pVariable":
                found[child.get("Name", "")] = self._number(text)
            elif child.tag == "Constant":
                found[child.get("Name", "")] = number_of(text)
        return found


@dataclass(frozen=True)
class _WithExpressions(Formula):
    """A formula that uses named ones."""

    named: dict[str, Formula] | None = None

    def __init__(self, text: str, whole: bool, named: dict[str, Formula]) -> None:
        object.__setattr__(self, "text", text)
        object.__setattr__(self, "whole", whole)
        object.__setattr__(self, "named", named)
        self.__post_init__()

    def __call__(self, values: Any) -> Number:
        """See :class:`Formula`."""
        whole = dict(values)
        for name, formula in (self.named or {}).items():
            whole[name] = formula(whole)
        return super().__call__(whole)


class _Deeper:
    """Counts how deep nodes refer to each other: one that refers to itself must not end the process."""

    def __init__(self, features: Features) -> None:
        self.features = features

    def __enter__(self) -> None:
        self.features._depth += 1
        if self.features._depth > DEEPEST:
            self.features._depth -= 1
            raise ProtocolError(f"the camera's XML refers from node to node more than {DEEPEST} times: a circle?")

    def __exit__(self, *_: object) -> None:
        self.features._depth -= 1
