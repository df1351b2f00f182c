"""Keeps out what matplotlib inherits from the user's environment and that figures in files cannot be drawn with."""

import importlib
import os
import sys
from typing import Any

BACKEND_VARIABLE = "MPLBACKEND"
# LaTeX may be missing, and takes the `_` of our names for a subscript.
PLAIN_TEXT_STYLE: Any = {"text.usetex": False}


def import_matplotlib() -> None:
    """Import matplotlib, unless the program has done so, whatever window library MPLBACKEND names.

    Notebooks and editors leave a value there that other environments do not know; then the import fails.
    """
    if "matplotlib" in sys.modules:
        return
    backend_name = os.environ.pop(BACKEND_VARIABLE, None)
    try:
        importlib.import_module("matplotlib")
    finally:
        if backend_name is not None:
            os.environ[BACKEND_VARIABLE] = backend_name
