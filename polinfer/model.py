"""A scene, declared: its parts, and the probability they give to data and parameters."""

# ruff: noqa: RUF009
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import isclose, pi
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .checks import one_of_types, real_number
from .circular import wrap
from .elements import multiply
from .gain import Gain, UnitGain
from .misalignment import Misalignment, RotatedBasis, TiltPlane
from .neighbours import Pooled, Window, Windowed, pool
from .noise import KnownNoise, Noise
from .orderings import Ordering, RetarderFirst
from .priors import Prior, default_priors
from .records import PERIODS, RANGES, Measurement, Parameters
from .statistics import Statistics, Summary, summarise
from .tilting import tilt_of, tilted_statistics

__all__ = ["Model"]

BLOCK = 4096  # pixels whose windows are in memory at once


class _Frozen(dict):
    """A dict that does not change, and can therefore be hashed: a model is a key of compiled code."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(sorted(self.items(), key=lambda item: item[0])))

    def __reduce__(self) -> tuple[Any, ...]:
        # a model travels to other processes, where its dictionaries are made whole at once
        return type(self), (dict(self),)

    def __setitem__(self, key: Any, value: Any) -> None:
        raise TypeError("a Model does not change; make another one with the priors or fixed values you want.")


def _known_names(name: str, given: Any) -> dict[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(f"{name} must be a dict by parameter name, got {type(given).__name__}.")
    unknown = sorted(set(given) - set(Parameters._fields))
    if unknown:
        raise ValueError(
            f"{name} has unknown parameter {unknown[0]!r}; the parameters are {', '.join(Parameters._fields)}."
        )
    return dict(given)


def _dropped(fixed: Mapping[str, float]) -> frozenset[str]:
    """Parameters that no longer appear in any product of the two elements."""
    gone: set[str] = set()
    if fixed.get("diattenuation") == 0:
        gone.add("diattenuation_angle")
    if fixed.get("retardance") == 0:
        gone |= {"retardance_angle", "circularity"}
    angle = fixed.get("retardance_angle")
    if angle is not None and any(isclose(angle, axis, abs_tol=1e-12) for axis in (-pi / 2, 0.0, pi / 2)):
        gone.add("circularity")
    return frozenset(gone - set(fixed))


@dataclass(frozen=True)
class Model:
    """A scene: how the matrix is made up, what is known beforehand, and what else is unknown.

    Parameters
    ----------
    ordering: the order in which light meets the elements, :class:`RetarderFirst` or :class:`PolariserFirst`.
    priors: dict of priors by parameter name, over the defaults of :func:`polinfer.priors.default_priors`.
    noise: :class:`KnownNoise` or :class:`InferredNoise`.
    gain: :class:`PhaseGain`, :class:`ComplexGain`, or None: g = 1.
    neighbours: :class:`Window` whose pixels share the parameters (a gain remains one for each pixel), or None.
    misalignment: :class:`TiltPlane`, :class:`RotatedBasis` (needs neighbours, and has no circularity), or None: the two
        arms of the illumination are parallel.
    fixed: dict of known values by parameter name. A parameter that then drops out of J is integrated out: with
        ``diattenuation`` 0 its angle; with ``retardance`` 0 its angle and the circularity; with ``retardance_angle``
        0 or pi/2 the circularity.

    Without a gain the retardance has real bounds at -pi and pi, because ``J(eta + 2 pi) = -J``; with one it is a
    circle. A prior whose support is shorter than the period of its angle makes bounds as well.

    Raises
    ------
    ValueError: unknown parameter names, fixed values out of range, a prior of a fixed parameter, a prior outside the
    parameter's range. TypeError: parts of a wrong kind.

    >>> from polinfer import PhaseGain
    >>> model = Model(gain=PhaseGain(), fixed={"diattenuation": 0.0})
    >>> model.free
    ('retardance', 'retardance_angle', 'circularity')
    """

    ordering: Ordering = RetarderFirst()
    priors: Any = None
    noise: Noise = KnownNoise()
    gain: Gain | None = None
    neighbours: Window | None = None
    misalignment: Misalignment | None = None
    fixed: Any = None

    def __post_init__(self) -> None:
        one_of_types("ordering", self.ordering, (Ordering,), "pass an instance such as RetarderFirst().")
        one_of_types("noise", self.noise, (Noise,), "pass KnownNoise() or InferredNoise(shape, scale, scope).")
        if self.gain is not None:
            one_of_types("gain", self.gain, (Gain,), "pass PhaseGain(), ComplexGain(scale) or None.")
        if self.neighbours is not None:
            one_of_types("neighbours", self.neighbours, (Window,), "pass Window(rows, columns) or None.")
        fixed = _known_names("fixed", self.fixed)
        if self.misalignment is not None:
            kinds = (TiltPlane, RotatedBasis)
            one_of_types("misalignment", self.misalignment, kinds, "pass TiltPlane(), RotatedBasis() or None.")
        if isinstance(self.misalignment, RotatedBasis):
            self._check_rotated_basis(fixed)
            fixed = fixed | {"circularity": 0.0}
        for name, value in fixed.items():
            low, high = getattr(RANGES, name)
            fixed[name] = real_number(f"fixed[{name!r}]", value, low=low, high=high)
        given = _known_names("priors", self.priors)
        for name, prior in given.items():
            one_of_types(f"priors[{name!r}]", prior, (Prior,), "pass a prior such as VonMises(0.0, 1.0).")
            if name in fixed:
                raise ValueError(
                    f"priors and fixed both name {name!r}; a known value has no prior: remove one of the two."
                )
            (low, high), (left, right) = getattr(RANGES, name), prior.support
            if left < low - 1e-9 or right > high + 1e-9:
                raise ValueError(
                    f"priors[{name!r}] has support ({left:g}, {right:g}), wider than the range ({low:g}, {high:g}), so "
                    "it is not normalised there; narrow it (for the angle of an axis: AxialVonMises, UniformAngle(pi))."
                )
        priors = {name: prior for name, prior in (default_priors() | given).items() if name not in fixed}
        object.__setattr__(self, "priors", _Frozen(priors))
        object.__setattr__(self, "fixed", _Frozen(fixed))
        try:
            hash(self)
        except TypeError as error:
            raise TypeError(
                f"priors, ordering and gain must be hashable ({error}); declare yours with @dataclass(frozen=True)."
            ) from None

    def _check_rotated_basis(self, fixed: dict[str, Any]) -> None:
        if self.neighbours is None:
            raise ValueError(
                "misalignment is RotatedBasis() without neighbours: the angle of the basis is that of a window; pass "
                "neighbours=Window(3, 5)."
            )
        known, prior = fixed.get("circularity", 0), _known_names("priors", self.priors).get("circularity")
        if known != 0 or prior is not None:
            given = f"fixed['circularity'] = {known}" if known != 0 else f"priors['circularity'] = {prior}"
            raise ValueError(
                f"misalignment is RotatedBasis(), a model without circularity, and {given}; leave that out."
            )

    @property
    def dropped(self) -> frozenset[str]:
        """Names of the parameters that do not appear in J because of the fixed ones."""
        return _dropped(self.fixed)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that are inferred."""
        return tuple(name for name in Parameters._fields if name not in self.fixed and name not in self.dropped)

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds of the free parameters that have any; the others are circles."""
        found = {}
        for name in self.free:
            (low, high), (left, right) = getattr(RANGES, name), self.priors[name].support
            whole_circle = right - left >= getattr(PERIODS, name) - 1e-9
            if name == "retardance" and not self.known_gain.free_phase:
                whole_circle = False
            if not whole_circle:
                found[name] = (max(low, left), min(high, right))
        return found

    @property
    def known_gain(self) -> Gain:
        """The gain as an object: ``UnitGain()`` where ``gain`` is None."""
        return UnitGain() if self.gain is None else self.gain

    def complete(self, parameters: Parameters) -> Parameters:
        """The parameters with fixed values in place and 0 for those that drop out of J."""
        given = parameters._asdict()
        like = jnp.zeros((), jnp.result_type(float, *(given[name] for name in self.free)))
        constants = dict.fromkeys(self.dropped, like) | {name: like + value for name, value in self.fixed.items()}
        return Parameters(**(given | constants))

    def jones(self, parameters: Parameters) -> jax.Array:
        """Jones matrices ``(*P, 2, 2)``; fixed and dropped parameters are not read, and may be NaN.

        >>> Model(fixed={"diattenuation": 0.0}).jones(Parameters(np.nan, np.nan, 0.0, 0.0, 0.0)).real.tolist()
        [[1.0, 0.0], [0.0, 1.0]]
        """
        one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
        return self.ordering.jones(self.complete(parameters))

    def log_prior(self, parameters: Parameters) -> jax.Array:
        """Log prior density of the free parameters, shape P (nats, angles in radians); -inf outside the ranges.

        Fixed parameters have no prior, and that of a dropped one integrates to 1.

        >>> round(float(Model().log_prior(Parameters(0.0, 0.0, 0.0, 0.0, 0.0))), 4)
        -5.3804
        """
        one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
        total: Any = 0.0  # a Python number takes the precision of the parameters
        for name in self.free:
            value = jnp.asarray(getattr(parameters, name))
            if name in self.bounds:
                low, high = self.bounds[name]
                # the bounds are rounded like the value, or a bound in single precision lies outside
                inside = (value >= jnp.asarray(low, value.dtype)) & (value <= jnp.asarray(high, value.dtype))
                total = total + jnp.where(inside, self.priors[name].log_density(value), -jnp.inf)
            else:
                total = total + self.priors[name].log_density(wrap(value, getattr(PERIODS, name)))
        return jnp.asarray(total)

    def log_likelihood(self, parameters: Parameters, measurement: Measurement, tilt: Any = None) -> jax.Array:
        """Log density of the data, gain and noise integrated out (nats); shape P broadcast with that of the parameters.

        ``-|g J U - V|^2 / sigma^2 - 2 n log(pi sigma^2)`` for known g and sigma. With neighbours it is that of all data
        of the window around each pixel. NaN in masked pixels and where the response is not finite.

        ``tilt`` is the phase phi of the second arm, radians, broadcasts to P: the density of the data is then that of
        the matrix ``T^-1 J T``, ``T = diag(1, e^{i phi})``. A model with :class:`TiltPlane` needs it.

        Raises
        ------
        ValueError: the measurement has no sigma, or has one that is to be inferred (see :class:`InferredNoise`); no
            tilt.

        >>> m = Measurement(np.eye(2), np.eye(2), sigma=1.0)
        >>> round(float(Model().log_likelihood(Parameters(0.0, 0.0, 0.0, 0.0, 0.0), m)), 4)
        -4.5789
        """
        return self._evaluate(_log_data, parameters, measurement, tilt)

    def log_posterior(self, parameters: Parameters, measurement: Measurement, tilt: Any = None) -> jax.Array:
        """``log_likelihood + log_prior``: normalised as a density of data and parameters, not over the evidence.

        Given the ``tilt``, whose own prior is left out (:meth:`TiltPlane.log_prior`).

        >>> m = Measurement(np.eye(2), np.eye(2), sigma=1.0)
        >>> round(float(Model().log_posterior(Parameters(0.0, 0.0, 0.0, 0.0, 0.0), m)), 4)
        -9.9593
        """
        return self._evaluate(_log_density, parameters, measurement, tilt)

    def _evaluate(self, function: Any, parameters: Parameters, measurement: Measurement, tilt: Any) -> jax.Array:
        one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
        one_of_types("measurement", measurement, (Measurement,), "pass a Measurement.")
        given = Parameters(*(jnp.asarray(value) for value in parameters))
        summary, dtype = summarise(measurement, self.noise.sigma(measurement)), measurement.response.dtype
        if tilt is not None:
            phase = tilt_of(tilt, measurement.shape)
            summary = summary._replace(statistics=tilted_statistics(summary.statistics, phase))
        elif isinstance(self.misalignment, TiltPlane):
            raise ValueError(
                "tilt is None and the model has a TiltPlane; pass the phases, such as tilt=fit.tilt.phase."
            )
        if self.neighbours is None:
            values = function(self, given, as_device(summary.statistics, dtype))
        else:
            values = self._evaluate_windows(function, given, summary, dtype)
        return jnp.where(summary.masked | summary.non_finite, jnp.nan, values)

    def _evaluate_windows(self, function: Any, given: Parameters, summary: Summary, dtype: np.dtype) -> jax.Array:
        pooled = self.pool(summary)
        shape = np.broadcast_shapes(*(value.shape for value in given), summary.masked.shape)
        pixels = np.broadcast_to(np.arange(summary.masked.size).reshape(summary.masked.shape), shape).reshape(-1)
        spread = [jnp.broadcast_to(value, shape).reshape(-1) for value in given]
        parts = [jnp.zeros(0, spread[0].dtype)]
        apart = replace(self, neighbours=None)  # statistics are pooled: windows of all sizes share compiled code
        for begin in range(0, len(pixels), BLOCK):
            part = slice(begin, begin + BLOCK)
            statistics = as_device(pooled.take(pixels[part]), dtype)
            parts.append(function(apart, Parameters(*(value[part] for value in spread)), statistics))
        return jnp.concatenate(parts[1:] or parts).reshape(shape)

    def pool(self, summary: Summary) -> Pooled:
        """Sufficient statistics of the window around every pixel, or of the pixels themselves without neighbours."""
        return pool(summary, self.neighbours, self.known_gain, self.noise)

    def log_density(self, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
        """Log posterior density from sufficient statistics: element-wise, for JAX transformations."""
        prior = self.log_prior(parameters)
        # outside the support there may be no matrix, and the density is 0 all the same
        return jnp.where(prior == -jnp.inf, -jnp.inf, self.log_data(parameters, statistics) + prior)

    def log_data(self, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
        """Log likelihood from sufficient statistics: element-wise, for JAX transformations."""
        if isinstance(statistics, Statistics):
            seen = multiply(self.jones(parameters), statistics.illumination)
            return self.noise.log_marginal(self.known_gain, seen, statistics)
        members = statistics.statistics
        shared = Parameters(*(jnp.asarray(value)[..., None] for value in parameters))
        seen = multiply(self.jones(shared), members.illumination)
        first = seen[..., 0, :, :]
        total = jnp.sum(self.noise.log_marginal(self.known_gain, seen, members), axis=-1)
        return total + statistics.dark * self.known_gain.log_marginal(first, jnp.zeros_like(first))


@partial(jax.jit, static_argnums=0)
def _log_data(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
    return model.log_data(parameters, statistics)


@partial(jax.jit, static_argnums=0)
def _log_density(model: Model, parameters: Parameters, statistics: Statistics | Windowed) -> jax.Array:
    return model.log_density(parameters, statistics)


def as_device(statistics: Any, dtype: Any) -> Any:
    """Statistics as JAX arrays in the precision of complex ``dtype`` (single where JAX has no double enabled)."""
    complex_type = jax.dtypes.canonicalize_dtype(dtype)
    real_type = np.zeros((), complex_type).real.dtype
    return jax.tree.map(
        lambda x: jax.device_put(np.asarray(x).astype(complex_type if np.iscomplexobj(x) else real_type)), statistics
    )
