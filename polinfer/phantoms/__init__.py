"""Scenes with known truth: plates, gels, solutions, films and tissue, each a :class:`Phantom`.

They describe what the sample is, not what the instrument sees of it: ``polinfer.simulate(model, scene.parameters,
states, sigma, gain=scene.gain)`` makes the measurement. What a recovery does not know of is declared in each phantom
(``variation``, ``wedge``, ``tilt``, ...) and absent by default.
"""

from .base import Phantom
from .chirality import chiral
from .cohorts import cohort
from .films import film
from .scattering import scattering_gel
from .stretching import gel_birefringence, gel_thickness, stretched_gel
from .tissue import lesion
from .waveplates import half_wave_plate

__all__ = [
    "Phantom",
    "chiral",
    "cohort",
    "film",
    "gel_birefringence",
    "gel_thickness",
    "half_wave_plate",
    "lesion",
    "scattering_gel",
    "stretched_gel",
]
