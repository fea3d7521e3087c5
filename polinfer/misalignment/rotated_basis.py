"""The published correction: a retarder without circularity, the same over a window."""

from __future__ import annotations

from dataclasses import dataclass

from .base import Misalignment

__all__ = ["RotatedBasis"]


@dataclass(frozen=True)
class RotatedBasis(Misalignment):
    """The basis of the fields is turned to the retarder's axis, where it has no circularity, one basis for a window.

    ``R(-t) V = g J(theta_eta = 0, theta_D - t) R(-t) U`` with the angle t common to the pixels of the window. Since
    ``R(t) J(theta_eta = 0, theta_D - t) R(-t) = J(theta_eta = t, theta_D, xi = 0)``, this is a model without
    circularity whose parameters are shared: ``Model(neighbours=Window(3, 5), misalignment=RotatedBasis())`` fixes the
    circularity at 0, and t is reported as the retardance angle. It needs ``neighbours``.

    It describes no tilt: a phase phi between the arms is a circularity -phi, which this model denies. Small ones it
    survives; :class:`TiltPlane` describes them, and keeps the resolution that a window costs.

    Source: Gordon et al., supplementary information, beam misalignment, with its equation corrected (both fields are
    turned, by R(-t)).

    >>> from polinfer import Model, Window
    >>> Model(neighbours=Window(3, 5), misalignment=RotatedBasis()).free
    ('diattenuation', 'diattenuation_angle', 'retardance', 'retardance_angle')
    """
