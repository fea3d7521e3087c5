"""A gel that scatters and absorbs."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..checks import as_generator, integer, real_number
from ..degeneracy import canonicalise
from ..records import Parameters
from .base import Phantom, frame_shape, phase_map, within_ranges
from .random_fields import complex_field, smooth_field
from .rotation_vectors import retarder_of

__all__ = ["scattering_gel"]


def scattering_gel(
    shape: tuple[int, int],
    rng: int | np.random.Generator | None = None,
    scattering: float = 500.0,
    absorption: float = 50.0,
    thickness: float = 2e-3,
    collected: float = 0.5,
    retardance: float = 0.5,
    diattenuation: float = 0.1,
    grain: float = 1.5,
    frames: int | None = None,
    memory: float = 0.9,
    tilt: Any = None,
) -> Phantom:
    """Light that passes straight through, plus speckle of the scattered light, and random polarisation to match.

    Of the intensity, ``e^{-(mu_a + mu_s) t}`` passes unscattered and ``collected e^{-mu_a t} (1 - e^{-mu_s t})`` is
    scattered into the aperture, so the gain is a constant plus a complex Gaussian field of that mean square (its
    modulus has a Rice distribution). The retarder is ``exp(i/2 w.s)``, w three Gaussian fields of standard deviation
    ``retardance * sqrt(share)`` each, and D and its axis are the modulus and half the argument of a complex Gaussian
    field of root mean square ``diattenuation * sqrt(share)``; share is the scattered part of the collected light. It is
    a statistical picture, no solution of the transport equation, and one Jones matrix a pixel: it does not depolarise.

    Parameters
    ----------
    shape: pixels (y, x). rng: seed, generator or None: a fresh seed, recorded.
    scattering, absorption: mu_s and mu_a, 1/m, >= 0. thickness: t, metres, > 0. collected: 0 to 1.
    retardance: radians, >= 0. diattenuation: 0 to 1. grain: correlation length of all fields, pixels, > 0; speckles
        of neighbouring grains are independent.
    frames: None for one frame, else a series in time. memory: correlation (0 to 1) of all random fields from each frame
        to the next, which falls off as ``memory^k``.
    tilt: phase of the second arm, radians, broadcasts to (y, x), or None.

    Returns
    -------
    Phantom of shape (y, x), or (frame, y, x); parameters are the canonical ones.

    Raises
    ------
    TypeError, ValueError: values out of range.

    Source: Gordon et al., supplementary information, phantoms (agar, intralipid, nigrosin, 2 mm).

    >>> gel = scattering_gel((400, 400), rng=1)
    >>> expected = np.exp(-0.1) * (np.exp(-1.0) + 0.5 * (1 - np.exp(-1.0)))
    >>> bool(abs((np.abs(gel.gain) ** 2).mean() / expected - 1) < 0.05)
    True
    """
    shape = frame_shape(shape)
    scattering, absorption = (
        real_number(name, x, low=0) for name, x in (("scattering", scattering), ("absorption", absorption))
    )
    thickness, grain = (real_number(name, x, above=0) for name, x in (("thickness", thickness), ("grain", grain)))
    collected, diattenuation, memory = (
        real_number(name, x, low=0, high=1)
        for name, x in (("collected", collected), ("diattenuation", diattenuation), ("memory", memory))
    )
    retardance = real_number("retardance", retardance, low=0)
    count = 1 if frames is None else integer("frames", frames, low=1)
    generator, seed = as_generator(rng)

    def draw() -> np.ndarray:
        speckle, axes = (complex_field(generator, shape, grain) for _ in range(2))
        vector = [smooth_field(generator, shape, grain) for _ in range(3)]
        return np.stack([speckle, axes, *vector])

    states = [draw()]
    for _ in range(count - 1):
        states.append(memory * states[-1] + np.sqrt(1 - memory**2) * draw())
    speckle, axes, *vector = np.stack(states, axis=1) if frames is not None else states[0]
    straight = np.exp(-(absorption + scattering) * thickness)
    scattered = collected * np.exp(-absorption * thickness) * -np.expm1(-scattering * thickness)
    share = np.sqrt(scattered / (straight + scattered))
    gain = np.sqrt(straight) + np.sqrt(scattered) * speckle
    retarder = retarder_of(*(retardance * share * v.real for v in vector))
    strength = np.minimum(diattenuation * share * np.abs(axes), 1.0)
    parameters, gain = within_ranges(Parameters(strength, 0.5 * np.angle(axes), *retarder), gain)
    return Phantom(canonicalise(parameters), gain, phase_map(tilt, shape), names=("gel",), seed=seed)
