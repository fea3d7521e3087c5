"""Synthetic measurements with known truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from .checks import as_generator, broadcast, complex_array, one_of_types, real_array
from .model import Model
from .orderings.on_host import jones_on_host
from .records import Measurement, Parameters
from .tilting import tilted

__all__ = ["simulate"]


def simulate(
    model: Model,
    parameters: Parameters,
    illumination: Any,
    sigma: Any,
    rng: int | np.random.Generator | None = None,
    gain: Any = None,
    tilt: Any = None,
) -> Measurement:
    """A measurement ``g T^-1 J(parameters) T U + noise`` with complex Gaussian noise, ``E|noise|^2 = sigma^2``.

    Parameters
    ----------
    model: names the ordering and the gain; fixed parameters take their fixed values.
    parameters: of shape P, radians. illumination: complex ``(*P, 2, n)``. sigma: > 0, broadcasts to P.
    rng: seed, generator, or None: a fresh seed, recorded in the measurement.
    gain: complex, broadcasts to P. None: drawn from the model's gain, or 1 if it has none.
    tilt: phase phi of ``T = diag(1, e^{i phi})``, radians, broadcasts to P; None: 0, also if the model has a TiltPlane.

    Raises
    ------
    ValueError, TypeError: arguments that do not fit together or are not finite.

    >>> truth = Parameters(np.full((3, 4), 0.1), 0.0, 1.0, 0.5, 0.0)
    >>> simulate(Model(), truth, np.eye(2), sigma=0.1, rng=7).seed
    7
    """
    one_of_types("model", model, (Model,), "pass Model(...).")
    one_of_types("parameters", parameters, (Parameters,), "pass Parameters(...).")
    values = {name: getattr(parameters, name) for name in model.free}
    values = {name: real_array(f"parameters.{name}", x, finite=True) for name, x in values.items()}
    illumination = complex_array("illumination", illumination, trailing=(2, None), finite=True)
    sigma = real_array("sigma", sigma, above=0, finite=True)
    given = None if gain is None else complex_array("gain", gain, finite=True)
    phase = None if tilt is None else real_array("tilt", tilt, finite=True)
    shape = broadcast(
        **{f"parameters.{name}": x.shape for name, x in values.items()},
        illumination=illumination.shape[:-2],
        sigma=sigma.shape,
        gain=() if given is None else given.shape,
        tilt=() if phase is None else phase.shape,
    )
    generator, seed = as_generator(rng)
    factor = model.known_gain.sample(generator, shape) if given is None else given
    jones = jones_on_host(
        model.ordering, Parameters(**dict.fromkeys(Parameters._fields, 0.0) | values | dict(model.fixed))
    )
    if phase is not None:
        jones = tilted(jones, phase)
    clean = factor[..., None, None] * (jones @ illumination)
    clean = np.broadcast_to(clean, (*shape, *clean.shape[-2:]))
    noise = generator.normal(scale=np.sqrt(0.5), size=(2, *clean.shape))
    response = clean + sigma[..., None, None] * (noise[0] + 1j * noise[1])
    return Measurement(illumination, response, np.broadcast_to(sigma, shape), seed=seed)
