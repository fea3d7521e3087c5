"""From a model and a measurement to the most probable parameters and their uncertainty."""

from .frames import fit

__all__ = ["fit"]
