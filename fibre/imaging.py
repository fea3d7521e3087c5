"""Amplitude and phase images of a sample from its Jones data, for those who do not ask for polarisation.

In: a :class:`polinfer.Measurement` that ``reconstruct`` made. Out: a :class:`TransmissionImage`, which can be plotted.
Called by users.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from polinfer import Measurement
from polinfer.checks import one_of_types
from polinfer.plots import draw_map, map_grid
from polinfer.storage import array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["TransmissionImage", "transmission_image"]


@dataclass(frozen=True)
class TransmissionImage:
    """What a sample does to the amplitude and phase of the light, whatever its polarisation.

    amplitude: real (y, x), root of the transmitted share of the power. phase: radians, (-pi, pi]. amplitude_std,
    phase_std: standard deviations; that of a phase that is not known at all is infinite. NaN where no state was
    measured.
    """

    amplitude: np.ndarray = array(("*P",), "1")
    phase: np.ndarray = array(("*P",), "rad")
    amplitude_std: np.ndarray = array(("*P",), "1")
    phase_std: np.ndarray = array(("*P",), "rad")

    def plot(self, pixel_size: float | None = None) -> Figure:
        """Both images above their standard deviations; the phase in colours that close on themselves.

        ``pixel_size``: metres between points, for a scale bar.
        """
        lost = ~np.isfinite(self.amplitude)
        figure, axes = map_grid(lost, 2, 2, pixel_size, below=0.1)
        draw_map(axes[0, 0], "amplitude", self.amplitude, lost, high=np.inf, pixel_size=pixel_size)
        draw_map(axes[0, 1], "phase (°)", np.degrees(self.phase), lost, period=360.0, pixel_size=pixel_size)
        draw_map(axes[1, 0], "its standard deviation", self.amplitude_std, lost, high=np.inf, pixel_size=pixel_size)
        unknown = ~np.isfinite(self.phase_std)
        draw_map(axes[1, 1], "its standard deviation (°)", np.degrees(self.phase_std), lost, high=104.0,
                 unknown=unknown, pixel_size=pixel_size)  # fmt: skip
        return figure


def transmission_image(measurement: Measurement) -> TransmissionImage:
    r"""Amplitude and phase of a sample's transmission, averaged over the states of illumination.

    .. math:: t = \sqrt{\frac{\sum_s |V_s|^2 - 2 n \sigma^2}{\sum_s |U_s|^2}}, \quad
              \phi = \arg \sum_s U_s^\dagger V_s

    for fields U without and V with the sample, both vectors of two polarisations: the root of the transmitted power,
    less that of the noise (0 where the noise is all), and the phase that Pancharatnam's definition gives. Standard
    deviations from :math:`\sigma` (per complex component): :math:`\sigma / \sqrt{2 \sum |U|^2}` and
    :math:`\sigma \sqrt{\sum |U|^2 / 2} / |\sum U^\dagger V|`. A retarder that sends light into the other polarisation
    has no phase in this sense where the sum vanishes; its deviation says so.

    ``measurement``: (*P, 2, n), with sigma or without (deviations are then NaN). Weights and masks count.

    Raises TypeError for anything else.

    >>> u = np.eye(2) + 0j
    >>> image = transmission_image(Measurement(u, 0.5j * u, sigma=0.01))
    >>> round(float(image.amplitude), 3), round(float(image.phase), 3), round(float(image.phase_std), 4)
    (0.5, 1.571, 0.01)

    Source: S. Pancharatnam, Proc. Indian Acad. Sci. A 44, 247 (1956).
    """
    one_of_types("measurement", measurement, (Measurement,), "make it with reconstruct().")
    u, v = np.asarray(measurement.illumination), np.asarray(measurement.response)
    u, v = np.broadcast_arrays(u, v)
    used = np.ones(v.shape[:-2] + v.shape[-1:])
    if measurement.weight is not None:
        used = np.broadcast_to(np.asarray(measurement.weight), used.shape)
    if measurement.mask is not None:
        used = used * np.broadcast_to(np.asarray(measurement.mask), used.shape[:-1])[..., None]
    w = np.where(used > 0, used, 0.0)[..., None, :]
    v = np.where(w > 0, v, 0)
    lit = (w * np.abs(u) ** 2).sum((-2, -1))
    seen = (w * np.abs(v) ** 2).sum((-2, -1))
    overlap = (w * u.conj() * v).sum((-2, -1))
    sigma = np.nan if measurement.sigma is None else np.asarray(measurement.sigma, float)
    noise = 0.0 if measurement.sigma is None else 2 * used.sum(-1) * sigma**2
    with np.errstate(divide="ignore", invalid="ignore"):
        amplitude = np.where(lit > 0, np.sqrt(np.maximum(seen - noise, 0) / lit), np.nan)
        std = np.where(lit > 0, sigma / np.sqrt(2 * lit), np.nan)
        phase_std = np.where(lit > 0, sigma * np.sqrt(lit / 2) / np.abs(overlap), np.nan)
    # beyond the width of a uniform distribution nothing is known
    phase_std = np.where(phase_std > np.pi / np.sqrt(3), np.inf, phase_std)
    return TransmissionImage(amplitude, np.where(lit > 0, np.angle(overlap), np.nan), std, phase_std)
