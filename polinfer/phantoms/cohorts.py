"""Several samples, diseased and control, with the differences between them that samples have."""

from __future__ import annotations

import numpy as np

from ..checks import as_generator, integer, real_number
from ..records import Parameters
from .base import Phantom, frame_shape
from .tissue import NAMES, lesion

__all__ = ["cohort"]

HEALTHY = Parameters(0.12, 0.6, 0.9, 0.6, 0.1)
CHANGE = Parameters(0.03, 0.35, 0.4, 0.25, 0.0)  # of the lesion, where effect is 1
BETWEEN = Parameters(0.02, 0.15, 0.15, 0.15, 0.05)  # standard deviations over samples, where between is 1


def cohort(
    shape: tuple[int, int] = (64, 64),
    rng: int | np.random.Generator | None = None,
    diseased: int = 6,
    control: int = 3,
    effect: float = 1.0,
    between: float = 1.0,
    variation: float = 0.15,
    smoothness: float = 3.0,
    disorder: float = 2.0,
    phase_disorder: float = 2.5,
    diameter: float = 30.0,
) -> Phantom:
    """Samples of tissue: the first ``diseased`` of them have a lesion, the last ``control`` have none.

    Each is a :func:`lesion` scene. Healthy tissue has (D, theta_D, eta, theta_eta, xi) = (0.12, 0.6, 0.9, 0.6, 0.1);
    lesions differ by ``effect * (0.03, 0.35, 0.4, 0.25, 0)``. Samples differ by normal deviates of standard deviation
    ``between * (0.02, 0.15, 0.15, 0.15, 0.05)`` that healthy tissue and lesion of a sample share, and by deviates of
    half that of the lesion alone. Every second sample (0, 2, ...) has a fold 6 pixels wide, every third an edge.
    The numbers make a clear picture; they are not those of any tissue.

    Parameters
    ----------
    shape: pixels (y, x) of each. rng: seed, generator or None: a fresh seed, recorded.
    diseased, control: numbers of samples, >= 0, at least one together. effect, between: see above; between >= 0.
    variation ... phase_disorder: as in :func:`lesion`.
    diameter: mean diameter of the lesions, pixels, > 0; they vary by 10 % and lie near the middle.

    Returns
    -------
    Phantom of shape (sample, y, x), labels 0 healthy, 1 lesion, 2 fold, 3 outside; ``cohort(...)[i]`` is one sample.

    Raises
    ------
    TypeError, ValueError: values out of range.

    Source: Gordon et al., supplementary information, figure of all samples (6 diseased, 3 control).

    >>> samples = cohort((48, 48), rng=1)
    >>> len(samples), [bool((samples[i].labels == 1).any()) for i in range(9)].count(True)
    (9, 6)
    """
    shape = frame_shape(shape)
    diseased, control = integer("diseased", diseased, low=0), integer("control", control, low=0)
    if diseased + control == 0:
        raise ValueError("diseased and control are both 0; ask for at least one sample.")
    between = real_number("between", between, low=0)
    change = real_number("effect", effect) * np.array(CHANGE)
    diameter = real_number("diameter", diameter, above=0)
    generator, seed = as_generator(rng)
    scenes = []
    for k in range(diseased + control):
        healthy = np.array(HEALTHY) + between * np.array(BETWEEN) * generator.normal(size=5)
        ill = healthy + change + 0.5 * between * np.array(BETWEEN) * generator.normal(size=5)
        size = diameter * (1 + 0.1 * float(np.clip(generator.normal(), -2, 2)))
        pairs = zip(Parameters._fields, healthy, ill, strict=True)
        scenes.append(
            lesion(
                shape,
                generator,
                **{name: (float(a), float(b)) for name, a, b in pairs},
                variation=variation,
                smoothness=smoothness,
                disorder=disorder,
                phase_disorder=phase_disorder,
                diameter=size if k < diseased else 0.0,
                centre=tuple(generator.uniform(0.4, 0.6, size=2)),
                fold=6.0 if k % 2 == 0 else 0.0,
                edge=0.12 if k % 3 == 0 else 0.0,
            )
        )
    return Phantom(
        Parameters(*(np.stack(x) for x in zip(*(s.parameters for s in scenes), strict=True))),
        np.stack([s.gain for s in scenes]),
        None,
        np.stack([s.labels for s in scenes]),
        NAMES,
        seed,
    )
