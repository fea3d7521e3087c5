"""Full posteriors: samplers, their draws, and what is to be said about them."""

from .calibration import Ranks, calibration_ranks
from .diagnostics import Diagnostics
from .draws import Draws
from .ensemble import Ensemble
from .gibbs import Gibbs
from .predictive import Predictive
from .streaming import summarise
from .summaries import Summary
from .verb import sample

__all__ = [
    "Diagnostics",
    "Draws",
    "Ensemble",
    "Gibbs",
    "Predictive",
    "Ranks",
    "Summary",
    "calibration_ranks",
    "sample",
    "summarise",
]
