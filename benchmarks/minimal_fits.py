"""A fit whose code lacks parts of a scene: what ``benchmarks.parts`` compares ``polinfer.fit`` with.

The blocks, Newton steps and the summary at the maximum are the package's own; what feeds them is written here for three
or more states that all pixels share, balanced, and one sigma. An element that the scene does not have is missing from
the matrix, its derivatives and the closed form, which are replaced while the code is traced.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from math import pi
from typing import Any, NamedTuple, cast
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammainccinv

from polinfer import Fit, Measurement, Model, Parameters, Status
from polinfer.fitting.fast import climb, describe, kernel
from polinfer.fitting.fast import scene as fast
from polinfer.fitting.fast.data import Data, prepare
from polinfer.fitting.fast.engine import Responses
from polinfer.fitting.fast.frame import solve, status_of
from polinfer.fitting.fast.point import Point, dot, polariser_vectors, retarder_vectors, unit
from polinfer.fitting.fast.priors import log_prior
from polinfer.fitting.residuals import BAD_FIT_PROBABILITY


@dataclass(frozen=True)
class Leave:
    """Which parts the compiled code lacks; ``element`` is the only element there is, None: both are there."""

    gain: bool = False
    weights: bool = False
    noise_map: bool = False
    element: str | None = None


class _Misfit(NamedTuple):
    square: Any
    gain: None = None
    energy: None = None
    overlap: None = None


class _Slopes(NamedTuple):
    r: float = 2.0
    m: float = -1.0
    rr: None = None
    rm: None = None
    mm: None = None
    across: None = None


@dataclass(frozen=True)
class NoGain:
    """``-|M - Y|^2``."""

    free_phase = False

    def residual(self, model: Any, data: Any) -> _Misfit:
        """Sum of squares."""
        pairs = [(m, y) for i in (0, 1) for m, y in zip(model[i], data[i], strict=True)]
        return _Misfit(sum((x - a) ** 2 + (y - b) ** 2 for (x, y), (a, b) in pairs))

    def value(self, at: _Misfit) -> Any:
        """Log likelihood without its constant."""
        return -at.square

    def slopes(self, at: _Misfit) -> _Slopes:  # noqa: ARG002
        """Its derivatives by the overlap and the energy."""
        return _Slopes()

    def mean_gain(self, at: _Misfit) -> None:
        """There is none."""


def _vectors(element: str, point: Point) -> tuple[list[Any], dict[tuple[int, ...], list[Any]], tuple[int, ...]]:
    """Components v of the one element, their derivatives (that by the first angle twice is -v), and its angles."""
    retarder = element == "retarder"
    return (*(retarder_vectors(point) if retarder else polariser_vectors(point)), (2, 3, 4) if retarder else (0, 1))


def _components(element: str, k: Any) -> list[Any]:
    """``Re tr(J^H K)`` is the scalar product of these with the element's components."""
    if element == "retarder":
        return [k.one[0], k.z[1], -k.x[1], -k.y[1]]
    return [k.one[0], k.z[0], -k.x[0]]


def _evaluate(element: str, scene: Any, data: Data, point: Point) -> tuple[Any, _Misfit]:
    v = _vectors(element, point)[0]
    if element == "retarder":
        j = [[(v[0], v[1]), (-v[3], -v[2])], [(v[3], -v[2]), (v[0], -v[1])]]
        seen = [[_product(j[i], data.illumination, k) for k in (0, 1)] for i in (0, 1)]
    else:
        a = [[v[0] + v[1], -v[2]], [-v[2], v[0] - v[1]]]
        r = data.illumination
        seen = [[tuple(a[i][0] * r[0][k][p] + a[i][1] * r[1][k][p] for p in (0, 1)) for k in (0, 1)] for i in (0, 1)]
    at = scene.likelihood.residual(seen, data.response)
    value = scene.likelihood.value(at) + data.constant
    return value + (log_prior(scene.prior, point) + scene.constant), at


def _product(row: list[Any], r: list[list[Any]], k: int) -> tuple[Any, Any]:
    pairs = [(row[0], r[0][k]), (row[1], r[1][k])]
    return sum(a[0] * b[0] - a[1] * b[1] for a, b in pairs), sum(a[0] * b[1] + a[1] * b[0] for a, b in pairs)


def _derivatives(element: str, scene: Any, balanced: bool, data: Data, point: Point, at: Any) -> climb.Posterior:  # noqa: ARG001
    assert balanced
    assert scene.likelihood == NoGain()
    v, dv, angles = _vectors(element, point)
    g = _components(element, data.product)
    gradient = {i: 2 * dot(g, dv[i,]) for i in angles}
    hessian = {(angles[0], angles[0]): -2 * dot(g, v)} | {key: 2 * dot(g, x) for key, x in dv.items() if len(key) == 2}
    return climb.Posterior(gradient, hessian)


def _closed_form(element: str, scene: Any, data: Data) -> Point:
    v = _components(element, data.jones)
    known: tuple[Any, ...] = scene.fixed
    if element == "retarder":
        flip = jnp.where(v[2] < 0, -1.0, 1.0).astype(v[0].dtype)
        rho = flip * jnp.sqrt(v[2] * v[2] + v[3] * v[3])
        size = jnp.sqrt(v[1] * v[1] + rho * rho)
        return Point(
            known[0], known[1], unit(jnp.maximum(v[0], 0), size), unit(v[1], rho), unit(flip * v[2], flip * v[3])
        )
    size = jnp.sqrt(v[1] * v[1] + v[2] * v[2])
    return Point(unit(v[0], jnp.minimum(size, 0.999 * v[0])), unit(v[1], v[2]), *known[2:])


