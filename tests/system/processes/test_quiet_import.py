"""The import of the simulator does not change the OpenGL library with which a user's program renders."""

import os
import subprocess
import sys

import pytest

IMPORT_CODE = """
import os, sys
import snakesim_sim_backend.model.build
import mujoco
from mujoco.rendering.classic import gl_context
assert "glfw" not in sys.modules, "the import has searched for a window library"
print(os.environ.get("MUJOCO_GL"))
"""
PRINT_CONTEXT_CODE = (
    "print(gl_context.GLContext.__module__, mujoco.GLContext is gl_context.GLContext)"
)


def run_python(code: str, mujoco_gl: str | None) -> list[str]:
    """Run code with this value of MUJOCO_GL and return the printed lines."""
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    if mujoco_gl is not None:
        environment["MUJOCO_GL"] = mujoco_gl
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


@pytest.mark.parametrize(
    ("mujoco_gl", "context"), [(None, "mujoco.glfw True"), ("egl", "mujoco.egl True")]
)
def test_simulator_import_keeps_opengl_library_of_program(
    mujoco_gl: str | None, context: str
) -> None:
    assert run_python(IMPORT_CODE + PRINT_CONTEXT_CODE, mujoco_gl) == [str(mujoco_gl), context]


def test_simulator_import_with_missing_opengl_library_succeeds() -> None:
    assert run_python(IMPORT_CODE, "osmesa") == ["osmesa"]


def test_simulator_import_keeps_opengl_switched_off() -> None:
    print_attributes = "print(hasattr(mujoco, 'GLContext'), hasattr(mujoco, 'Renderer'))"
    assert run_python(IMPORT_CODE + print_attributes, "off") == ["off", "False True"]
