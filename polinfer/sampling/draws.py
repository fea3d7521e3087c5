"""Full posteriors: draws of the five parameters in every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import storage
from ..checks import one_of_types
from ..model import Model
from ..records import Measurement, Parameters
from ..storage import array, setting
from .diagnostics import LEAST, Diagnostics, diagnose
from .summaries import Summary, summarise_draws

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .predictive import Predictive

__all__ = ["Draws"]


@dataclass(frozen=True, eq=False)
class Draws:
    """Result of :func:`polinfer.sample`: draws from the posterior of every pixel.

    Angles in radians. A pixel without draws (masked, not finite) is NaN and flagged in ``status``.

    Attributes
    ----------
    model, measurement: what the draws are the posterior of.
    parameters: five arrays ``(chain, draw, *P)``. Every draw is that of its eight equivalent sets which is nearest to
        the most probable parameters of the pixel. A fixed parameter has its value, one that drops out of J is NaN.
    log_evidence, log_evidence_error: log evidence and its standard error, shape P (nats), NaN where not computed.
    status: :class:`polinfer.Status` bits, shape P; ``NOT_CONVERGED`` where the chains disagree.
    gain: draws of the complex gain of the pixel, ``(chain, draw, *P)``, None if the model has none.
    sigma: draws of sigma where it is inferred, ``(chain, draw, *P)``, else None.
    seed: seed of the generator. sampler: settings of the sampler.
    tilt: draws of the tilt's coefficients ``(chain, draw, *frames, terms)``, each shared by the pixels of its frame,
        None if the model has no :class:`polinfer.TiltPlane`; ``model.misalignment.phase(tilt, shape)`` are the phases.

    Raises
    ------
    ValueError: shapes that do not fit, fewer than 4 draws in a chain. TypeError: no model, no measurement.

    >>> rng = np.random.default_rng(0)
    >>> data = Measurement.from_jones(np.ones((3, 2, 2)), 0.1)
    >>> values = Parameters(*rng.normal(0.5, 0.1, (5, 4, 100, 3)))
    >>> draws = Draws(Model(), data, values, np.zeros(3), np.zeros(3), np.zeros(3, np.int32), None, None, 1, None)
    >>> draws.shape, draws.chains, draws.count
    ((3,), 4, 100)
    >>> draws.summary().mean.retardance.round(1).tolist()
    [0.5, 0.5, 0.5]
    """

    model: Model
    measurement: Measurement
    parameters: Parameters = array(("chain", "draw", "*P"), "rad")
    log_evidence: np.ndarray = array(("*P",), "nat")
    log_evidence_error: np.ndarray = array(("*P",), "nat")
    status: np.ndarray = array(("*P",), "1")
    gain: np.ndarray | None = array(("chain", "draw", "*P"), "1")
    sigma: np.ndarray | None = array(("chain", "draw", "*P"), "1")
    seed: int = setting()
    sampler: Any = setting()
    tilt: np.ndarray | None = array(("chain", "draw", "*P", "term"), "rad", default=None)

    def __post_init__(self) -> None:
        one_of_types("model", self.model, (Model,), "pass the Model of the draws.")
        one_of_types("measurement", self.measurement, (Measurement,), "pass the Measurement of the draws.")
        one_of_types("parameters", self.parameters, (Parameters,), "pass Parameters of arrays (chain, draw, *P).")
        shape = self.measurement.shape
        full = np.shape(self.parameters.diattenuation)
        if len(full) < 2 or full[2:] != shape or full[0] < 1 or full[1] < LEAST:
            raise ValueError(f"parameters must have shape (chain, draw, *{shape}) with at least {LEAST} draws, "
                             f"got {full}.")  # fmt: skip
        expected = {f"parameters.{name}": (getattr(self.parameters, name), full) for name in Parameters._fields}
        expected |= {name: (getattr(self, name), shape) for name in ("log_evidence", "log_evidence_error", "status")}
        expected |= {name: (getattr(self, name), full) for name in ("gain", "sigma") if getattr(self, name) is not None}
        for name, (value, wanted) in expected.items():
            if np.shape(value) != wanted:
                raise ValueError(f"{name} must have shape {wanted}, got {np.shape(value)}.")

    @property
    def shape(self) -> tuple[int, ...]:
        """Pixel shape P."""
        return self.measurement.shape

    @property
    def chains(self) -> int:
        """Number of chains."""
        return int(np.shape(self.parameters.diattenuation)[0])

    @property
    def count(self) -> int:
        """Number of draws of each chain."""
        return int(np.shape(self.parameters.diattenuation)[1])

    def summary(self, level: float = 0.68) -> Summary:
        """Mean directions, widths, and the shortest arcs that hold ``level`` of the draws, 0 < level < 1."""
        return summarise_draws(self.model, self.parameters, self.gain, self.sigma, self.status, level)

    def diagnostics(self) -> Diagnostics:
        """Split R-hat and effective sample size of functions that the equivalent sets share."""
        return diagnose(self.model, self.parameters, self.gain, self.sigma, self.status)

    def predictive(
        self, rng: int | np.random.Generator | None = None, draws: int = 200, responses: bool = False
    ) -> Predictive:
        """Do data of the model look like those that were measured? See :func:`polinfer.sampling.predictive.predict`."""
        from .predictive import predict

        return predict(self, rng, draws, responses)

    def to_dataset(self) -> Any:
        """The draws as a labelled :class:`xarray.Dataset` with units, ``parameters.retardance (chain, draw, y, x)``."""
        dataset = storage.to_dataset(self)
        axes = [name for name in dataset.sizes if name in ("chain", "draw", "y", "x") or name.startswith("pixel_")]
        return dataset.assign_coords({name: np.arange(dataset.sizes[name]) for name in axes})

    def to_arviz(self) -> Any:
        """The draws for ArviZ: an InferenceData before its version 1, an :class:`xarray.DataTree` from then on.

        Group ``posterior``: the free parameters (radians), ``gain_real``, ``gain_imag`` and ``sigma`` where there are;
        ``observed_data``: the response. Judge convergence by :meth:`diagnostics`: R-hat and effective sample sizes of
        an angle on a line are wrong at the wrap, and where two equivalent sets are equally near.

        Raises
        ------
        ImportError: ArviZ is not installed.
        """
        from .export import to_arviz

        return to_arviz(self)

    def plot(
        self, pixel: tuple[int, ...] | None = None, smooth: bool = False, pixel_size: float | None = None
    ) -> Figure:
        """Maps of the means with their uncertainty below, or the joint posterior of one pixel.

        ``pixel`` is an index into P, such as ``(row, column)``, see :func:`polinfer.sampling.corner.plot_pixel`. Maps
        are drawn without it, see :func:`polinfer.plots.plot_summary` for ``smooth`` and ``pixel_size``.
        """
        if pixel is None:
            return self.summary().plot(smooth=smooth, pixel_size=pixel_size)
        from .corner import plot_pixel

        return plot_pixel(self, pixel)
