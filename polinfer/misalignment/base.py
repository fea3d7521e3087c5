"""What every kind of misalignment is."""

from __future__ import annotations

from abc import ABC

__all__ = ["Misalignment"]


class Misalignment(ABC):  # noqa: B024
    """How the two arms of the illumination may be out of line; a frozen object of settings.

    Arms that are not parallel reach the sample with a relative phase phi that changes over the frame,
    ``T = diag(1, e^{i phi})``. The calibration saw the same, so the matrix that is measured is ``T^-1 J T``.
    """
