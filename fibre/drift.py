"""Drift between captures: piston and tilt of reference fields, followed through time.

In: fields of the reference at some times, in fibrelet modes. Out: a :class:`Drift`, which says how far any capture has
moved, with its uncertainty, and takes it out. Called by users before :func:`fibre.retrieve_fields`, and by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from fibre.records import Fibrelets
from polinfer.checks import complex_array, one_of_types, real_array
from polinfer.storage import array

__all__ = ["Drift", "track_drift"]

ROUNDS = 4  # of the common template and the references' phases


class States(NamedTuple):
    """Piston and two slopes: mean (n, 3) and covariance (n, 3, 3)."""

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Drift:
    r"""Phase :math:`p(t) + g(t) \cdot (r - r_0)` by which fields have moved, known at some times.

    Between and around those times p and both components of g are random walks, :math:`\mathrm{var}[p(t) - p(t')] =
    q_p |t - t'|`, so :meth:`at` gives the mean and covariance of the Gaussian process that the measurements leave.

    times: (n,) seconds, ascending. piston: (n,) radians, relative to the mean of the references, unwrapped in time.
    tilt: (n, 2) radians a metre, along rows and columns. covariance: (n, 3, 3) of (piston, tilt) as measured. rates:
    (2,), q of the piston, rad^2/s, and of each tilt, (rad/m)^2/s. centre: (2,) metres, r_0.
    """

    times: np.ndarray = array(("reference",), "s")
    piston: np.ndarray = array(("reference",), "rad")
    tilt: np.ndarray = array(("reference", "row_column"), "rad/m")
    covariance: np.ndarray = array(("reference", "state", "other_state"), "1")
    rates: np.ndarray = array(("kind",), "1/s")
    centre: np.ndarray = array(("row_column",), "m")

    def __post_init__(self) -> None:
        times = real_array("times", self.times, shape=(None,), finite=True)
        n = len(times)
        if n == 0 or np.any(np.diff(times) <= 0):
            raise ValueError(f"times must ascend and be at least one, got {times.tolist()}.")
        shapes = {"piston": (n,), "tilt": (n, 2), "covariance": (n, 3, 3), "rates": (2,), "centre": (2,)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, real_array(name, getattr(self, name), shape=shape, finite=True))
        if np.any(self.rates < 0):
            raise ValueError(f"rates must be >= 0, got {self.rates.tolist()}.")
        object.__setattr__(self, "times", times)

    def at(self, times: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Piston (c,), tilt (c, 2) and their covariance (c, 3, 3) at ``times`` (c,) seconds, any order."""
        wanted = real_array("times", times, shape=(None,), finite=True)
        found = _smooth(_scaled(self), wanted)
        return found.mean[:, 0], found.mean[:, 1:], found.covariance

    def correct(self, fields: Any, times: Any, fibrelets: Fibrelets) -> np.ndarray:
        """``fields`` complex (c, 2, m) of captures at ``times`` (c,), as they would be without the drift."""
        one_of_types("fibrelets", fibrelets, (Fibrelets,), "pass the Fibrelets that the fields are in.")
        count = len(fibrelets.centres)
        fields = complex_array("fields", fields, shape=(None, 2, count), finite=True)
        times = real_array("times", times, shape=(len(fields),), finite=True)
        piston, tilt, _ = self.at(times)
        phase = piston[:, None] + tilt @ (fibrelets.centres - self.centre).T
        return np.asarray(fields * np.exp(-1j * phase)[:, None])

    def phase_variance(self, times: Any, fibrelets: Fibrelets) -> np.ndarray:
        """Variance (c, m), rad^2, of the phase that :meth:`correct` takes out of each fibrelet. A field of power P has
        P times this as variance that is common to its fibrelets, not independent."""
        _, _, covariance = self.at(times)
        design = np.concatenate([np.ones((len(fibrelets.centres), 1)), fibrelets.centres - self.centre], axis=1)
        return np.asarray(np.einsum("mi,cij,mj->cm", design, covariance, design))


