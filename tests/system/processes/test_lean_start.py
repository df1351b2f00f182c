"""What the processes of a run import before they begin: nothing that they do not use."""

import subprocess
import sys

NOT_IMPORTED = """
import sys
import {module}
found = [name for name in {unused} if name in sys.modules]
assert not found, found
"""
# Together more than 100 ms of processor time in each process.
UNUSED_BY_SERVICES = ["numpy.random", "mujoco", "mcap", "jinja2"]


def run_python(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_service_imports_no_library_that_it_does_not_use() -> None:
    module = "snakesim_hal.programs.service_program"
    run_python(NOT_IMPORTED.format(module=module, unused=UNUSED_BY_SERVICES))


def test_a_reader_of_recordings_imports_nothing_for_viewers() -> None:
    module = "snakesim_operator.recording.reader"
    run_python(NOT_IMPORTED.format(module=module, unused=["google.protobuf"]))
