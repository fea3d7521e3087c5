"""Rows of a matrix from intensities alone: a spectral start, variational Bayes, approximate message passing.

In: known inputs, the intensities that they made, their variance, what is expected of the rows. Out: rows up to a phase
of each, with a status. Called by :class:`fibre.IntensityOnly` and by users.
"""

from __future__ import annotations

import enum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import scipy.special

from polinfer.checks import as_generator, complex_array, integer, real_array

__all__ = ["Algorithm", "RowStatus", "Rows", "rows_from_intensities"]

Algorithm = Literal["variational", "message_passing", "spectral"]

CHUNK = 32  # rows at a time
STAGE = 20  # iterations, at most, at one level of noise
SETTLED = 1e-3  # relative change of a row by an iteration below which the rest is left to Gauss-Newton steps
POLISH = 12  # of these, at most
FAINT = 1e-12  # of the prior's variance: nothing
COOL = 0.6  # factor of the noise from stage to stage, at least
DAMPING = (0.3, 0.15)  # share of the new message, from try to try
WARM = 50  # iterations of message passing in which the misfit counts as noise
MISFIT = 2.0  # of the reduced chi-square beyond which a row is flagged


class RowStatus(enum.IntFlag):
    """What to know about a row; flags add up."""

    OK = 0
    NOT_CONVERGED = 1  # it still moved when the iterations were over
    MISFIT = 2  # it does not explain its intensities within their noise: a local optimum, or a model that is wrong
    UNDETERMINED = 4  # fewer intensities than real unknowns, and nothing says that most of these are 0


class Rows(NamedTuple):
    """values: complex (m, n), a phase of each row free. variance: (m, n), E|error|^2 apart from that phase: by the
    curvature (variational), as the messages have it (message passing), or the prior's (spectral). chi_square: (m,),
    misfit of the intensities per degree of freedom. status: (m,) :class:`RowStatus`."""

    values: np.ndarray
    variance: np.ndarray
    chi_square: np.ndarray
    status: np.ndarray


