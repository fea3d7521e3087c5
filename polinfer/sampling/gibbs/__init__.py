"""Gibbs sampling by exact conditional distributions, all pixels of a frame at once."""

from .engine import draw_gibbs
from .sampler import Gibbs

__all__ = ["Gibbs", "draw_gibbs"]
