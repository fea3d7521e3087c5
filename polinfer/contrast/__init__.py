"""How well two regions of a map can be told apart: CNR and gCNR with intervals that respect samples and circles."""

from .measures import cnr, gcnr
from .records import Contrast
from .units import tiles

__all__ = ["Contrast", "cnr", "gcnr", "tiles"]
