"""Settings of the documentation: python -m sphinx -W -b html docs <folder for the pages>."""

from __future__ import annotations

import importlib
import re
from importlib import metadata
from pathlib import Path
from typing import Any

project = "polinfer"
author = "The polinfer developers"
copyright = author
version = release = metadata.version("polinfer")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["figures"]
html_theme = "alabaster"
html_theme_options = {"page_width": "1100px", "description": "Bayesian polarimetry and fibre imaging"}
html_title = f"polinfer {release}"
html_show_sphinx = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_preserve_defaults = True

_LITERAL = re.compile(r"(``.*?``|:[a-z]+:`.*?`)")
_ITEM = re.compile(r"[\w, .]+: ")


def _escape(line: str) -> str:
    """Stars, bars and trailing underscores of plain text are no markup."""
    parts = _LITERAL.split(line)
    return "".join(p if i % 2 else re.sub(r"([*|]|_(?=\W|$))", r"\\\1", p) for i, p in enumerate(parts))


def plain_docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:  # noqa: ARG001
    """Our docstrings are written for ``help()``: underlined sections of ``name: meaning`` lines become lists."""
    out: list[str] = []
    section, item, verbatim = False, False, ""
    for i, line in enumerate(lines):
        text = line.strip()
        if verbatim == "math" and (not text or line[:1].isspace()):
            out.append(line)
            continue
        if verbatim == "doctest" and text:
            out.append(line)
            continue
        if verbatim == "example" and (not text or line[:1].isspace()):
            out.append(line)
            continue
        verbatim = ""
        if text.startswith((".. math::", ".. ", ">>>")):
            verbatim = "doctest" if text.startswith(">>>") else "math"
            out += ["", line]
        elif i + 1 < len(lines) and text and re.fullmatch(r"-{3,}", lines[i + 1].strip()):
            out += ["", f".. rubric:: {text}", ""]
            section, item = True, False
        elif re.fullmatch(r"-{3,}", text):
            continue
        elif not text:
            out.append("")
            item = False
        elif section and not line[:1].isspace() and _ITEM.match(line):
            out += ["", f"* {_escape(text)}"]
            item = True
        else:
            out.append(("  " if item else "") + _escape(text))
    lines[:] = out


def missing_names(app: Any) -> None:  # noqa: ARG001
    """Every public name stands in api.md; one that does not is a warning, hence an error of the build."""
    from sphinx.util import logging

    listed = Path(__file__).with_name("api.md").read_text()
    for package in ("polinfer", "fibre", "acquisition"):
        for name in importlib.import_module(package).__all__:
            if f"`{package}.{name}`" not in listed and f".. automodule:: {package}.{name}" not in listed:
                logging.getLogger(__name__).warning("api.md does not list %s.%s", package, name)


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", plain_docstring)
    app.connect("builder-inited", missing_names)