def track_drift(
    fields: Any, times: Any, fibrelets: Fibrelets, variance: Any = None, rates: tuple[float, float] | None = None
) -> Drift:
    r"""Piston and tilt of every reference field, and how fast they walk.

    Reference j is a common template turned, :math:`y_{jk} = T_k e^{i (p_j + g_j \cdot (r_k - r_0))} + n_{jk}`. The
    template is the mean of the references turned back; p and g maximise the likelihood, found by a Fourier transform
    over the facet (slopes of many cycles are no trouble) and Gauss-Newton steps; the covariance is the inverse Fisher
    information. The rates of the walks maximise the likelihood of all references, tilts along rows and columns with the
    same rate.

    Parameters
    ----------
    fields: complex (n, 2, m), n >= 1 reference fields in the modes of ``fibrelets``. times: (n,) seconds, ascending.
    variance: real, shape of fields, E|error|^2, infinite = unusable; None: one number for all, from what the template
    leaves over (n >= 2). rates: (rad^2/s, (rad/m)^2/s) if they are known; None: found, 0 with fewer than three
    references.

    A piston that moves by more than pi between two references is taken for a smaller one: no data tell.

    Raises
    ------
    TypeError, ValueError: shapes, times that do not ascend, no light, a single reference without variance.

    Source: maximum likelihood; Rauch, Tung and Striebel (1965) for the smoother.

    >>> y, x = np.mgrid[-5:6, -5:6] * 4.5e-6
    >>> fibrelets = Fibrelets(np.stack([y.ravel(), x.ravel()], 1), 1.6e-6)
    >>> template = np.ones((2, fibrelets.centres.shape[0]), complex)
    >>> turn = np.exp(1j * (0.4 + 3e4 * fibrelets.centres[:, 0]))
    >>> drift = track_drift(np.stack([template, template * turn]), [0.0, 60.0], fibrelets, np.full((2, 2, 121), 1e-4))
    >>> round(float(np.ptp(drift.piston)), 3), round(float(np.ptp(drift.tilt[:, 0])) / 1e4, 3)
    (0.4, 3.0)
    """
    one_of_types("fibrelets", fibrelets, (Fibrelets,), "pass the Fibrelets that the fields are in.")
    count = len(fibrelets.centres)
    fields = complex_array("fields", fields, shape=(None, 2, count), finite=True)
    times = real_array("times", times, shape=(len(fields),), finite=True)
    if len(fields) == 0 or np.any(np.diff(times) <= 0):
        raise ValueError(f"times must ascend and be at least one, got {times.tolist()}.")
    if variance is None:
        if len(fields) < 2:
            raise ValueError("variance must be given for a single reference: nothing shows its noise.")
        known = np.ones(fields.shape)
    else:
        known = real_array("variance", variance, above=0)
        if known.shape != fields.shape:
            raise ValueError(f"variance must have the shape of fields {fields.shape}, got {known.shape}.")
    power = np.sum(np.abs(fields) ** 2 / known, axis=(0, 1))
    if not power.sum() > 0:
        raise ValueError("fields hold no light at usable fibrelets; pass the fields of the reference spot.")
    centre = power @ fibrelets.centres / power.sum()
    place = fibrelets.centres - centre
    size = float(np.sqrt(power @ (place**2).sum(1) / power.sum())) or 1.0
    place = place / size
    template, mean = fields[0], np.zeros((len(fields), 3))
    for _ in range(ROUNDS):
        products = np.sum(np.conj(template) * fields / known, axis=1)
        states = [_phase(q, place, start) for q, start in zip(products, mean, strict=True)]
        mean = np.array([state for state, _ in states])
        weight = 1 / known
        back = fields * np.exp(-1j * (mean[:, :1] + mean[:, 1:] @ place.T))[:, None]
        template = np.sum(weight * back, axis=0) / np.maximum(weight.sum(0), 1e-300)
    covariance = np.array([part for _, part in states])
    if variance is None:
        covariance *= float(np.mean(np.abs(back - template) ** 2)) * len(fields) / (len(fields) - 1)
    mean[:, 0] = np.unwrap(mean[:, 0])
    mean -= mean.mean(0)
    if rates is None:
        found = _rates(times, mean, covariance)
    else:
        found = real_array("rates", rates, shape=(2,), low=0, finite=True) * np.array([1, size**2])
    scale = np.array([1, 1 / size, 1 / size])
    return Drift(times, mean[:, 0], mean[:, 1:] / size, covariance * np.outer(scale, scale),
                 found / np.array([1, size**2]), centre)  # fmt: skip


