"""The least uncertainty that any unbiased estimate can have (Cramer-Rao)."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .checks import broadcast, complex_array, one_of_types, real_array
from .elements import multiply
from .misalignment import TiltPlane
from .model import Model
from .records import Parameters

__all__ = ["cramer_rao_bound", "tilt_bound"]


@partial(jax.jit, static_argnums=0)
def _jacobian(model: Model, points: jax.Array, illumination: jax.Array) -> jax.Array:
    """Derivatives of the real data by the free parameters, the gain and the tilt's phase, (pixels, data, unknowns)."""
    count = len(model.free)

    def data(x: jax.Array, states: jax.Array) -> jax.Array:
        values = dict.fromkeys(Parameters._fields, jnp.zeros((), x.dtype))
        values |= {name: x[i] for i, name in enumerate(model.free)}
        # T U and T V are the fields in the frame of the tilt
        turn = jnp.stack([jnp.ones((), x.dtype) + 0j, jnp.exp(1j * x[-1])])[:, None]
        field = jnp.conj(turn) * multiply(model.jones(Parameters(**values)), turn * states)
        if model.known_gain.real_parameters == 1:
            field = jnp.exp(1j * x[count]) * field
        elif model.known_gain.real_parameters == 2:
            field = (1 + jax.lax.complex(x[count], x[count + 1])) * field
        return jnp.concatenate([jnp.real(field).ravel(), jnp.imag(field).ravel()])

    return jax.vmap(jax.jacfwd(data))(points, illumination)


class _Information(NamedTuple):
    """Of every pixel: the inverse of its Fisher information as ``axes inverse^2 axes^T sigma^2 / 2``, what the data
    leave open, and the derivatives of the data by the phase in the same terms.

    ``axes`` and ``inverse`` (pixels, directions, unknowns) and (pixels, directions); ``missing`` (pixels, unknowns);
    ``follow`` (pixels, unknowns) is how the unknowns would have to change with the phase, and ``rest`` (pixels) the
    square of what is left of the phase's derivative. In place of D the unknown is delta, D = sin delta.
    """

    shape: tuple[int, ...]
    axes: np.ndarray
    inverse: np.ndarray
    missing: np.ndarray
    follow: np.ndarray
    rest: np.ndarray
    sigma: np.ndarray


