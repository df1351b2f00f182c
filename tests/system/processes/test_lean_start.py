"""The processes of a run import no libraries that they do not use, so that they start quickly."""

import subprocess
import sys

CHECK_IMPORTS_CODE = """
import sys
import {module}
imported = [name for name in {unused} if name in sys.modules]
assert not imported, imported
"""
# Together they need more than 100 ms of processor time in each process.
UNUSED_BY_SERVICES = ["numpy.random", "mujoco", "mcap", "jinja2"]


def run_python(code: str) -> None:
    """Run code in a new process and check that it raises no error."""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_service_program_imports_no_unused_library() -> None:
    module = "snakesim_hal.programs.service_program"
    run_python(CHECK_IMPORTS_CODE.format(module=module, unused=UNUSED_BY_SERVICES))


def test_recording_reader_imports_no_library_for_viewers() -> None:
    module = "snakesim_operator.recording.reader"
    run_python(CHECK_IMPORTS_CODE.format(module=module, unused=["google.protobuf"]))
