"""The tests in this folder compile the reference firmware of joint modules.

They are skipped if there is no C compiler. In CI a missing compiler is an error, because skipped tests would hide
that the firmware was not tested.
"""

import os
from pathlib import Path

import pytest

from snakesim_native.compile import NO_COMPILER, CannotCompileError, list_compilers
from snakesim_native.programs import (
    JOINT_MODULE_REPLAY,
    JOINT_MODULES,
    SANITIZER_FLAGS,
    NativeProgram,
    get_program,
)

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if list_compilers() or os.environ.get("CI"):
        return
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(
                pytest.mark.skip(reason=f"the reference firmware is in C, and {NO_COMPILER}")
            )


@pytest.fixture(scope="session", params=["plain", "sanitized"])
def replay(request: pytest.FixtureRequest) -> Path:
    """Provide the program that runs the firmware on events, without and with checks of every memory access."""
    if request.param == "plain":
        return get_program(JOINT_MODULE_REPLAY)
    return get_sanitized_program(JOINT_MODULE_REPLAY)


@pytest.fixture(scope="session")
def sanitized_modules() -> Path:
    """Provide the program that emulates a robot, with checks of every memory access."""
    return get_sanitized_program(JOINT_MODULES)


def get_sanitized_program(program: NativeProgram) -> Path:
    """Compile a program with sanitizers, or skip the test if the compiler has none."""
    try:
        return get_program(program, SANITIZER_FLAGS)
    except CannotCompileError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(f"the C compiler has no sanitizers: {error}")
