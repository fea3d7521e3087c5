"""What every recovery method is, and the verb that runs one.

In: :class:`fibre.CalibrationFields` and a method. Out: :class:`fibre.Inverse`. Called by users and by the ``recover``
command.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from fibre.records import CalibrationFields, Inverse
from polinfer.checks import one_of_types

__all__ = ["RecoveryMethod", "recover"]


class RecoveryMethod(ABC):
    """A way to find A^-1 from calibration fields: a frozen object of settings with one function."""

    @abstractmethod
    def solve(self, fields: CalibrationFields, progress: bool) -> Inverse:
        """The inverse transmission matrix."""


def recover(calibration_fields: CalibrationFields, method: RecoveryMethod, progress: bool = False) -> Inverse:
    """The inverse transmission matrix from calibration fields, by ``method`` (for instance ``Ridge()``).

    Raises TypeError for other records and methods, ValueError where a point was lit in fewer than two states.
    """
    one_of_types(
        "calibration_fields", calibration_fields, (CalibrationFields,), "make them with retrieve_fields(calibration)."
    )
    one_of_types("method", method, (RecoveryMethod,), "pass an object such as Ridge().")
    return method.solve(calibration_fields, progress)
