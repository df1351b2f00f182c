"""One emulated drive as a process on its bus, which a program controls, with the drive's own log."""

import contextlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snakesim_drivers.emulation.emulator_child import start_python_emulator
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.scenario import RunConfig, write_config

READY_TEXT = " ready: "  # each command prints it when its drives are on the bus
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
        self,
        config: RunConfig,
        channel: str,
        folder: Path,
        sets: Sequence[str],
        module: Sequence[str],
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
        self._log_path.unlink(missing_ok=True)
        config_path = folder / "drive.json"
        write_config(config, config_path)
        options = [option for text in sets for option in ("--set", text)]
        arguments = [
            "drive",
            "emulate",
            config.backend,
            str(config_path),
            "--channel",
            channel,
            *options,
        ]
        arguments += [
            "--interactive",
            "--drive-log",
            str(self._log_path),
            "--parent",
            str(os.getpid()),
        ]
        if config.backend == "can":
            arguments += ["--pose", "none"]
        self._child = start_python_emulator(["-m", *module, *arguments], folder / "drive.txt")
        if not self._child.wait_until_ready(READY_TEXT):
            output = self._child.read_output().strip().splitlines()[-5:]
            self.close()
            raise BackendError(
                "the emulated drive did not start:", *output, code="emulator/not-started"
            )

    def type_fault(self, text: str) -> int:
        """Type a fault such as `cut bus_1 off`, and return when, by the monotonic clock in ns.

        Raises:
            BackendError: The process has ended.
        """
        now_ns = time.monotonic_ns()
        try:
            self._child.write_line(text)
        except OSError as error:
            raise BackendError(
                f"the emulated drive has ended: {error}", code="emulator/not-started"
            ) from error
        return now_ns

    def read_log(self) -> list[LoggedState]:
        """Return the whole log of the drive, oldest first."""
        states: list[LoggedState] = []
        with contextlib.suppress(OSError):
            for line in self._log_path.read_text(encoding="utf-8").splitlines(keepends=True):
                if not line.endswith("\n"):  # still being written
                    continue
                values = json.loads(line)
                states.append(
                    LoggedState(
                        values["monotonic_ns"], values["enabled"][0], values["angle_rad"][0]
                    )
                )
        return states

    def close(self) -> None:
        """End the process."""
        self._child.stop()
