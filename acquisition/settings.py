"""What can be set on a device, declared: so that a value is refused before it is sent, and read back after.

In: declarations that a driver makes, with limits that it has read from the device. Out: checked values. Called by
every driver and twin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from acquisition.errors import SettingError

__all__ = ["Setting", "Written"]

Kind = Literal["integer", "number", "choice", "switch", "text", "action"]
Access = Literal["rw", "ro", "wo"]


@dataclass(frozen=True)
class Written:
    """A value that was asked for, and what the device says it has."""

    requested: Any
    actual: Any


@dataclass(frozen=True)
class Setting:
    """A declaration. unit: of numbers, SI wherever possible, "" for none. low, high, step: limits and increment from
    ``low``, None where there are none; choices: names that a choice can take; access: read, write or both; safe: what
    to set when nobody is looking, None if any value is safe.

    >>> Setting("exposure", "number", "s", low=1e-5, high=1.0).checked(0.5)
    0.5
    """

    name: str
    kind: Kind
    unit: str = ""
    low: float | None = None
    high: float | None = None
    step: float | None = None
    choices: tuple[str, ...] = ()
    access: Access = "rw"
    safe: Any = None

    def checked(self, value: Any) -> Any:
        """The value as it can be sent; SettingError for what the device would not take."""
        if self.access == "ro":
            raise SettingError(f"{self.name} can only be read.")
        if self.kind == "action":
            return None
        if self.kind == "switch":
            if not isinstance(value, bool | np.bool_):
                raise SettingError(f"{self.name} must be True or False, got {value!r}.")
            return bool(value)
        if self.kind == "choice":
            if value not in self.choices:
                raise SettingError(f"{self.name} must be one of {', '.join(self.choices)}, got {value!r}.")
            return value
        if self.kind == "text":
            if not isinstance(value, str):
                raise SettingError(f"{self.name} must be text, got {type(value).__name__}.")
            return value
        return self._number(value)

    def _number(self, value: Any) -> int | float:
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise SettingError(f"{self.name} must be a number{self._in_unit()}, got {value!r}.")
        if not np.isfinite(value) or (self.kind == "integer" and value != int(value)):
            raise SettingError(f"{self.name} must be a finite {self.kind}{self._in_unit()}, got {value!r}.")
        number = int(value) if self.kind == "integer" else float(value)
        # a limit that went through another unit may have lost its last digit
        slack = 0.0 if self.kind == "integer" else 1e-9 * abs(number)
        if (self.low is not None and number < self.low - slack) or (
            self.high is not None and number > self.high + slack
        ):
            raise SettingError(f"{self.name} must be from {self.low} to {self.high}{self._in_unit()}, got {value!r}.")
        if self.kind == "integer" and self.step and (number - int(self.low or 0)) % int(self.step):
            raise SettingError(
                f"{self.name} must be {self.low} plus a multiple of {int(self.step)}{self._in_unit()}, got {value!r}."
            )
        return number

    def _in_unit(self) -> str:
        return f" in {self.unit}" if self.unit else ""
