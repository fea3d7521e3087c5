"""Which types a file of this package may be made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from . import storage
from .datasets import FibreMatrix
from .gain import ComplexGain, PhaseGain
from .misalignment import RotatedBasis, Tilt, TiltPlane
from .model import Model
from .neighbours import Window
from .noise import InferredNoise, KnownNoise
from .orderings import PolariserFirst, RetarderFirst
from .phantoms import Phantom
from .priors import AxialVonMises, TruncatedNormal, UniformAngle, VonMises
from .records import Fit, Measurement, Parameters
from .sampling.diagnostics import Diagnostics
from .sampling.draws import Draws
from .sampling.ensemble import Ensemble
from .sampling.gibbs import Gibbs
from .sampling.predictive import Predictive
from .sampling.summaries import Summary
from .texture import Angle, Bounded, Chi, FitTexture, Rescaled, Texture

__all__ = ["TYPES", "load"]

TYPES: tuple[type, ...] = (
    Measurement, Fit, Phantom, FibreMatrix, Parameters, Model,
    Draws, Summary, Diagnostics, Predictive, Gibbs, Ensemble,
    RetarderFirst, PolariserFirst,
    VonMises, AxialVonMises, UniformAngle, TruncatedNormal,
    Texture, FitTexture, Angle, Bounded, Chi, Rescaled,
    KnownNoise, InferredNoise, PhaseGain, ComplexGain, Window,
    TiltPlane, RotatedBasis, Tilt,
)  # fmt: skip


def load(path: str | Path, classes: tuple[type, ...] = ()) -> Any:
    """The record that :func:`polinfer.save` wrote to ``path`` (``.nc`` or ``.zarr``).

    ``classes`` are types of your own that the record holds, such as a prior or an ordering. Nothing is unpickled.

    Raises
    ------
    FileNotFoundError: nothing there. ValueError: a foreign, damaged or newer file, or a type that was not offered.

    >>> import tempfile, numpy as np
    >>> from polinfer import save
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = save(Measurement(np.eye(2), np.eye(2), sigma=0.1), Path(folder) / "data.nc")
    ...     load(path).sigma.item()
    0.1
    """
    return storage.load(path, (*TYPES, *classes))
