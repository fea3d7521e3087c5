"""Modulators that are displays: exact pixels on a full screen, nothing scaled, and time to settle.

In: phases. Out: grey levels on a video output. Called by benches and users. Most spatial light modulators are of this
kind; there is no open USB protocol for them. Needs pygame (extra ``display``), which brings SDL.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from acquisition.contracts import PhaseModulator, Shown
from acquisition.errors import AcquisitionError, DeviceAbsent, DeviceLost, SettingError
from acquisition.settings import Setting
from polinfer.checks import integer

__all__ = ["DisplayModulator"]


class DisplayModulator(PhaseModulator):
    """A full-screen window whose grey levels are the modulator's phases.

    Parameters
    ----------
    serial: a name for the modulator, as displays have none that can be read. shape: (y, x) of the modulator, which must
    be the display's own: nothing is scaled, another size is refused. screen: number of the display, 0 the first.
    settle: seconds to wait after a pattern is on, 60 Hz panel and liquid crystal together. lookup: grey level of every
    phase step, integers (levels,) from 0 to 255, as the maker's calibration gives it; None: 256 steps, straight.

    Raises DeviceAbsent where there is no such display, SettingError for another size, AcquisitionError without pygame.
    """

    def __init__(
        self, serial: str, shape: tuple[int, int], screen: int = 0, settle: float = 0.3, lookup: Any = None
    ) -> None:
        try:
            import pygame
        except ImportError as error:
            raise AcquisitionError("displays need pygame; pip install 'polinfer[display]'.") from error
        self._serial, self._screen = serial, integer("screen", screen, low=0)
        self._shape = (integer("shape", shape[0], low=1), integer("shape", shape[1], low=1))
        table = np.arange(256) if lookup is None else np.asarray(lookup)
        if table.ndim != 1 or table.dtype.kind not in "ui" or len(table) < 2 or table.min() < 0 or table.max() > 255:
            raise SettingError("lookup must be integers (levels,) from 0 to 255.")
        self._lookup = table.astype(np.uint8)
        self._pygame, self._closed, self._settle = pygame, True, 0.0
        self._settle = self.settings["settle"].checked(settle)
        self._open()

    def _open(self) -> None:
        pygame = self._pygame
        try:
            pygame.display.init()
            sizes = pygame.display.get_desktop_sizes()
        except pygame.error as error:
            raise DeviceAbsent(f"no display can be opened: {error}.") from error
        if self._screen >= len(sizes):
            raise DeviceAbsent(f"screen must be below {len(sizes)}, the number of displays, got {self._screen}.")
        columns, rows = sizes[self._screen]
        if (rows, columns) != self._shape:
            raise SettingError(
                f"shape must be that of the display, {(rows, columns)}, got {self._shape}; nothing is scaled: set the "
                "modulator's native mode in the system's display settings."
            )
        try:
            self._window = pygame.display.set_mode((columns, rows), pygame.FULLSCREEN, display=self._screen)
        except pygame.error as error:
            raise AcquisitionError(f"display {self._screen} cannot be opened: {error}.") from error
        self._closed = False
        if self._window.get_size() != (columns, rows):
            self.close()
            raise SettingError(
                f"the window has {self._window.get_size()} pixels where {(columns, rows)} were asked for."
            )
        pygame.mouse.set_visible(False)
        pygame.display.set_allow_screensaver(False)

    @property
    def serial(self) -> str:
        """See :class:`acquisition.contracts.Device`."""
        return self._serial

    @property
    def shape(self) -> tuple[int, int]:
        """See :class:`PhaseModulator`."""
        return self._shape

    @property
    def levels(self) -> int:
        """See :class:`PhaseModulator`."""
        return len(self._lookup)

    @property
    def settings(self) -> Mapping[str, Setting]:
        """See :class:`acquisition.contracts.Device`."""
        return {"settle": Setting("settle", "number", "s", 0.0, 60.0)}

    def describe(self) -> dict[str, Any]:
        """See :class:`acquisition.contracts.Device`."""
        table = hashlib.sha256(self._lookup.tobytes()).hexdigest()[:16]
        return {"device": "display", "serial": self._serial, "screen": self._screen, "shape": list(self._shape),
                "settle": self._settle, "lookup": table, "driver": self._pygame.display.get_driver()}  # fmt: skip

    def _read(self, setting: Setting) -> float:
        return self._settle

    def _write(self, setting: Setting, value: float) -> None:
        self._settle = value

    def show(self, phase: np.ndarray) -> Shown:
        """See :class:`PhaseModulator`."""
        return self.show_levels(self.quantised(phase))

    def show_levels(self, levels: np.ndarray) -> Shown:
        """Show steps (y, x), integers below ``levels``, as they are; returns when they have settled."""
        if self._closed:
            raise DeviceLost("this display has been closed; open another.")
        levels = np.asarray(levels)
        if levels.shape != self._shape or levels.dtype.kind not in "ui" or levels.max(initial=0) >= self.levels:
            raise SettingError(f"levels must be integers {self._shape} below {self.levels}, got {levels.dtype} "
                               f"{levels.shape}.")  # fmt: skip
        grey = self._lookup[levels]
        pygame = self._pygame
        pixels = np.repeat(grey.T[..., None], 3, axis=2)
        try:
            for _ in range(2):  # both buffers: an exchange must never bring an older pattern back
                pygame.surfarray.blit_array(self._window, pixels)
                pygame.display.flip()
                pygame.event.pump()
        except pygame.error as error:
            raise DeviceLost(f"the display is gone: {error}.") from error
        start = time.monotonic()
        time.sleep(self._settle)
        pygame.event.pump()
        return Shown(hashlib.sha256(grey.tobytes()).hexdigest(), time.monotonic() - start)

    def make_safe(self) -> None:
        """See :class:`acquisition.contracts.Device`: a flat phase, without waiting."""
        if not self._closed:
            settle, self._settle = self._settle, 0.0
            try:
                self.show_levels(np.zeros(self._shape, np.uint8))
            finally:
                self._settle = settle

    def close(self) -> None:
        """See :class:`acquisition.contracts.Device`."""
        if not self._closed:
            self._closed = True
            self._pygame.display.quit()
