"""Registers of a camera as its XML describes them: address, length, order of bytes, some of the bits.

In: a node of the XML. Out: bytes and whole numbers, read and written through the device's port. Called by the features.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol
from xml.etree.ElementTree import Element

from acquisition.errors import DeviceRefused, ProtocolError, SettingError
from acquisition.genicam.description import every, first, integer_of
from acquisition.genicam.formula import Formula, Number

__all__ = ["Port", "Registers"]

LONGEST_REGISTER = 1 << 16


class Port(Protocol):
    """Registers of a device."""

    def read(self, address: int, count: int) -> bytes:
        """``count`` bytes."""

    def write(self, address: int, data: bytes) -> None:
        """All of ``data``."""


class Registers:
    """Access to registers. port: gives the port of now. number: the number behind a node's name. variables: what the
    formula of a node may use."""

    def __init__(
        self,
        port: Callable[[], Port],
        number: Callable[[str], Number],
        variables: Callable[[Element], dict[str, Number]],
    ) -> None:
        self._port, self._number, self._variables = port, number, variables

    @staticmethod
    def float_code(name: str, length: int) -> str:
        """The code of ``struct`` for a floating register."""
        if length not in (4, 8):
            raise ProtocolError(f"{name[:80]} is a floating register of {length} bytes.")
        return "f" if length == 4 else "d"

    def order(self, node: Element) -> str:
        """ "<" or ">", for the order of its bytes."""
        return ">" if first(node, "Endianess") == "BigEndian" else "<"

    def length(self, node: Element) -> int:
        """Its bytes."""
        own, other = first(node, "Length"), first(node, "pLength")
        length = int(self._number(other)) if other is not None else integer_of(own or "0")
        if not 0 < length <= LONGEST_REGISTER:
            raise ProtocolError(f"the camera's XML gives {node.get('Name', '')[:80]!r} a length of {length} bytes.")
        return length

    def address(self, node: Element) -> int:
        """Where it lies: sums, indices and formulas."""
        address = sum(integer_of(found) for found in every(node, "Address"))
        address += sum(int(self._number(name)) for name in every(node, "pAddress"))
        for child in node:
            if child.tag == "pIndex":
                offset = child.get("Offset")
                step = integer_of(offset) if offset is not None else self.length(node)
                other = child.get("pOffset")
                if other is not None:
                    step = int(self._number(other))
                address += step * int(self._number((child.text or "").strip()))
            elif child.tag == "IntSwissKnife":
                formula = Formula(first(child, "Formula") or "", whole=True)
                address += int(formula(self._variables(child)))
        if not 0 <= address < 1 << 64:
            raise ProtocolError(f"the camera's XML gives {node.get('Name', '')[:80]!r} the address {address}.")
        return address

    def raw(self, node: Element) -> bytes:
        """What it holds."""
        count = self.length(node)
        try:
            raw = self._port().read(self.address(node), count)
        except DeviceRefused as error:
            error.add_note(f"reading {node.get('Name', '')[:80]}")
            raise
        if len(raw) != count:
            raise ProtocolError(f"the device gave {len(raw)} bytes for {count} of {node.get('Name', '')[:80]!r}.")
        return raw

    def bits(self, node: Element) -> tuple[int, int]:
        """Place of the lowest bit, and how many there are."""
        total = 8 * self.length(node)
        if total > 64:
            raise ProtocolError(f"{node.get('Name', '')[:80]!r} is a whole number of {total} bits.")
        if node.tag == "IntReg":
            return 0, total
        bit = first(node, "Bit")
        ends = [integer_of(bit or first(node, tag) or "0") for tag in ("LSB", "MSB")]
        if self.order(node) == ">":
            ends = [total - 1 - e for e in ends]
        low, high = min(ends), max(ends)
        if not 0 <= low <= high < total:
            raise ProtocolError(
                f"the camera's XML gives {node.get('Name', '')[:80]!r} bits {low} to {high} of {total}."
            )
        return low, high - low + 1

    def value(self, node: Element) -> int:
        """The whole number in it, or in some of its bits."""
        raw = int.from_bytes(self.raw(node), "big" if self.order(node) == ">" else "little")
        low, count = self.bits(node)
        value = (raw >> low) & ((1 << count) - 1)
        if first(node, "Sign") == "Signed" and value >> (count - 1):
            value -= 1 << count
        return value

    def put(self, node: Element, value: int) -> None:
        """Write a whole number; other bits of a register stay as they are."""
        low, count = self.bits(node)
        signed = first(node, "Sign") == "Signed"
        smallest, largest = (-(1 << (count - 1)), (1 << (count - 1)) - 1) if signed else (0, (1 << count) - 1)
        if not smallest <= value <= largest:
            raise SettingError(f"{node.get('Name', '')} must be from {smallest} to {largest}, got {value}.")
        length = self.length(node)
        order: Any = "big" if self.order(node) == ">" else "little"
        mask = ((1 << count) - 1) << low
        others = 0
        if count < 8 * length:
            others = int.from_bytes(self.raw(node), order) & ~mask
        self._port().write(self.address(node), (others | ((value << low) & mask)).to_bytes(length, order))