def _information(model: Model, parameters: Parameters, illumination: Any, sigma: Any, tilt: Any) -> _Information:
    one_of_types("model", model, (Model,), "pass Model(...).")
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
    values = {n: real_array(f"parameters.{n}", getattr(parameters, n), finite=True) for n in model.free}
    illumination = complex_array("illumination", illumination, trailing=(2, None), finite=True)
    sigma = real_array("sigma", sigma, above=0, finite=True)
    phase = real_array("tilt", 0.0 if tilt is None else tilt, finite=True)
    shape = broadcast(
        **{f"parameters.{name}": x.shape for name, x in values.items()},
        illumination=illumination.shape[:-2],
        sigma=sigma.shape,
        tilt=phase.shape,
    )
    unknowns = len(model.free) + model.known_gain.real_parameters
    points = np.zeros((*shape, unknowns + 1))
    points[..., -1] = phase
    slope = np.ones((*shape, unknowns))
    clipped = np.zeros(shape, bool)
    for i, name in enumerate(model.free):
        points[..., i] = values[name]
        if name == "diattenuation":
            # at |D| = 1 the derivative by D is infinite, by delta (D = sin delta) it is not: just inside it is the same
            inside = 1 - float(jnp.finfo(jnp.result_type(float)).eps) ** 0.5
            points[..., i] = np.clip(points[..., i], -inside, inside)
            clipped = np.broadcast_to(np.abs(values[name]) > inside, shape)
            slope[..., i] = np.sqrt(1 - points[..., i] ** 2)
    states = np.broadcast_to(illumination, (*shape, *illumination.shape[-2:]))
    every = np.asarray(
        _jacobian(model, points.reshape(-1, unknowns + 1), states.reshape(-1, *states.shape[-2:])), float
    )
    slope = slope.reshape(-1, unknowns)
    jacobian, by_phase = every[..., :-1] * slope[:, None, :], every[..., -1]
    left, singular, axes = np.linalg.svd(jacobian, full_matrices=False)
    eps = np.finfo(jnp.result_type(float)).eps
    # numbers of data below those of unknowns leave directions without any singular value
    missing = np.maximum(0.0, 1.0 - np.sum(axes**2, axis=-2))
    # what vanishes like sqrt(1 - |D|) towards |D| = 1 is still eps^(1/4) just inside
    least = np.where(clipped, 10 * eps**0.25, 100 * eps).reshape(-1, 1)
    lost = singular <= least * singular.max(axis=-1, keepdims=True)
    inverse = np.where(lost, 0, 1 / np.where(lost, 1, singular))
    missing = missing + np.sum(axes**2 * lost[..., None], axis=-2)
    # a change of the circularity with the phase leaves the retarder's data as they are: that much is taken out exactly
    if "circularity" in model.free:
        by_phase = by_phase + jacobian[..., model.free.index("circularity")]
    by_phase = np.where(np.abs(by_phase) < 100 * eps * np.sqrt(np.sum(every**2, axis=(-1, -2)))[:, None], 0, by_phase)
    along = np.einsum("pdk,pd->pk", left, by_phase) * ~lost
    follow = -np.einsum("pki,pk->pi", axes, inverse * along)
    if "circularity" in model.free:
        follow[:, model.free.index("circularity")] += 1
    rest = by_phase - np.einsum("pdk,pk->pd", left, along)
    return _Information(
        shape, axes, inverse, missing, follow, np.sum(rest**2, axis=-1),
        np.broadcast_to(sigma, shape).reshape(-1).astype(float),
    )  # fmt: skip


def cramer_rao_bound(
    model: Model, parameters: Parameters, illumination: Any, sigma: Any, tilt: Any = None
) -> Parameters:
    """Standard deviations that no unbiased estimate can undercut, for each parameter.

    The square roots of the diagonal of the inverse Fisher information
    ``F_ij = (2 / sigma^2) Re <d(g J U)/dp_i, d(g J U)/dp_j>``; an unknown gain is part of p, taken at g = 1
    (for another amplitude divide sigma by it). Priors do not enter.

    With a :class:`TiltPlane` the coefficients of the plane are unknowns of the whole frame, and the parameters are
    those of all its pixels (last two axes of P).

    Parameters
    ----------
    model: ordering, gain, misalignment and fixed parameters. parameters: of shape P, radians.
    illumination: complex ``(*P, 2, n)``. sigma: > 0, broadcasts to P.
    tilt: the phase at which the bound is taken, radians, broadcasts to P; None: 0. It matters for unbalanced states.

    Returns
    -------
    Parameters of shape P: radians, 0 for fixed parameters, inf for what the data do not determine.

    Raises
    ------
    ValueError, TypeError: arguments that do not fit together, out of range or not finite.

    >>> truth = Parameters(0.0, 0.0, 1.0, 0.4, 0.2)
    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> bound = cramer_rao_bound(Model(), truth, states, sigma=0.01)
    >>> round(float(bound.diattenuation) / 0.01, 3), float(bound.diattenuation_angle)
    (0.816, inf)
    """
    found = _information(model, parameters, illumination, sigma, tilt)
    shape = found.shape
    std = np.sqrt(0.5 * np.sum((found.axes * found.inverse[..., None]) ** 2, axis=-2)) * found.sigma[:, None]
    std = np.where(found.missing > 1e-6, np.inf, std)
    if isinstance(model.misalignment, TiltPlane):
        spread = _phase_std(model.misalignment, found)[:, None]
        moves = np.abs(found.follow) > 1e-6
        std = np.hypot(std, np.where(moves, np.abs(found.follow), 0) * np.where(moves, spread, 0))
    std = std.reshape(*shape, -1)
    result = {name: np.zeros(shape) for name in model.fixed} | {name: np.full(shape, np.inf) for name in model.dropped}
    result |= {name: std[..., i] for i, name in enumerate(model.free)}
    if "diattenuation" in model.free:
        exact = np.sqrt(1 - np.square(np.broadcast_to(parameters.diattenuation, shape)))
        result["diattenuation"] = result["diattenuation"] * exact
    return Parameters(**result)


