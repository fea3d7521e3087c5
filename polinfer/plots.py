"""Pictures of results. Angles are shown in degrees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .checks import one_of_types
from .records import PERIODS, Fit, Parameters, Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_fit"]

TITLES = Parameters(
    "diattenuation", "diattenuation angle (°)", "retardance (°)", "retardance angle (°)", "circularity (°)"
)
_NO_ANSWER = int(Status.MASKED | Status.NON_FINITE | Status.NOT_CONVERGED)


def _draw(figure: Any, axes: Any, title: str, values: np.ndarray, cyclic: float | None, **limits: float) -> None:
    """One map with its colour bar; ``cyclic`` is the period in the unit of the values."""
    import matplotlib

    image = np.atleast_1d(values).reshape(-1, np.shape(values)[-1] if np.ndim(values) else 1)
    colours = matplotlib.colormaps["viridis" if cyclic is None else "twilight"].with_extremes(bad="0.7")
    if cyclic is not None:
        limits = {"vmin": -0.5 * cyclic, "vmax": 0.5 * cyclic}
    elif not np.isfinite(image).any():
        limits = {"vmin": 0.0, "vmax": 1.0}
    shown = axes.imshow(np.ma.masked_invalid(image), cmap=colours, interpolation="nearest", **limits)
    axes.set_title(title, fontsize=9)
    axes.set_xticks([])
    axes.set_yticks([])
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)


def plot_fit(fit: Fit) -> Figure:
    """Maps of a fit: each parameter above its standard deviation, after amplitude and phase of a gain.

    Angles are in degrees with a colour scale that closes on itself over their period; a retardance without a free gain
    has real ends, but is shown on the same circle. Grey pixels have no answer: they are masked, not finite, not
    converged, or (upper row) the parameter is not identified there. Below the gain stand the reduced chi-square
    and the evidence.

    Parameters
    ----------
    fit: of any pixel shape; a single pixel or a row is shown as an image.

    >>> import polinfer
    >>> scene = polinfer.phantoms.lesion((4, 4), rng=1)
    >>> data = polinfer.simulate(polinfer.Model(), scene.parameters, np.eye(2), sigma=0.05, rng=1)
    >>> len(plot_fit(polinfer.fit(polinfer.Model(), data)).axes)
    20
    """
    from matplotlib.figure import Figure

    one_of_types("fit", fit, (Fit,), "pass the result of fit().")
    status = np.asarray(fit.status)
    lost = (status & _NO_ANSWER) != 0
    rows, columns = status.shape[-2:] if status.ndim >= 2 else (1, status.size)
    height = min(max(2.2 * rows / columns, 0.7), 4.0)
    extra = 0 if fit.gain is None else 2
    figure = Figure(figsize=(2.9 * (5 + extra), 2 * (height + 0.5)), layout="constrained")
    axes = figure.subplots(2, 5 + extra, squeeze=False)
    if fit.gain is not None:
        _draw(figure, axes[0, 0], "amplitude", np.where(lost, np.nan, np.abs(fit.gain)), None)
        _draw(figure, axes[0, 1], "phase (°)", np.where(lost, np.nan, np.degrees(np.angle(fit.gain))), 360.0)
        _draw(figure, axes[1, 0], "χ² / degrees of freedom",
              np.where(lost | (fit.degrees_of_freedom == 0), np.nan,
                       fit.chi_square / np.maximum(fit.degrees_of_freedom, 1)), None)  # fmt: skip
        _draw(figure, axes[1, 1], "log evidence (nat)", np.where(lost, np.nan, fit.log_evidence), None)
    for i, name in enumerate(Parameters._fields):
        unit = 1.0 if name == "diattenuation" else 180 / np.pi
        value, std = unit * np.asarray(getattr(fit.parameters, name)), unit * np.asarray(getattr(fit.std, name))
        unknown = lost | ((status & int(Status.unidentified(name))) != 0)
        cyclic = None if name == "diattenuation" else unit * getattr(PERIODS, name)
        _draw(figure, axes[0, extra + i], getattr(TITLES, name), np.where(unknown, np.nan, value), cyclic)
        # a width beyond that of a uniform distribution says no more than "unknown" and would hide all others
        ceiling = 2 / 12**0.5 if cyclic is None else cyclic / 12**0.5
        spread = np.where(lost, np.nan, np.minimum(std, ceiling))
        _draw(figure, axes[1, extra + i], "± standard deviation", spread, None, vmin=0.0)
    return figure
