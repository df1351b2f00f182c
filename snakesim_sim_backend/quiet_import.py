"""Imports MuJoCo without its search for a window library, and leaves the choice of OpenGL to who draws.

When it is imported, MuJoCo loads the OpenGL library that MUJOCO_GL names. Without that variable it starts a Python
process to search for a window library: 0.1 s at every start, and a traceback after Ctrl-C. With `osmesa` and no such
library the import fails, although nothing may be drawn. Our cameras open what they need themselves.
"""

import importlib
import os
import sys
from typing import Any

MUJOCO_GL = "MUJOCO_GL"
CONTEXT = "GLContext"
CHOOSER = "mujoco.rendering.classic.gl_context"  # chooses the context class by MUJOCO_GL, when it is imported
HAVE_THE_CONTEXT = ("mujoco", "mujoco.gl_context", CHOOSER)


def import_mujoco() -> None:
    """Import MuJoCo, unless the program has done so. Others get `mujoco.GLContext` when they ask for it."""
    if "mujoco" in sys.modules:
        return
    asked = os.environ.get(MUJOCO_GL)
    os.environ[MUJOCO_GL] = "off"
    try:
        for name in HAVE_THE_CONTEXT:
            importlib.import_module(name)
    finally:
        if asked is None:
            del os.environ[MUJOCO_GL]
        else:
            os.environ[MUJOCO_GL] = asked
    for name in HAVE_THE_CONTEXT:
        vars(sys.modules[name])["__getattr__"] = _load_context


def _load_context(name: str) -> Any:
    """Choose the context class as MuJoCo does; Python calls this for an attribute that a module does not have."""
    if name != CONTEXT:
        raise AttributeError(f"module 'mujoco' has no attribute {name!r}")
    chosen = vars(importlib.reload(sys.modules[CHOOSER]))
    if CONTEXT not in chosen:
        raise AttributeError(
            f"module 'mujoco' has no attribute {CONTEXT!r}: {MUJOCO_GL} is {os.environ.get(MUJOCO_GL)}"
        )
    for module in HAVE_THE_CONTEXT:
        vars(sys.modules[module]).pop("__getattr__", None)
        setattr(sys.modules[module], CONTEXT, chosen[CONTEXT])
    return chosen[CONTEXT]
