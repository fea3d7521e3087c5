"""Has a calibration gone stale, and what a few probes make of it.

In: an :class:`fibre.Inverse` and a few new captures of known inputs. Out: a test and a measure of the change; an
inverse of old captures and probes together, each with the weight that it still deserves. Called by users between
recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.stats

from fibre.calibration import columns, response_covariance, usual_response
from fibre.coupling import coupling_profile
from fibre.records import CalibrationFields, Inverse
from fibre.recovery.base import RecoveryMethod, recover
from fibre.recovery.denoise import basis_pursuit_denoise
from fibre.recovery.forward_inverse import ForwardInverse
from polinfer.checks import complex_array, one_of_types, real_number
from polinfer.storage import array

__all__ = ["Staleness", "refresh", "staleness", "update_matrix"]

FOLDS = 5  # of the probes, in turn predicted from the others
OUT = 0.01  # of the probes' noise: light of single points that may be left out
SPARSE = 3.0  # of the mean modulus: what the weights of the pursuit add to the old one


@dataclass(frozen=True)
class Staleness:
    """piston: (captures,) radians, by which the probes are turned against the calibration. change: relative root mean
    square change of A that explains them best, beyond the pistons. probability: that by noise a calibration that still
    holds speaks as strongly for a change; 1 where nothing speaks for one."""

    piston: np.ndarray = array(("capture",), "rad")
    change: float = 0.0
    probability: float = 1.0


@dataclass(frozen=True)
class _Comparison:
    """Probes against what the calibration says of them, fibrelet by fibrelet (k of the 2 m).

    left: (k, c), whitened below. covariance: (k, c, c), of noise and of what the calibration does not know. response:
    (k, c, c), what a relative change of 1 adds. piston: (c,).
    """

    left: np.ndarray
    covariance: np.ndarray
    response: np.ndarray
    piston: np.ndarray

    def cost(self, square: float) -> float:
        """Twice the negative log likelihood of a squared relative change."""
        factor = np.linalg.cholesky(self.covariance + square * self.response)
        white = np.linalg.solve(factor, self.left[..., None])[..., 0]
        logs = np.log(np.abs(np.diagonal(factor, axis1=1, axis2=2)))
        return float(2 * (np.abs(white) ** 2).sum() + 4 * logs.sum())


def _compare(inverse: Inverse, probes: CalibrationFields) -> _Comparison:
    one_of_types("inverse", inverse, (Inverse,), "make it with recover().")
    one_of_types("probes", probes, (CalibrationFields,), "make them with retrieve_fields(calibration).")
    old = inverse.calibration
    for name, a, b in (
        ("fibrelets", old.fibrelets.centres, probes.fibrelets.centres), ("points", old.points, probes.points)
    ):  # fmt: skip
        if not np.array_equal(a, b):
            raise ValueError(f"probes must have the {name} of the inverse's calibration; retrieve them with those.")
    inputs = probes.inputs.toarray()
    fraction = _fraction(old, inputs, probes.variance)
    # before the columns, which are made of the same roots
    covariances = response_covariance(old, inputs, fraction)
    known = columns(old, fraction)
    used = np.flatnonzero(np.diff(known.values.indptr) > 0)
    count = len(probes.fields)
    expected = (known.values @ inputs)[used].T
    seen, noise = probes.fields.reshape(count, -1)[:, used], probes.variance.reshape(count, -1)[:, used]
    piston = np.angle(np.sum(expected.conj() * seen / noise, axis=1))
    left = seen * np.exp(-1j * piston)[:, None] - expected
    # errors of A are in the expected fields, for all probes the same ones
    unknown = covariances[used].swapaxes(1, 2)
    covariance = unknown + noise.T[..., None] * np.eye(count)
    usual = usual_response(old, inputs, fraction)[used].swapaxes(1, 2)
    return _Comparison(left.T, covariance, usual, piston)


def _fraction(old: CalibrationFields, inputs: np.ndarray, variance: np.ndarray) -> float:
    """How faint, of the coupling's peak, points may be that are left out: unaccounted light looks like a change."""
    lit = np.abs(inputs[inputs != 0])
    light = float((lit**2).mean()) if lit.size else 1.0
    finest = OUT * float(np.median(variance)) / (float(coupling_profile(old).power[0]) * light)
    return float(np.clip(finest, 1e-12, 1e-5))


