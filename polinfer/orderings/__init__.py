"""The order in which light meets the retarder and the polariser."""

from .base import Ordering
from .polariser_first import PolariserFirst
from .retarder_first import RetarderFirst

__all__ = ["Ordering", "PolariserFirst", "RetarderFirst"]
