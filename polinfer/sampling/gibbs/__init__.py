"""Gibbs sampling by exact conditional distributions, all pixels of a frame at once."""

from .engine import draw_gibbs, part_of, problem_of
from .sampler import Gibbs

__all__ = ["Gibbs", "draw_gibbs", "part_of", "problem_of"]
