"""The Gibbs sampler as users declare it."""

from __future__ import annotations

from dataclasses import dataclass

from ...checks import integer, one_of_types
from ..ensemble import Ensemble

__all__ = ["Gibbs"]


@dataclass(frozen=True)
class Gibbs:
    """Draws from the exact distributions of each unknown given all the others, all pixels at once.

    J is multilinear in the unit vectors of five angles, so that for balanced states every conditional distribution is
    von Mises, or has one dimension; successive sweeps are nearly independent (1 to 3 sweeps for one effective draw).
    Second harmonics of unbalanced states take a candidate about the mode, priors of other forms slice steps. The
    equivalent parameter sets are visited by exchanges. It needs a shipped ordering, gain and noise; a window only
    without gain.

    Parameters
    ----------
    warmup: sweeps before the first draw, >= 0; chains begin around the most probable parameters.
    thin: sweeps for each draw that is kept, >= 1.
    effective: effective draws that each invariant of each pixel must reach, >= 0 (at most a fifth of the draws); where
        it does not, that pixel is drawn again with 2, 4, then 16 times as many sweeps for a draw, and then flagged
        ``Status.NOT_CONVERGED``.
    evidence: whether to compute the log evidence.
    fallback: draws the pixels anew that would be flagged, some seconds each; None: they are flagged.

    Raises
    ------
    ValueError, TypeError: numbers out of range, no integers.

    >>> Gibbs(thin=2).thin
    2
    """

    warmup: int = 50
    thin: int = 1
    effective: int = 400
    evidence: bool = True
    fallback: Ensemble | None = None

    def __post_init__(self) -> None:
        for name, low in (("warmup", 0), ("thin", 1), ("effective", 0)):
            object.__setattr__(self, name, integer(name, getattr(self, name), low=low))
        if not isinstance(self.evidence, bool):
            raise TypeError(f"evidence must be True or False, got {type(self.evidence).__name__}.")
        if self.fallback is not None:
            one_of_types("fallback", self.fallback, (Ensemble,), "pass Ensemble(...), or None.")
