"""Features of a camera, as its own XML describes them."""

from .features import Features
from .formula import Formula

__all__ = ["Features", "Formula"]
