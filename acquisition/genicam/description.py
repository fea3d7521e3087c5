"""The XML in which a camera describes its features, as nodes by name. Untrusted: no entities, bounded size and number.

In: bytes from the device. Out: elements, and the values of their children. Called by the features and the registers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
from defusedxml.common import DefusedXmlException

from acquisition.errors import ProtocolError

__all__ = ["LARGEST", "VALUE_NODES", "WHOLE", "every", "first", "integer_of", "number_of", "read_nodes"]

LARGEST = 16 << 20  # bytes of XML
MOST = 50_000  # nodes
VALUE_NODES = {
    "Integer", "IntReg", "MaskedIntReg", "Float", "FloatReg", "StringReg", "Register", "Boolean", "Enumeration",
    "Command", "Converter", "IntConverter", "SwissKnife", "IntSwissKnife",
}  # fmt: skip
WHOLE = {"Integer", "IntReg", "MaskedIntReg", "IntConverter", "IntSwissKnife", "Boolean", "Enumeration", "Command"}


@lru_cache(maxsize=2)  # a camera that is opened again; nothing changes an element
def read_nodes(xml: bytes) -> dict[str, Element]:
    """All nodes by name, those in groups too; ProtocolError for XML that is foreign, damaged or too large."""
    if len(xml) > LARGEST:
        raise ProtocolError(f"the camera's XML has {len(xml)} bytes; more than {LARGEST} are refused.")
    try:
        root = defusedxml.ElementTree.fromstring(xml, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError, RecursionError) as error:
        raise ProtocolError(f"the camera's XML cannot be read: {type(error).__name__} {error}.") from error
    for element in root.iter():
        element.tag = str(element.tag).rsplit("}", 1)[-1]  # without its namespace
    if root.tag != "RegisterDescription":
        raise ProtocolError(f"the camera's XML begins with {root.tag[:40]!r}, not RegisterDescription.")
    found: dict[str, Element] = {}
    stack = list(root)[::-1]
    while stack:
        node = stack.pop()
        if node.tag == "Group":
            stack.extend(list(node)[::-1])
        if node.tag not in VALUE_NODES | {"Category", "Port"}:
            continue
        name = node.get("Name", "")
        if not name or name in found:
            raise ProtocolError(f"the camera's XML has two nodes {name[:80]!r}, or one without a name.")
        found[name] = node
        if len(found) > MOST:
            raise ProtocolError(f"the camera's XML has more than {MOST} nodes.")
    return found


def every(node: Element, tag: str) -> Iterator[str]:
    """What the children of this tag hold."""
    for child in node.findall(tag):
        yield (child.text or "").strip()


def first(node: Element, tag: str) -> str | None:
    """What the first child of this tag holds; None without one."""
    child = node.find(tag)
    return None if child is None else (child.text or "").strip()


def integer_of(text: str) -> int:
    """A whole number of at most 64 bits, decimal or 0x..."""
    try:
        value = int(text, 16) if text[:2].lower() == "0x" else int(text, 10)
    except ValueError as error:
        raise ProtocolError(f"the camera's XML has {text[:40]!r} where a whole number must be.") from error
    if abs(value) >= 1 << 64:
        raise ProtocolError(f"the camera's XML has the number {text[:40]}, beyond 64 bits.")
    return value


def number_of(text: str) -> float:
    """A number."""
    try:
        value = float(int(text, 16)) if text[:2].lower() == "0x" else float(text)
    except ValueError as error:
        raise ProtocolError(f"the camera's XML has {text[:40]!r} where a number must be.") from error
    if math.isnan(value):
        raise ProtocolError("the camera's XML has NaN where a number must be.")
    return value