def rows_from_intensities(
    inputs: Any,
    intensities: Any,
    variance: Any,
    prior: Any = None,
    algorithm: Algorithm = "variational",
    iterations: int = 400,
    starts: int = 8,
    rng: int | np.random.Generator = 0,
) -> Rows:
    r"""Find a from :math:`I_c = |a\, x_c|^2 + noise`, for every row of intensities by itself.

    All algorithms take the amplitude :math:`\sqrt{I_c} = |a x_c + n_c|` with complex Gaussian n, whose radial part has
    the amplitude's noise, and elements :math:`a_j \sim CN(0, \tau_j^2)`.

    ``spectral``: the leading eigenvector of :math:`\sum_c T(I_c)\, x_c^* x_c^T` in the whitened inputs, with the
    weight :math:`T = (i-1)/(i+\sqrt{\delta}-1)` of the relative intensities i at :math:`\delta` measurements an
    unknown. It is the start of the others.

    ``variational``: the mean-field approximation :math:`q(a)\, q(\theta)` with the unknown phases :math:`\theta_c` of
    the fields :math:`z_c = \mu x_c`,

    .. math:: q(a) = CN(\mu, \Sigma), \quad \Sigma = (T^{-1} + X^* N^{-1} X^T)^{-1}, \quad
              \mu = \Sigma X^* N^{-1} \bar y, \quad
              \bar y_c = \sqrt{I_c}\, R\!\left(\tfrac{2 \sqrt{I_c} |z_c|}{N_c}\right) \frac{z_c}{|z_c|},

    R = I_1/I_0, with the noise falling from that of the first misfit to the stated one. In the end Gauss-Newton steps
    on the intensities with their own noise, and the variance from their curvature.

    ``message_passing``: generalised approximate message passing with the same measurements and sparse rows: a share
    :math:`\rho` of the elements is :math:`CN(0, \theta\tau_j^2)`, the others are 0, with :math:`\rho` and
    :math:`\theta` found along. For inputs that are nearly independent random numbers, and for fewer measurements.

    Parameters
    ----------
    inputs: complex (n, c), or (m, n, c) where every row has its own. intensities: (m, c). variance: (m, c) or one
    number, of the intensities, > 0; infinite where one is missing. prior: :math:`\tau^2`, (m, n) or (n,), >= 0, of
    which the ratios count, as the level follows from the intensities; None: all alike. iterations: most, of a start,
    >= 1. starts: how often a row is tried that does not explain its intensities, from random rows after the first time,
    >= 1. rng: for those.

    Raises
    ------
    ValueError: shapes, numbers out of range, an unknown algorithm; fewer intensities than unknowns are no error, but
    seldom enough.

    Source: Dremeau, Krzakala, EUSIPCO (2015), for the variational approximation; Schniter, Rangan, IEEE Trans. Signal
    Process. 63, 1043 (2015), for message passing; Mondelli, Montanari, Found. Comput. Math. 19, 703 (2019), for T.

    >>> from fibre import rows_from_intensities
    >>> rng = np.random.default_rng(0)
    >>> cn = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    >>> x, a = cn(8, 64), cn(2, 8)
    >>> intensity = abs(a @ x) ** 2
    >>> found = rows_from_intensities(x, intensity, (1e-3 * intensity.mean()) ** 2)
    >>> unit = [rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (found.values, a)]
    >>> bool((abs((unit[0].conj() * unit[1]).sum(1)) > 0.999).all()), found.status.tolist()
    (True, [0, 0])
    """
    if algorithm not in get_args(Algorithm):
        raise ValueError(f"algorithm must be one of {get_args(Algorithm)}, got {algorithm!r}.")
    iterations, starts = integer("iterations", iterations, low=1), integer("starts", starts, low=1)
    generator, _ = as_generator(rng)
    seen = real_array("intensities", intensities, shape=(None, None), finite=True).astype(float)
    m, count = seen.shape
    given = np.asarray(inputs)
    shape = (None, count) if given.ndim == 2 else (m, None, count)
    x = complex_array("inputs", given, shape=shape, finite=True).astype(complex)
    n = x.shape[-2]
    spread = np.broadcast_to(np.asarray(variance, float), (m, count)) if np.ndim(variance) == 0 else variance
    spread = real_array("variance", spread, shape=(m, count), above=0).astype(float)
    tau = real_array("prior", np.ones(n) if prior is None else prior, low=0, finite=True).astype(float)
    if tau.shape not in ((n,), (m, n)):
        raise ValueError(f"prior must have shape ({n},) or ({m}, {n}), got {tau.shape}.")
    tau = np.broadcast_to(tau, (m, n))
    parts = []
    for start in range(0, m, CHUNK):
        rows = slice(start, min(start + CHUNK, m))
        problem = _Problem.of(x if x.ndim == 2 else x[rows], seen[rows], spread[rows], tau[rows])
        parts.append(problem.solve(algorithm, iterations, starts, generator))
    return Rows(*(np.concatenate([getattr(p, f) for p in parts]) for f in Rows._fields))


