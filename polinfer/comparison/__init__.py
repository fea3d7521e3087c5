"""Which model the data speak for: evidences compared, pooled over a scene, and the power to tell models apart."""

from .cross_validation import LeaveOneOut, leave_one_out
from .detection import Power, power
from .records import Comparison, PooledEvidence
from .screens import OrderingScreen, ordering_screen
from .selection import select
from .verb import compare

__all__ = [
    "Comparison",
    "LeaveOneOut",
    "OrderingScreen",
    "PooledEvidence",
    "Power",
    "compare",
    "leave_one_out",
    "ordering_screen",
    "power",
    "select",
]
