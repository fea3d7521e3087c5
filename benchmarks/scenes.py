"""What the benchmarks have in common: truths, illumination states, data, and the error that no estimate undercuts."""

from __future__ import annotations

import numpy as np

import polinfer
from polinfer import ComplexGain, Measurement, Model, Parameters, PhaseGain

# relative to sigma; the smallest step that double precision differentiates well
STEP = 1e-6


def balanced_states(count: int = 3) -> np.ndarray:
    """``(1, e^{2 pi i k / n}) / sqrt 2``, complex (2, n): the sum of u u^H is n/2 times the identity.

    One or two of them are not enough for that; two are the components themselves.
    """
    if count < 3:
        return np.eye(2, dtype=complex)[:, :count]
    return np.stack([np.ones(count), np.exp(2j * np.pi * np.arange(count) / count)]) / np.sqrt(2)


def conditioned_states(condition: float, rng: np.random.Generator) -> np.ndarray:
    """Three states of the same power whose matrix has a condition number, along random axes of the sphere."""
    turn = np.linalg.qr(rng.normal(size=(2, 2)) + 1j * rng.normal(size=(2, 2)))[0]
    stretch = np.array([condition, 1.0]) * np.sqrt(2 / (condition**2 + 1))
    return turn @ (stretch[:, None] * balanced_states(3))


def from_priors(model: Model, count: int, rng: np.random.Generator) -> Parameters:
    """Truths drawn from the priors of a model; 0 where it has none."""
    zero = np.zeros(count)
    return Parameters(*(model.priors[n].sample(rng, (count,)) if n in model.free else zero for n in Parameters._fields))


def well_determined(
    model: Model, count: int, illumination: np.ndarray, sigma: float, rng: np.random.Generator, limit: float = 0.1
) -> Parameters:
    """Truths from the priors, of which only those are kept whose five Cramer-Rao bounds are below a limit."""
    kept = np.zeros((5, 0))
    while kept.shape[1] < count:
        truth = from_priors(model, 4 * count, rng)
        bound = np.max(polinfer.cramer_rao_bound(model, truth, illumination, sigma), axis=0)
        kept = np.concatenate([kept, np.array(truth)[:, bound < limit]], axis=1)
    return Parameters(*kept[:, :count])


def lesion(count: int) -> Parameters:
    """The lesion phantom, of about so many pixels in a row."""
    side = max(round(count**0.5), 1)
    return Parameters(*(x.ravel() for x in polinfer.phantoms.lesion((side, side), rng=1).parameters))


def identical(count: int) -> Parameters:
    """The same in every pixel."""
    return Parameters(*(np.full(count, x) for x in (0.3, 0.5, 1.2, 0.4, 0.2)))


def measure(
    model: Model, truth: Parameters, illumination: np.ndarray, sigma: float, dtype: str = "complex128", rng: int = 0
) -> Measurement:
    """Simulated data in one precision."""
    data = polinfer.simulate(model, truth, illumination, sigma, rng=rng)
    return Measurement(illumination.astype(dtype), data.response.astype(dtype), np.float64(sigma))


def jones(model: Model, parameters: Parameters) -> np.ndarray:
    """Matrices in double precision, complex (pixels, 2, 2)."""
    return np.asarray(model.jones(Parameters(*(np.asarray(x, float) for x in parameters))))


def squared_error(model: Model, found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """``||J_found - J_true||_F^2`` of matrices ``(pixels, 2, 2)`` up to what the model's gain leaves open."""
    if model.gain is None:
        return np.sum(np.abs(found - true) ** 2, axis=(-1, -2))
    overlap = np.sum(found.conj() * true, axis=(-1, -2))
    if isinstance(model.gain, PhaseGain):
        factor = overlap / np.abs(overlap)
    else:
        factor = overlap / np.sum(np.abs(found) ** 2, axis=(-1, -2))
    return np.sum(np.abs(factor[:, None, None] * found - true) ** 2, axis=(-1, -2))


def least_squared_error(model: Model, truth: Parameters, illumination: np.ndarray, sigma: float) -> np.ndarray:
    """The Cramer-Rao bound of :func:`squared_error`, (pixels,), at gain 1: numerical derivatives in plain NumPy."""
    vectors = np.stack([np.asarray(x, float) for x in truth], axis=-1)
    # D = 1 is an edge, the others have none
    steps = np.where(np.arange(5) == 0, -np.sign(vectors + (vectors == 0)), 1) * STEP
    centre = jones(model, truth)
    columns = [
        (jones(model, Parameters(*(vectors + steps * (np.arange(5) == i)).T)) - centre) / steps[:, i, None, None]
        for i in range(5)
        if Parameters._fields[i] in model.free
    ]
    if isinstance(model.gain, (PhaseGain, ComplexGain)):
        columns.append(1j * centre)
    if isinstance(model.gain, ComplexGain):
        columns.append(centre)
    gains = model.known_gain.real_parameters
    elements = np.stack(columns, axis=1)  # (pixels, unknowns, 2, 2)
    seen = elements @ illumination
    flat, data = (np.concatenate([x.real, x.imag], -1).reshape(*x.shape[:2], -1) for x in (elements, seen))
    covariance = np.linalg.pinv(2 / sigma**2 * data @ data.swapaxes(-1, -2), rcond=1e-12, hermitian=True)
    free = flat[:, : flat.shape[1] - gains]
    if gains:  # what a gain can bring about is no error
        axes = flat[:, flat.shape[1] - gains :]
        axes = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
        free = free - (free @ axes.swapaxes(-1, -2)) @ axes
    own = covariance[:, : free.shape[1], : free.shape[1]]
    return np.einsum("nik,nij,njk->n", free, own, free)
