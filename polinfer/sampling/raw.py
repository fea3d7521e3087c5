"""What a sampler hands over: draws of the pixels that can be sampled, before they are put into the frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..records import Parameters

__all__ = ["Raw"]


class Raw(NamedTuple):
    """Draws of some pixels, flat.

    ``parameters``: five arrays (chain, draw, pixel), any of the equivalent copies. ``gain`` complex and ``sigma`` float
    of the same shape, None where the model has none to infer. ``log_evidence`` and its standard error (pixel), NaN
    where not computed. ``converged`` (pixel).
    """

    parameters: Parameters
    gain: np.ndarray | None
    sigma: np.ndarray | None
    log_evidence: np.ndarray
    log_evidence_error: np.ndarray
    converged: np.ndarray
