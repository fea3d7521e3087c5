"""The command ``polinfer`` itself: finds its commands, and turns mistakes into one line."""

from __future__ import annotations

from importlib import metadata
from typing import Any

import click

__all__ = ["main"]

GROUP = "polinfer.commands"


class _UserError(click.ClickException):
    exit_code = 2


class _Commands(click.Group):
    """Commands by entry point, imported when they are used; mistakes of the user end in one line, not a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return sorted(metadata.entry_points(group=GROUP).names)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == cmd_name]
        return found[0].load() if found else None

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (ValueError, TypeError, OSError) as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise _UserError(message) from error


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="polinfer", prog_name="polinfer")
def main() -> None:
    """Polarisation parameters from measured fields, with their uncertainty.

    Example: polinfer fit measurement.nc result.nc --gain phase --picture map.png
    """
    import jax

    # a program decides about precision; the library never does
    jax.config.update("jax_enable_x64", True)
