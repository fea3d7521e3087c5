"""The record that every phantom returns."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks import broadcast, complex_array, integer, real_array
from ..degeneracy import reduce_ranges
from ..records import Parameters
from ..storage import array, setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Phantom", "frame_shape", "phase_map", "within_ranges"]


@dataclass(frozen=True, eq=False)
class Phantom:
    """A scene: what is true in every pixel. Shapes are (y, x), or (frame, y, x) for a series of frames.

    Parameters
    ----------
    parameters: the five, radians; they broadcast to the shape P of all fields together.
    gain: complex factor of the Jones matrix: amplitude and phase. None: 1.
    tilt: phase (radians) of the second component of the light relative to the first, which the instrument adds in each
        pixel: ``J_measured = T^-1 J T``, ``T = diag(1, e^{i tilt})``. None: the arms are parallel.
    labels: integers >= 0, the region of each pixel. None: 0 everywhere.
    names: ``names[k]`` is the name of label k; may be empty.
    seed: of the generator that made it, else None.

    ``len(scene)`` is the number of frames of a series, ``scene[i]`` the i-th of them.

    Raises
    ------
    TypeError, ValueError: arrays that do not broadcast or are not finite; labels that are no integers or have no name.

    >>> from polinfer import phantoms
    >>> series = phantoms.half_wave_plate((4, 5), angles=[0.0, 0.2, 0.4])
    >>> series.labels.shape, len(series), series[1].labels.shape
    ((3, 4, 5), 3, (4, 5))
    >>> bool(np.all(series[1].parameters.retardance_angle == 0.2)), series.names
    (True, ('plate',))
    """

    parameters: Parameters = array(("*P",), "rad")
    gain: np.ndarray = array(("*P",), "1", default=None)
    tilt: np.ndarray | None = array(("*P",), "rad", default=None)
    labels: np.ndarray = array(("*P",), "1", default=None)
    names: tuple[str, ...] = setting(default=())
    seed: int | None = None

    def __post_init__(self) -> None:
        values = {
            f"parameters.{name}": real_array(f"parameters.{name}", getattr(self.parameters, name), finite=True)
            for name in Parameters._fields
        }
        gain = complex_array("gain", 1.0 if self.gain is None else self.gain, finite=True)
        labels = np.asarray(np.int32(0) if self.labels is None else self.labels)
        if labels.dtype.kind not in "iu":
            raise TypeError(f"labels must be integers, got {labels.dtype}; convert them.")
        top = int(labels.max(initial=0))
        if labels.min(initial=0) < 0 or (self.names and top >= len(self.names)):
            raise ValueError(f"labels must be 0 to {len(self.names) - 1}, one for each of names, or just >= 0 without "
                             f"names; got {int(labels.min())} to {top}.")  # fmt: skip
        rest = {"gain": gain, "labels": labels}
        if self.tilt is not None:
            rest["tilt"] = real_array("tilt", self.tilt, finite=True)
        shape = broadcast(**{name: value.shape for name, value in {**values, **rest}.items()})
        object.__setattr__(self, "parameters", Parameters(*(np.broadcast_to(x, shape) for x in values.values())))
        for name, value in rest.items():
            object.__setattr__(self, name, np.broadcast_to(value, shape))
        object.__setattr__(self, "names", tuple(self.names))

    def __len__(self) -> int:
        if self.labels.ndim < 3:
            raise TypeError(f"a phantom of shape {self.labels.shape} is one frame and has no length.")
        return int(self.labels.shape[0])

    def __getitem__(self, index: int) -> Phantom:
        index = integer("index", index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is out of range: there are {len(self)} frames.")
        tilt = None if self.tilt is None else self.tilt[index]
        return Phantom(
            Parameters(*(x[index] for x in self.parameters)), self.gain[index], tilt, self.labels[index], self.names,
            self.seed,
        )  # fmt: skip

    def plot(self, pixel_size: float | None = None) -> Figure:
        """Maps of what is true, a row for each frame, see :func:`polinfer.plots.plot_phantom`."""
        from ..plots import plot_phantom

        return plot_phantom(self, pixel_size=pixel_size)


def frame_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """The pixels (y, x) of a frame, checked."""
    if np.shape(shape) != (2,):
        raise ValueError(f"shape must be (rows, columns), got {shape!r}.")
    rows, columns = (integer("shape", n, low=1) for n in shape)
    return rows, columns


def phase_map(tilt: Any, shape: tuple[int, int]) -> np.ndarray | None:
    """The tilt of a frame, checked: radians, broadcasts to (y, x), or None."""
    if tilt is None:
        return None
    values = real_array("tilt", tilt, finite=True)
    if broadcast(frame=shape, tilt=values.shape) != tuple(shape):
        raise ValueError(f"tilt must broadcast to the frame {tuple(shape)}, got {values.shape}.")
    return np.broadcast_to(values, shape)


def within_ranges(parameters: Parameters, gain: Any) -> tuple[Parameters, np.ndarray]:
    """The same ``g J`` with all parameters in their ranges: ``J(eta + 2 pi) = -J`` goes into the gain.

    >>> parameters, gain = within_ranges(Parameters(0.0, 0.0, np.array([3.0, 4.0]), 0.3, 0.0), 1.0)
    >>> parameters.retardance.round(3).tolist(), gain.tolist()
    ([3.0, -2.283], [1.0, -1.0])
    """
    retardance = np.asarray(parameters.retardance)
    turns = np.where(np.abs(retardance) <= pi, 0.0, np.ceil(retardance / (2 * pi) - 0.5))
    return reduce_ranges(parameters), np.asarray(gain) * np.where(turns % 2 == 1, -1.0, 1.0)
