"""Imports MuJoCo without its search for a window library, and leaves the choice of OpenGL to the program that draws.

When it is imported, MuJoCo loads the OpenGL library that the variable MUJOCO_GL names. Without that variable it starts
a Python process to search for a window library: 0.1 s at every start, and a traceback after Ctrl-C. With `osmesa` and
no such library the import fails, although nothing may be drawn. The cameras of this package open the library that they
need themselves.
"""

import importlib
import os
import sys
from typing import Any

MUJOCO_GL = "MUJOCO_GL"
CONTEXT = "GLContext"
CHOOSING_MODULE = "mujoco.rendering.classic.gl_context"  # chooses the context class by MUJOCO_GL, when it is imported
MODULES_WITH_CONTEXT = ("mujoco", "mujoco.gl_context", CHOOSING_MODULE)


def import_mujoco() -> None:
    """Import MuJoCo, unless the program has done so. `mujoco.GLContext` is loaded when a program uses it."""
    if "mujoco" in sys.modules:
        return
    requested_backend = os.environ.get(MUJOCO_GL)
    os.environ[MUJOCO_GL] = "off"
    try:
        for name in MODULES_WITH_CONTEXT:
            importlib.import_module(name)
    finally:
        if requested_backend is None:
            del os.environ[MUJOCO_GL]
        else:
            os.environ[MUJOCO_GL] = requested_backend
    for name in MODULES_WITH_CONTEXT:
        vars(sys.modules[name])["__getattr__"] = _load_context


def _load_context(name: str) -> Any:
    """Choose the context class as MuJoCo does; Python calls this for an attribute that a module does not have."""
    if name != CONTEXT:
        raise AttributeError(f"module 'mujoco' has no attribute {name!r}")
    attributes = vars(importlib.reload(sys.modules[CHOOSING_MODULE]))
    if CONTEXT not in attributes:
        raise AttributeError(
            f"module 'mujoco' has no attribute {CONTEXT!r}: {MUJOCO_GL} is {os.environ.get(MUJOCO_GL)}"
        )
    for module in MODULES_WITH_CONTEXT:
        vars(sys.modules[module]).pop("__getattr__", None)
        setattr(sys.modules[module], CONTEXT, attributes[CONTEXT])
    return attributes[CONTEXT]
