"""What is known about the noise."""

from .base import Noise
from .inferred import InferredNoise
from .known import KnownNoise

__all__ = ["InferredNoise", "KnownNoise", "Noise"]