@partial(jax.jit, static_argnums=(0, 1, 2))
def _block(
    scene: Any, leave: Leave, noise: float | None, response: Any, sigma: Any, shared: kernel.Shared, start: Any,
    given: Any, iterations: Any, one: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """One block of pixels; ``noise`` is sigma where it is a number of the code."""
    real, imaginary = jnp.real(shared.rows), jnp.imag(shared.rows)
    inverse = 1 / (sigma if noise is None else jnp.asarray(noise, real.dtype))
    states, parts = range(response.shape[-1]), (jnp.real, jnp.imag)
    v = [[tuple(part(response[:, i, k]) * inverse for part in parts) for k in states] for i in (0, 1)]
    y = [
        [
            (
                sum(v[i][k][0] * real[j, k] + v[i][k][1] * imaginary[j, k] for k in states),
                sum(v[i][k][1] * real[j, k] - v[i][k][0] * imaginary[j, k] for k in states),
            )
            for j in (0, 1)
        ]
        for i in (0, 1)
    ]
    residual: Any = 0.0
    for i in (0, 1):
        for k in states:
            re = v[i][k][0] - sum(y[i][j][0] * real[j, k] - y[i][j][1] * imaginary[j, k] for j in (0, 1))
            im = v[i][k][1] - sum(y[i][j][0] * imaginary[j, k] + y[i][j][1] * real[j, k] for j in (0, 1))
            residual = residual + re * re + im * im
    constant = -2 * response.shape[-1] * jnp.log(pi / (inverse * inverse)) - residual
    root = [[(re * inverse, im * inverse) for re, im in row] for row in kernel._parts(shared.root)]
    data = prepare(True, root, y, residual, constant, one)
    with ExitStack() as stack:
        if leave.element is not None:
            stack.enter_context(patch.object(climb, "evaluate", partial(_evaluate, leave.element)))
            stack.enter_context(patch.object(climb, "derivatives", partial(_derivatives, leave.element)))
            stack.enter_context(patch.object(kernel, "closed_form", partial(_closed_form, leave.element)))
        return kernel._finish(scene, True, data, start, given, iterations)


@dataclass(frozen=True)
class Frame(Responses):
    """Pixels with one sigma and states of weight 1, through the code above."""

    leave: Leave = Leave()

    def run(self, scene: Any, take: Any, start: Any, given: bool, iterations: int) -> tuple[Any, Any]:
        """Rows and flags of the pixels ``take``."""
        response, last = self.response[take], (self.shared, start, given, iterations, self.dtype.type(1))
        if not (self.leave.weights or self.leave.noise_map or self.leave.element):
            return kernel.from_responses(scene, True, response, self.sigma, *last)
        noise = float(self.sigma[0]) if self.leave.noise_map else None
        return _block(scene, self.leave, noise, response, self.sigma, *last)


def _frame(measurement: Measurement, leave: Leave) -> Frame:
    """Balanced states: the root of S is a multiple of the identity."""
    assert measurement.sigma is not None
    states, response = measurement.illumination.astype(complex), measurement.response
    real_type = np.zeros((), jax.dtypes.canonicalize_dtype(response.dtype)).real.dtype
    complex_type, n = np.result_type(real_type, np.complex64), states.shape[-1]
    size = np.sqrt(0.5 * np.sum(np.abs(states) ** 2))
    shared = kernel.Shared(
        (size * np.eye(2)).astype(complex_type),
        (states / size).astype(complex_type),
        np.ones(n, real_type),
        real_type.type(0),
        real_type.type(2 * n),
    )
    return Frame(response, np.asarray(measurement.sigma, real_type).reshape(-1)[:1], shared, True, leave)


def _scene(model: Model, leave: Leave) -> Any:
    known = fast.scene(model)
    assert known is not None
    return replace(known, likelihood=cast(Any, NoGain())) if leave.gain else known


def fit(model: Model, measurement: Measurement, leave: Leave) -> Fit:
    """What :func:`polinfer.fit` gives for pixels that can all be fitted."""
    known, frame = _scene(model, leave), _frame(measurement, leave)
    solved = solve(known, frame)
    rows, status = solved.rows, status_of(model, solved)
    degrees = 4 * measurement.states - len(model.free)
    worst = 2 * gammainccinv(0.5 * degrees, BAD_FIT_PROBABILITY)
    status |= np.where(rows[describe.ROWS["chi_square"]] > worst, np.int32(Status.BAD_FIT), np.int32(0))
    for name in model.dropped:
        i = Parameters._fields.index(name)
        rows[[i, 5 + i]] = np.nan
    pixels = frame.pixels
    return Fit(
        model=model,
        parameters=Parameters(*rows[describe.ROWS["parameters"]]),
        std=Parameters(*rows[describe.ROWS["std"]]),
        covariance=np.moveaxis(rows[describe.ROWS["covariance"]].reshape(5, 5, pixels), (0, 1), (-2, -1)),
        log_posterior=rows[describe.ROWS["log_posterior"]],
        log_evidence=rows[describe.ROWS["log_evidence"]],
        sigma=np.full(pixels, frame.sigma[0]),
        gain=None,
        status=status,
        chi_square=rows[describe.ROWS["chi_square"]],
        degrees_of_freedom=np.full(pixels, degrees, np.int32),
    )
