"""Functions of the parameters that are the same for all equivalent sets: what chains can be compared by."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..model import Model
from ..records import Parameters

__all__ = ["invariants"]


def _all(model: Model, parameters: Parameters) -> dict[str, Any]:
    """All functions, those included that the model keeps constant."""
    host = all(isinstance(x, np.ndarray | np.generic | float | int) for x in parameters)
    xp: Any = np if host else jnp
    p = parameters
    axis, half, polar = 2 * p.diattenuation_angle, 0.5 * p.retardance, 2 * p.retardance_angle
    length = xp.sin(half)
    across = length * xp.sin(polar)
    w, x = xp.cos(half), length * xp.cos(polar)
    y, z = across * xp.cos(p.circularity), across * xp.sin(p.circularity)
    found = {
        "polariser.cos": p.diattenuation * xp.cos(axis),
        "polariser.sin": p.diattenuation * xp.sin(axis),
        "polariser.size": abs(p.diattenuation),
    }
    if not model.known_gain.free_phase:
        return found | {"retarder.w": w, "retarder.x": x, "retarder.y": y, "retarder.z": z}
    pairs = {"ww": w * w, "xx": x * x, "yy": y * y, "wx": w * x, "wy": w * y, "wz": w * z,
             "xy": x * y, "xz": x * z, "yz": y * z}  # fmt: skip
    return found | {f"retarder.{name}": value for name, value in pairs.items()}


@cache
def _names(model: Model) -> tuple[str, ...]:
    """Names of the functions that are not the same for all parameters that the model allows."""
    values = np.random.default_rng(5).uniform(-1, 1, (5, 16))
    probe = Parameters(**(dict(zip(Parameters._fields, values, strict=True)) | dict.fromkeys(model.dropped, 0.0)
                          | model.fixed))  # fmt: skip
    return tuple(name for name, value in _all(model, probe).items() if np.ptp(value) > 1e-9)


def invariants(model: Model, parameters: Parameters) -> dict[str, Any]:
    """Functions of the parameters that the eight equivalent sets of :func:`polinfer.orbit` share, by name.

    A chain may visit any of the copies, and angles of the same axis differ by whole turns: the parameters themselves
    say nothing about convergence. These do:

    - ``polariser.cos``, ``.sin``, ``.size``: the vector ``D (cos 2 theta_D, sin 2 theta_D)`` and its length ``|D|``;
    - without a free phase ``retarder.w``, ``.x``, ``.y``, ``.z``: the unit quaternion ``(cos(eta/2),
      sin(eta/2) cos 2 theta_eta, sin(eta/2) sin 2 theta_eta cos xi, sin(eta/2) sin 2 theta_eta sin xi)``;
    - with a gain whose phase is free, where the retarder and its negative are the same data, the products of two of
      its components, ``retarder.ww``, ``.wx``, ..., of which the elements of its rotation matrix are made
      (``zz = 1 - ww - xx - yy`` is left out).

    Functions that the fixed parameters of the model keep constant are left out.

    Parameters
    ----------
    model: tells the fixed parameters and the gain. parameters: real, of shape P, radians, NumPy or JAX arrays; fixed
        and dropped ones are not read.

    Returns
    -------
    dict of arrays of shape P, all in [-1, 1].

    >>> from polinfer import PhaseGain, orbit
    >>> copies = invariants(Model(), orbit(Parameters(0.1, 0.2, 0.5, 0.3, 0.7)))
    >>> {name: float(np.ptp(value)) < 1e-15 for name, value in copies.items()}
    {'polariser.cos': True, 'polariser.sin': True, 'polariser.size': True, 'retarder.w': True, 'retarder.x': True,
     'retarder.y': True, 'retarder.z': True}
    >>> list(invariants(Model(gain=PhaseGain(), fixed={"retardance": 0.0}), Parameters(0.1, 0.2, 0.0, 0.0, 0.0)))
    ['polariser.cos', 'polariser.sin', 'polariser.size']
    """
    known: dict[str, Any] = dict.fromkeys(model.dropped, 0.0) | model.fixed
    found = _all(model, Parameters(**(parameters._asdict() | known)))
    shape = np.broadcast_shapes(*(np.shape(x) for x in parameters))
    return {name: found[name] + np.zeros(shape) if np.shape(found[name]) != shape else found[name]
            for name in _names(model)}  # fmt: skip
