"""One emulated drive as a process on its bus, which a program controls, with the drive's own log."""

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.errors import BackendError
from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.service import SERVICE_START_LIMIT_S

READY_TEXT = " ready: "  # each command prints it when its drives are on the bus
STOP_TIMEOUT_S = 5.0
POLL_PERIOD_S = 0.02
SNAKESIM_MODULE = ("snakesim_operator",)


@dataclass(frozen=True)
class LoggedState:
    """One line of the drive's log."""

    monotonic_ns: int
    is_enabled: bool
    angle_rad: float


class EmulatedDrive:
    """`snakesim drive emulate` as a child that dies with this process."""

    def __init__(
        self, config: RunConfig, channel: str, folder: Path, sets: Sequence[str], module: Sequence[str]
    ) -> None:
        """Start the process, and wait until the drive is on its bus.

        Args:
            config: Configuration of the run.
            channel: Bus on which it is emulated.
            folder: Folder for its log and its output.
            sets: `KEY=VALUE` of the emulated drive alone.
            module: Python module, with its first arguments, that has the commands of `snakesim`.

        Raises:
            BackendError: The process ended at once, or was not ready in time.
        """
        self._log_path = folder / "drive.log"
        self._output_path = folder / "drive.txt"
        self._log_path.unlink(missing_ok=True)
        config_path = folder / "drive.json"
        write_config(config, config_path)
        options = [option for text in sets for option in ("--set", text)]
        arguments = ["drive", "emulate", config.backend, str(config_path), "--channel", channel, *options]
        arguments += ["--interactive", "--drive-log", str(self._log_path), "--parent", str(os.getpid())]
        if config.backend == "can":
            arguments += ["--pose", "none"]
        with self._output_path.open("wb") as output:
            self._process = subprocess.Popen(
                make_python_command("-m", *module, *arguments),
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=make_child_environment({"PYTHONUNBUFFERED": "1"}),
                start_new_session=True,
            )
        self._wait_until_ready()

    def _wait_until_ready(self) -> None:
        deadline_s = time.monotonic() + SERVICE_START_LIMIT_S
        while time.monotonic() < deadline_s and self._process.poll() is None:
            if READY_TEXT in self._read_output():
                return
            time.sleep(POLL_PERIOD_S)
        output = self._read_output().strip().splitlines()[-5:]
        self.close()
        raise BackendError("the emulated drive did not start:", *output, code="emulator/not-started")

    def _read_output(self) -> str:
        with contextlib.suppress(OSError):
            return self._output_path.read_text(encoding="utf-8", errors="replace")
        return ""

    def type_fault(self, text: str) -> int:
        """Type a fault such as `cut bus_1 off`, and return when, by the monotonic clock in ns.

        Raises:
            BackendError: The process has ended.
        """
        assert self._process.stdin is not None
        now_ns = time.monotonic_ns()
        try:
            self._process.stdin.write(f"{text}\n".encode())
            self._process.stdin.flush()
        except OSError as error:
            raise BackendError(f"the emulated drive has ended: {error}", code="emulator/not-started") from error
        return now_ns

    def read_log(self) -> list[LoggedState]:
        """Return the whole log of the drive, oldest first."""
        states: list[LoggedState] = []
        with contextlib.suppress(OSError):
            for line in self._log_path.read_text(encoding="utf-8").splitlines(keepends=True):
                if not line.endswith("\n"):  # still being written
                    continue
                values = json.loads(line)
                states.append(LoggedState(values["monotonic_ns"], values["enabled"][0], values["angle_rad"][0]))
        return states

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