class _Problem(NamedTuple):
    """Rows whose elements have unit variance a priori, and whose amplitudes have unit mean square.

    x: (1 or k, c, n), conj(x) of it is what sums over captures need. amplitude, noise: (k, c); noise of the complex
    field, infinite where nothing was seen. root: (k, n), back to the rows' own unit, and ``size`` (k, 1) too.
    """

    x: np.ndarray
    amplitude: np.ndarray
    noise: np.ndarray
    intensity: np.ndarray
    spread: np.ndarray
    root: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray, seen: np.ndarray, spread: np.ndarray, tau: np.ndarray) -> _Problem:
        usable = np.isfinite(spread)
        number = np.maximum(usable.sum(1, keepdims=True), 1)
        size = np.sqrt(np.maximum((np.where(usable, seen, 0).sum(1, keepdims=True)) / number, 1e-300))
        root = np.sqrt(tau)
        moved = np.swapaxes(x if x.ndim == 3 else x[None], 1, 2) * root[:, None, :]
        intensity, spread = seen / size**2, spread / size**4
        amplitude = np.sqrt(np.maximum(intensity, 0))
        # radial noise of |z + n| is half of E|n|^2; near zero the intensity's noise is what moves the amplitude
        noise = np.where(usable, spread, np.inf) / (2 * np.maximum(intensity, np.sqrt(np.where(usable, spread, 1))))
        # the prior's own scale: rows times inputs have unit mean square
        power = np.where(usable, (np.abs(moved) ** 2).sum(2), 0).sum(1, keepdims=True) / number
        scale = np.sqrt(np.maximum(power, 1e-300))
        return cls(
            moved / scale[..., None], np.where(usable, amplitude, 0), noise, intensity, spread, root / scale, size
        )

    def forward(self, rows: np.ndarray) -> np.ndarray:
        """Fields (k, c) of rows (k, n)."""
        return (self.x @ rows[..., None])[..., 0]

    def backward(self, fields: np.ndarray) -> np.ndarray:
        """Adjoint: (k, n) of (k, c)."""
        return (self.x.swapaxes(1, 2) @ fields.conj()[..., None])[..., 0].conj()

    def some(self, rows: np.ndarray) -> _Problem:
        """Some of the rows."""
        return _Problem(self.x if len(self.x) == 1 else self.x[rows], *(part[rows] for part in self[1:]))

    def solve(self, algorithm: Algorithm, iterations: int, starts: int, generator: np.random.Generator) -> Rows:
        """Rows in their own unit, the best of some starts."""
        rows = self.spectral()
        if algorithm == "spectral":
            found = _Found(rows, np.ones(rows.shape), np.zeros(len(rows), bool), np.sum(self.root > 0, axis=1))
        else:
            found = self.tried(algorithm, rows, iterations, 0)
        chi_square = self.chi_square(found)
        for number in range(1, starts if algorithm != "spectral" else 1):
            again = np.flatnonzero(chi_square > MISFIT)
            if len(again) == 0:
                break
            part = self.some(again)
            shape = (len(again), rows.shape[1])
            drawn = np.where(part.root > 0, generator.standard_normal(shape) + 1j * generator.standard_normal(shape), 0)
            other = part.tried(algorithm, part.scaled(drawn), iterations, number)
            now = part.chi_square(other)
            better = now < chi_square[again]
            chosen = again[better]
            for kept, new in zip(found, other, strict=True):
                kept[chosen] = new[better]
            chi_square[chosen] = now[better]
        status = np.where(found.moving, RowStatus.NOT_CONVERGED, 0)
        status |= np.where(chi_square > MISFIT, RowStatus.MISFIT, 0)
        few = np.isfinite(self.spread).sum(1) < 2 * np.sum(self.root > 0, axis=1) - 1
        status |= np.where(few & (algorithm != "message_passing"), RowStatus.UNDETERMINED, 0)
        factor = self.root * self.size
        return Rows(found.rows * factor, found.variance * factor**2, chi_square, status.astype(np.uint8))

    def tried(self, algorithm: Algorithm, rows: np.ndarray, iterations: int, number: int) -> _Found:
        """From a start; ``number`` counts them."""
        if algorithm == "variational":
            return self.variational(rows, iterations)
        return self.message_passing(rows, iterations, DAMPING[number % len(DAMPING)])

    def chi_square(self, found: _Found) -> np.ndarray:
        """Misfit of the intensities per degree of freedom, (k,)."""
        usable = np.isfinite(self.spread)
        left = (np.abs(self.forward(found.rows)) ** 2 - self.intensity) ** 2
        misfit = np.where(usable, left / self.spread, 0).sum(1)
        return np.asarray(misfit / np.maximum(usable.sum(1) - 2 * found.unknowns + 1, 1))

    def scaled(self, rows: np.ndarray) -> np.ndarray:
        """Rows of the length that the amplitudes ask for."""
        fields = np.abs(self.forward(rows))
        power = np.where(np.isfinite(self.noise), fields**2, 0).sum(1)
        return np.asarray(rows * ((self.amplitude * fields).sum(1) / np.maximum(power, 1e-300))[:, None])

    def spectral(self) -> np.ndarray:
        """The leading eigenvector, of the length that the intensities ask for."""
        usable = np.isfinite(self.noise)
        number = np.maximum(usable.sum(1), 1)[:, None]
        gram = np.matmul(self.x.conj().swapaxes(1, 2) * usable[:, None], self.x) / number[..., None]
        values, vectors = np.linalg.eigh(gram)
        kept = values > 1e-6 * values[:, -1:]
        white = vectors * np.where(kept, 1 / np.sqrt(np.maximum(values, 1e-300)), 0)[:, None]
        unknowns = np.maximum(kept.sum(1), 1)[:, None]
        inputs = self.x @ white
        relative = self.amplitude**2 * unknowns / np.maximum((np.abs(inputs) ** 2).sum(2), 1e-300)
        relative = relative * number / np.maximum((relative * usable).sum(1, keepdims=True), 1e-300)
        excess = np.sqrt(np.maximum(number / unknowns, 1.0))
        weight = np.where(usable, (relative - 1) / (relative + excess - 1 + 1e-3), 0)
        matrix = np.matmul(inputs.conj().swapaxes(1, 2) * weight[:, None], inputs)
        leading = np.linalg.eigh(matrix)[1][..., -1]
        return self.scaled(np.where(self.root > 0, (white @ leading[..., None])[..., 0], 0))

    def misfit(self, rows: np.ndarray) -> np.ndarray:
        """Mean squared error of the amplitudes as noise of the complex field, (k,)."""
        usable = np.isfinite(self.noise)
        left = np.where(usable, (np.abs(self.forward(rows)) - self.amplitude) ** 2, 0)
        return np.asarray(2 * left.sum(1) / np.maximum(usable.sum(1), 1))

    def variational(self, rows: np.ndarray, iterations: int) -> _Found:
        """Phases of the fields and rows in turn, while the noise falls to the stated one."""
        usable = np.isfinite(self.noise)
        unit = np.eye(rows.shape[1])
        typical = np.nanmedian(np.where(usable, self.noise, np.nan), axis=1)
        extra, spent = self.misfit(rows), 0
        while True:
            weight = np.where(usable, 1 / (self.noise + extra[:, None]), 0)
            inverse = np.linalg.inv(np.matmul(self.x.conj().swapaxes(1, 2) * weight[:, None], self.x) + unit)
            last = not np.any(extra)
            for _ in range(max(iterations - spent, 1) if last else STAGE):
                before, z = rows, self.forward(rows)
                size = np.abs(z)
                mean = _bessel_ratio(2 * self.amplitude * size * weight) * self.amplitude
                rows = (inverse @ self.backward(weight * mean * z / np.maximum(size, 1e-300))[..., None])[..., 0]
                change = np.linalg.norm(rows - before, axis=1) / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
                spent += 1
                if np.all(change < (SETTLED if last else 1e-2)):
                    break
            if last:
                return self.polished(rows, change > SETTLED)
            extra = np.minimum(COOL * extra, self.misfit(rows))
            extra = np.where((extra < 0.1 * typical) | (spent > 0.7 * iterations), 0, extra)

    def polished(self, rows: np.ndarray, moving: np.ndarray) -> _Found:
        r"""Gauss-Newton steps of the intensities' own likelihood, and its curvature.

        :math:`\delta I_c = 2\,\mathrm{Re}(z_c^* \, x_c \delta a)`; the row's phase, which changes nothing, is held.
        """
        usable = np.isfinite(self.spread)
        weight = np.where(usable, 1 / np.where(usable, self.spread, 1), 0)
        n = rows.shape[1]

        def cost(rows: np.ndarray) -> np.ndarray:
            left = self.intensity - np.abs(self.forward(rows)) ** 2
            return np.asarray((weight * left**2).sum(1) + 2 * (np.abs(rows) ** 2).sum(1))

        now, moves = cost(rows), True
        for number in range(POLISH + 1):
            z = self.forward(rows)
            slope = z.conj()[..., None] * self.x
            slope = np.concatenate([2 * slope.real, -2 * slope.imag], axis=2)
            both = np.concatenate([rows.real, rows.imag], axis=1)
            around = np.concatenate([-rows.imag, rows.real], axis=1)
            around = around / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-300)
            system = np.matmul(slope.swapaxes(1, 2) * weight[:, None], slope) + 2 * np.eye(2 * n)
            stiff = np.einsum("kii->ki", system).max(1)[:, None, None]
            system = system + stiff * around[:, :, None] * around[:, None, :]
            covariance = np.linalg.inv(system)
            if number == POLISH or not moves:
                break
            left = weight * (self.intensity - np.abs(z) ** 2)
            gradient = (slope.swapaxes(1, 2) @ left[..., None])[..., 0] - 2 * both
            step = (covariance @ gradient[..., None])[..., 0]
            new = rows + step[:, :n] + 1j * step[:, n:]
            then = cost(new)
            better = then < now
            moves = bool(np.any(better & (np.linalg.norm(step, axis=1) > 1e-9 * np.linalg.norm(both, axis=1))))
            rows, now = np.where(better[:, None], new, rows), np.where(better, then, now)
        spread = np.einsum("kii->ki", covariance)
        variance = np.maximum(spread[:, :n] + spread[:, n:], 0)
        return _Found(rows, variance, moving, (1 - np.minimum(variance, 1)).sum(1))

    def message_passing(self, rows: np.ndarray, iterations: int, damping: float) -> _Found:
        """Messages between intensities and elements, each mean and variance; the state that misfits least."""
        known = self.root > 0
        power = np.abs(self.x) ** 2
        count = np.maximum(known.sum(1, keepdims=True), 1)
        energy = np.maximum((np.abs(rows) ** 2).sum(1, keepdims=True) / count, FAINT)
        share, theta = np.full((len(rows), 1), 0.5), 2 * energy
        mean, spread = rows, energy * known
        p, tau_p = self.forward(mean), np.maximum((power @ spread[..., None])[..., 0], FAINT)
        message = np.zeros(self.amplitude.shape, complex)
        best, least, unknowns = rows.copy(), self.misfit(rows), count[:, 0].astype(float)
        change = np.ones(len(rows))
        for number in range(iterations):
            noise = self.noise + (self.misfit(mean)[:, None] if number < WARM else 0.0)
            z, tau_z = self.field(p, tau_p, noise)
            keep = 1 - damping if number else 0.0
            message = keep * message + (1 - keep) * (z - p) / tau_p
            tau_s = np.maximum((1 - tau_z / tau_p) / tau_p, FAINT)
            tau_r = 1 / np.maximum((np.swapaxes(power, 1, 2) @ tau_s[..., None])[..., 0], 1e-300)
            new, spread_new, active = _sparse_mean(mean + tau_r * self.backward(message), tau_r, share, theta)
            new, spread_new, active = (np.where(known, part, 0) for part in (new, spread_new, active))
            before, mean = mean, (1 - damping) * mean + damping * new
            spread = (1 - damping) * spread + damping * spread_new
            if number > 5:
                share = np.clip(active.sum(1, keepdims=True) / count, 1e-3, 1 - 1e-6)
                second = (np.abs(new) ** 2 + spread_new).sum(1, keepdims=True)
                theta = np.maximum(second / (share * count), FAINT)
            tau_p = np.maximum((power @ spread[..., None])[..., 0], FAINT)
            p = self.forward(mean) - tau_p * message
            now = self.misfit(mean)
            better = now < least
            best[better], least[better], unknowns[better] = mean[better], now[better], active.sum(1)[better]
            change = np.linalg.norm(mean - before, axis=1) / np.maximum(np.linalg.norm(mean, axis=1), 1e-300)
            if number > WARM and np.all(change < 1e-6):
                break
        return _Found(best, spread, change > 1e-3, unknowns)

    def field(self, p: np.ndarray, tau: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Posterior mean and variance of fields that are CN(p, tau) before their amplitudes are seen."""
        usable = np.isfinite(noise)
        total = tau + np.where(usable, noise, 1.0)
        seen, rest = tau / total, np.where(usable, noise, 1.0) / total
        size = np.abs(p)
        ratio = _bessel_ratio(2 * self.amplitude * size / total)
        z = seen * self.amplitude * ratio * p / np.maximum(size, 1e-300) + rest * p
        tau_z = np.minimum(tau * rest + (seen * self.amplitude) ** 2 * (1 - ratio**2), tau * (1 - 1e-9))
        return np.where(usable, z, p), np.where(usable, tau_z, tau)


class _Found(NamedTuple):
    """rows, variance: (k, n), in the problem's units. moving: (k,). unknowns: (k,), how many are determined."""

    rows: np.ndarray
    variance: np.ndarray
    moving: np.ndarray
    unknowns: np.ndarray


def _bessel_ratio(kappa: np.ndarray) -> np.ndarray:
    """I_1 / I_0."""
    return np.asarray(scipy.special.i1e(kappa) / scipy.special.i0e(kappa))


def _sparse_mean(
    r: np.ndarray, tau: np.ndarray, share: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, variance and probability of not being 0, of an element seen as r with noise tau."""
    gain = theta / (theta + tau)
    odds = np.log(share / (1 - share)) + np.log(tau / (theta + tau)) + np.abs(r) ** 2 * gain / tau
    active = scipy.special.expit(odds)
    mean = active * gain * r
    second = active * (np.abs(gain * r) ** 2 + gain * tau)
    return mean, np.maximum(second - np.abs(mean) ** 2, 0), active
