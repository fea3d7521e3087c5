"""The command line ``polinfer``; packages above add commands by entry points of the group ``polinfer.commands``."""

from .group import main

__all__ = ["main"]