def _phase(products: np.ndarray, place: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Piston and slopes (3,) of products (m,) with the template, and their covariance for unit weight."""
    design = np.concatenate([np.ones((len(place), 1)), place], axis=1)
    state = start if start.any() else _coarse(products, place)
    for _ in range(20):
        left = products * np.exp(-1j * design @ state)
        curvature = 2 * design.T @ (np.abs(left)[:, None] * design)
        # a lone fibrelet, or a line of them, says nothing of some slope: it stays where it is
        curvature = curvature + 1e-9 * np.trace(curvature) * np.eye(3)
        step = np.linalg.solve(curvature, 2 * design.T @ left.imag)
        state = state + step
        if np.abs(step).max() < 1e-10:
            break
    return state, np.linalg.inv(curvature)


def _coarse(products: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Piston and slopes from the brightest place of the products' Fourier transform over the facet."""
    cells = int(np.ceil(2 * np.sqrt(len(place)))) + 1
    low, high = place.min(0), place.max(0)
    step = max(float((high - low).max()), 1e-12) / cells
    at = np.rint((place - low) / step).astype(int)
    grid = np.zeros((4 * cells, 4 * cells), complex)
    np.add.at(grid, tuple(at.T), products)
    spectrum = np.fft.fft2(grid)
    best = np.unravel_index(np.argmax(np.abs(spectrum)), spectrum.shape)
    slopes = 2 * np.pi * np.fft.fftfreq(4 * cells)[list(best)] / step
    piston = np.angle(np.sum(products * np.exp(-1j * place @ slopes)))
    return np.array([piston, *slopes])


class _Walk(NamedTuple):
    """Measurements in units in which slopes are of the order of the piston."""

    times: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    rates: np.ndarray  # (3,)
    unit: np.ndarray  # (3,) of the states


def _scaled(drift: Drift) -> _Walk:
    mean = np.concatenate([drift.piston[:, None], drift.tilt], axis=1)
    deviation = np.sqrt(np.diagonal(drift.covariance, axis1=1, axis2=2).mean(0))
    unit = np.where(deviation > 0, deviation, 1.0)
    rates = drift.rates[[0, 1, 1]] / unit**2
    return _Walk(drift.times, mean / unit, drift.covariance / np.outer(unit, unit), rates, unit)


def _updated(
    mean: np.ndarray, spread: np.ndarray, measured: np.ndarray, noise: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's update of a state (3,) and its covariance by a measurement of all of it; in Joseph's form, in which the
    covariance stays one. ``inverse`` is that of ``spread + noise``."""
    gain = spread @ inverse
    rest = np.eye(3) - gain
    return mean + gain @ (measured - mean), rest @ spread @ rest.T + gain @ noise @ gain.T


def _smooth(walk: _Walk, wanted: np.ndarray) -> States:
    """Kalman filter and smoother over the references' times and the wanted ones."""
    times = np.unique(np.concatenate([walk.times, wanted]))
    measured = {float(t): k for k, t in enumerate(walk.times)}
    prior = np.eye(3) * 1e10  # nothing is known before; more would drown the rest in rounding
    mean, spread = np.zeros(3), prior
    filtered, predicted, steps = [], [], np.diff(times, prepend=times[0])
    for time, step in zip(times, steps, strict=True):
        spread = spread + np.diag(walk.rates * step)
        predicted.append((mean, spread))
        if (k := measured.get(float(time))) is not None:
            inverse = np.linalg.pinv(spread + walk.covariance[k], hermitian=True)
            mean, spread = _updated(mean, spread, walk.mean[k], walk.covariance[k], inverse)
        filtered.append((mean, spread))
    result = [filtered[-1]]
    for k in range(len(times) - 2, -1, -1):
        (mean, spread), (ahead, ahead_spread) = filtered[k], predicted[k + 1]
        gain = spread @ np.linalg.pinv(ahead_spread, hermitian=True)  # what is known exactly has no spread
        later, later_spread = result[-1]
        rest = np.eye(3) - gain
        walked = np.diag(walk.rates * steps[k + 1])
        # Joseph's form: the difference of two large covariances would lose the small one
        covariance = rest @ spread @ rest.T + gain @ (later_spread + walked) @ gain.T
        result.append((mean + gain @ (later - ahead), covariance))
    result.reverse()
    chosen = [result[k] for k in np.searchsorted(times, wanted)]
    return States(
        np.array([m for m, _ in chosen]).reshape(-1, 3) * walk.unit,
        np.array([c for _, c in chosen]).reshape(-1, 3, 3) * np.outer(walk.unit, walk.unit),
    )


def _rates(times: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Rates of piston and tilt (slopes in units of the facet) that make the references most probable."""
    if len(times) < 3:
        return np.zeros(2)

    def cost(logs: np.ndarray) -> float:
        rates = np.exp(logs)[[0, 1, 1]]
        state, spread, total = mean[0], covariance[0], 0.0
        for k in range(1, len(times)):
            spread = spread + np.diag(rates * (times[k] - times[k - 1]))
            whole = spread + covariance[k]
            left = mean[k] - state
            inverse = np.linalg.inv(whole)
            total += float(left @ inverse @ left + np.linalg.slogdet(whole)[1])
            state, spread = _updated(state, spread, mean[k], covariance[k], inverse)
        return total

    steps = np.diff(mean, axis=0) ** 2 / np.diff(times)[:, None]
    guess = np.array([steps[:, 0].mean(), steps[:, 1:].mean()]) + 1e-30
    found = scipy.optimize.minimize(cost, np.log(guess), method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3})
    rates = np.exp(found.x)
    noise = np.diagonal(covariance, axis1=1, axis2=2).mean(0)[:2]
    # a walk far below the noise of one reference over the whole run: none was seen
    return np.where(rates * np.ptp(times) < 1e-6 * noise, 0.0, rates)
