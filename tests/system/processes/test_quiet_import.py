"""What a program's own MuJoCo draws with is left to the program, also after our simulator has been loaded."""

import os
import subprocess
import sys

import pytest

IMPORTED = """
import os, sys
import snakesim_sim_backend.model.build
import mujoco
from mujoco.rendering.classic import gl_context
assert "glfw" not in sys.modules, "it has searched for a window library"
print(os.environ.get("MUJOCO_GL"))
"""
CONTEXT = "print(gl_context.GLContext.__module__, mujoco.GLContext is gl_context.GLContext)"


def run_python(code: str, mujoco_gl: str | None) -> list[str]:
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    if mujoco_gl is not None:
        environment["MUJOCO_GL"] = mujoco_gl
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize(
    ("mujoco_gl", "context"), [(None, "mujoco.glfw True"), ("egl", "mujoco.egl True")]
)
def test_the_choice_of_opengl_stays_that_of_the_program(
    mujoco_gl: str | None, context: str
) -> None:
    assert run_python(IMPORTED + CONTEXT, mujoco_gl) == [str(mujoco_gl), context]


def test_a_library_that_is_missing_keeps_no_simulator_from_running() -> None:
    assert run_python(IMPORTED, "osmesa") == ["osmesa"]


def test_off_stays_off() -> None:
    asked = "print(hasattr(mujoco, 'GLContext'), hasattr(mujoco, 'Renderer'))"
    assert run_python(IMPORTED + asked, "off") == ["off", "False True"]