def _covariances(plane: TiltPlane, found: _Information) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of the coefficients ``(frames, terms, terms)`` as far as they are determined, and a basis of what is
    not, ``(frames, terms, terms)``, columns of 0 where there is nothing."""
    rows, columns = (1, 1, *found.shape)[-2:]
    basis = plane.basis((rows, columns)).reshape(len(plane.terms), -1)
    weight = (2 * found.rest / found.sigma**2).reshape(-1, rows * columns)
    information = np.einsum("kp,fp,jp->fkj", basis, weight, basis)
    values, axes = np.linalg.eigh(information)
    lost = values <= 1e-9 * np.maximum(np.max(values, axis=-1, keepdims=True), 1e-300)
    inverse = np.where(lost, 0, 1 / np.where(lost, 1, values))
    return (axes * inverse[:, None, :]) @ np.swapaxes(axes, -1, -2), axes * lost[:, None, :]


def _phase_std(plane: TiltPlane, found: _Information) -> np.ndarray:
    """Bound of the phase at every pixel, ``(pixels)``."""
    covariance, lost = _covariances(plane, found)
    basis = plane.basis(found.shape[-2:]).reshape(len(plane.terms), -1)
    variance = np.einsum("kp,fkj,jp->fp", basis, covariance, basis)
    open_ = np.sum(np.einsum("kp,fkj->fjp", basis, lost) ** 2, axis=1)
    return np.asarray(np.where(open_ > 1e-9, np.inf, np.sqrt(variance))).reshape(-1)


def tilt_bound(model: Model, parameters: Parameters, illumination: Any, sigma: Any, tilt: Any = None) -> np.ndarray:
    """Standard deviations that no unbiased estimate of the tilt's coefficients can undercut, ``(*frames, terms)``.

    The inverse Fisher information of the coefficients, the parameters and gains of all pixels unknown too: a sum over
    pixels of what the parameters cannot make up for. Priors do not enter, and without a diattenuation nothing but the
    prior of the circularity tells the tilt: then it is inf.

    Parameters
    ----------
    model: with a :class:`TiltPlane`. Others as in :func:`cramer_rao_bound`; P is a frame, or frames of one.

    Raises
    ------
    ValueError, TypeError: no TiltPlane; as :func:`cramer_rao_bound`.

    >>> states = np.array([[1, 1, 1], np.exp(2j * np.pi * np.arange(3) / 3)]) / 2**0.5
    >>> truth = Parameters(np.full((16, 16), 0.1), 0.6, 2.6, 0.5, 0.0)
    >>> model = Model(misalignment=TiltPlane())
    >>> tilt_bound(model, truth, states, sigma=0.02).round(3).tolist()
    [0.011, 0.038, 0.038]
    >>> tilt_bound(model, truth._replace(diattenuation=np.zeros((16, 16))), states, sigma=0.02).tolist()
    [inf, inf, inf]
    """
    found = _information(model, parameters, illumination, sigma, tilt)
    if not isinstance(model.misalignment, TiltPlane):
        raise ValueError("model has no tilt; pass Model(misalignment=TiltPlane()).")
    covariance, lost = _covariances(model.misalignment, found)
    std = np.sqrt(np.einsum("fkk->fk", covariance))
    std = np.where(np.sum(lost**2, axis=-1) > 1e-9, np.inf, std)
    return np.asarray(std.reshape(*found.shape[:-2], -1))