def _change(comparison: _Comparison) -> tuple[float, float]:
    """The most probable squared relative change, and twice by how much it is more probable (logarithm) than none."""
    found = scipy.optimize.minimize_scalar(
        lambda log: comparison.cost(np.exp(log)), bounds=(np.log(1e-8), np.log(4.0)), method="bounded"
    )
    lead = comparison.cost(0.0) - float(found.fun)
    return (float(np.exp(found.x)), lead) if lead > 0 else (0.0, 0.0)


def staleness(inverse: Inverse, probes: CalibrationFields) -> Staleness:
    r"""Do new captures of known inputs still agree with the calibration behind ``inverse``?

    The columns :math:`\hat A` and their covariance say what the probes should be, but for a piston of each. The change
    is the most probable one for :math:`A_{new} = A + D` with independent

    .. math:: D_{kj} \sim CN(0, \epsilon^2 \tau^2(d_{kj}))

    in units of the calibration's own mean response :math:`\tau^2` to a point at that distance; its likelihood against
    that of no change is the test (half a chi-square of one degree of freedom, as :math:`\epsilon^2 \ge 0`). The stated
    covariance of columns is a little too large, so that false alarms are rarer than the probability says, as long as
    the noise is 1.5 % of the mean field or more. With less, what the calibration does not know of A matters, whose
    spread is taken from the distance alone: at 1 % a probability of 0.05 has come up in 12 % of the calibrations that
    still held, at 0.6 % in half of them; the change is measured nonetheless.

    ``probes``: fields of a few captures (random phases at many points tell most), in the fibrelets and points of the
    calibration. Their reference is taken off them as off the calibration's.

    Raises
    ------
    TypeError: other records. ValueError: fibrelets or points of another calibration.

    Source: likelihood ratio of a variance component, Self and Liang (1987).
    """
    comparison = _compare(inverse, probes)
    square, lead = _change(comparison)
    probability = 0.5 * float(scipy.stats.chi2.sf(lead, 1)) if lead > 0 else 1.0
    return Staleness(comparison.piston, float(np.sqrt(square)), probability)


def refresh(inverse: Inverse, probes: CalibrationFields, method: RecoveryMethod | None = None) -> Inverse:
    r"""An inverse from the old calibration and the probes together.

    Old captures stay as the prior: their variance grows by what the change of :func:`staleness` makes of their inputs,
    :math:`\tfrac n2 \epsilon^2 \sum_j |x_{jc}|^2 \tau^2_{kj}` (n captures determine the two columns of a point, and err
    alike). Probes, their pistons taken out, are added as captures with their own variance. ``method`` recovers from
    both; None: ``ForwardInverse()``, which sets its own weights from variances.

    Raises as :func:`staleness`.
    """
    comparison = _compare(inverse, probes)
    (square, _), old = _change(comparison), inverse.calibration
    inputs = old.inputs.toarray()
    count = len(old.points)
    times = float(np.median(np.count_nonzero(np.abs(inputs[:count]) + np.abs(inputs[count:]), axis=1)))
    usual = np.stack([usual_response(old, column[:, None])[:, 0, 0].real for column in inputs.T])
    stale = old.variance + max(times / 2, 1.0) * square * usual.reshape(old.variance.shape)
    turned = probes.fields * np.exp(-1j * comparison.piston)[:, None, None]
    both = replace(
        old,
        fields=np.concatenate([old.fields, turned]),
        variance=np.concatenate([stale, probes.variance]),
        inputs=scipy.sparse.csr_array(scipy.sparse.hstack([old.inputs, probes.inputs])),
        status=None,
    )
    return recover(both, ForwardInverse() if method is None else method)


def update_matrix(old: Any, inputs: Any, outputs: Any, noise: float) -> np.ndarray:
    r"""A dense transmission matrix from an old one and a few new measurements, Y = A X + noise.

    With the factor :math:`\alpha` that fits best, :math:`A = \alpha A_{old} + D`. Two ideas of D, of which the one is
    taken that predicts probes better that are left out in turn: Gaussian, with variances :math:`t_1 |A_{old}|^2` and
    :math:`t_2` of the row's mean of it, both by maximum likelihood (small changes all over); sparse, by
    :func:`fibre.basis_pursuit_denoise` with less weight where the old matrix is strong (the old one no longer holds).

    Parameters
    ----------
    old: complex (m, n). inputs: X, (n, c). outputs: Y, (m, c). noise: standard deviation of its complex elements, > 0.

    Returns
    -------
    complex (m, n).

    >>> rng = np.random.default_rng(0)
    >>> cn = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    >>> old, x = cn(10, 20), cn(20, 8)
    >>> true = old + 0.1 * cn(10, 20)
    >>> new = update_matrix(old, x, true @ x, 1e-3)
    >>> bool(np.linalg.norm(new - true) < 0.85 * np.linalg.norm(old - true))
    True
    """
    old = complex_array("old", old, shape=(None, None), finite=True)
    inputs = complex_array("inputs", inputs, shape=(old.shape[1], None), finite=True)
    outputs = complex_array("outputs", outputs, shape=(old.shape[0], inputs.shape[1]), finite=True)
    noise = real_number("noise", noise, above=0)
    count = inputs.shape[1]
    ways = (_gaussian, _sparse)
    misses = np.zeros(len(ways))
    folds = np.arange(count) % min(FOLDS, count)
    for fold in range(folds.max() + 1) if count > 1 else ():
        kept, out = folds != fold, folds == fold
        for k, way in enumerate(ways):
            found = way(old, inputs[:, kept], outputs[:, kept], noise)
            misses[k] += float((np.abs(outputs[:, out] - found @ inputs[:, out]) ** 2).sum())
    return ways[int(np.argmin(misses))](old, inputs, outputs, noise)


def _left(old: np.ndarray, inputs: np.ndarray, outputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The old matrix scaled, and what it leaves over of the outputs."""
    expected = old @ inputs
    scaled = old * np.vdot(expected, outputs) / max(float(np.vdot(expected, expected).real), 1e-300)
    return scaled, outputs - scaled @ inputs


def _gaussian(old: np.ndarray, inputs: np.ndarray, outputs: np.ndarray, noise: float) -> np.ndarray:
    scaled, left = _left(old, inputs, outputs)
    own = np.abs(scaled) ** 2
    mean = np.broadcast_to(own.mean(1, keepdims=True), own.shape)
    # X^H S X of every row for S = |A|^2, and for its mean
    bends = [np.einsum("jc,kj,jd->kcd", inputs.conj(), part, inputs) for part in (own, mean)]
    unit = noise**2 * np.eye(inputs.shape[1])

    def cost(logs: np.ndarray) -> float:
        factor = np.linalg.cholesky((np.exp(logs[0]) * bends[0] + np.exp(logs[1]) * bends[1] + unit).swapaxes(1, 2))
        white = np.linalg.solve(factor, left[..., None])[..., 0]
        return float((np.abs(white) ** 2).sum() + 2 * np.log(np.abs(np.diagonal(factor, axis1=1, axis2=2))).sum())

    first, second = np.exp(
        scipy.optimize.minimize(
            cost, np.log([1e-2, 1e-2]), method="Nelder-Mead", options={"xatol": 0.05, "fatol": 1.0}
        ).x
    )
    system = (first * bends[0] + second * bends[1] + unit).swapaxes(1, 2)
    solved = np.linalg.solve(system, left[..., None])[..., 0]
    return np.asarray(scaled + (first * own + second * mean) * (solved @ inputs.conj().T))


def _sparse(old: np.ndarray, inputs: np.ndarray, outputs: np.ndarray, noise: float) -> np.ndarray:
    scaled, left = _left(old, inputs, outputs)
    size = np.abs(old)
    weights = 1 / (size / np.maximum(size.mean(1, keepdims=True), 1e-300) + SPARSE)
    delta = noise * np.sqrt(inputs.shape[1])
    rows = basis_pursuit_denoise(inputs.T, left.T, delta, weights=weights.T, iterations=1000).x.T
    return np.asarray(scaled + rows)
