"""Emulated joint modules that a driver starts itself: in its own process on a virtual bus, or as a child on vcan."""

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import msgspec

from snakesim_can_backend.bus.bus import VirtualPeer
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.base.process import child_environment, python_command
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.fault_kinds import KINDS, Injection
from snakesim_hal.model.fault_plan import check_backend_can
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.service import SERVICE_START_LIMIT_S

READY = "modules ready"  # a child prints it when its modules are on the bus
STOP_LIMIT_S = 5.0  # after which a child that ignores SIGTERM is killed
POLL_S = 0.02


def check_emulators(config: RunConfig, settings: CanSettings) -> None:
    """Check that the settings of emulators fit the channels and the faults of a run.

    Args:
        config: the run, with the robot.
        settings: settings of the backend.

    Raises:
        ConfigError: emulators in the driver have real channels, emulators in a process have none, or a fault is
            invalid.
    """
    from snakesim_can_backend.emulator.faults import parse_fault

    if settings.emulators_run == "here" and settings.channels:
        raise ConfigError(
            f'`backends.can.emulators` = "here" is a virtual bus inside the driver, and `channels` = '
            f"{settings.channels} "
            f'names real ones: leave `channels` empty, or set emulators = "process"',
            code="bus/not-virtual",
        )
    if settings.emulators_run != "here" and not settings.channels:
        raise ConfigError(
            f'`backends.can.emulators` = "{settings.emulators_run}" needs a bus: name it in '
            "`backends.can.channels`, such as "
            f'["vcan0"]',
            code="bus/not-virtual",
        )
    if settings.faults and settings.emulators_run == "none":
        raise ConfigError(
            "`backends.can.faults` are for emulators; give them to `snakesim drive emulate can --fault` instead",
            code="injection/not-supported",
        )
    for text in settings.faults:
        parse_fault(text, config.robot.chain.modules)


def check_faults(config: RunConfig, settings: CanSettings) -> None:
    """Check that the planned faults of joints and buses are possible. Raises ConfigError."""
    from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS

    has_emulators = settings.emulators_run != "none"
    has_virtual_bus = not settings.channels
    supported = set(KINDS["bus"]) - {"slow"}
    reason = "its modules are not the driver's own emulators"
    if has_emulators:
        supported |= set(FAULT_DESCRIPTIONS)
        reason = f"its modules support {', '.join(FAULT_DESCRIPTIONS)}"
    if not has_virtual_bus:
        supported -= {"full"}
        reason += "; and a program cannot fill the queue of a kernel interface"
    check_backend_can(config, does=supported, buses=max(len(settings.channels), 1), because=reason)


def supports_fault(injection: Injection, joints: int) -> bool:
    """Return whether emulated joint modules support a fault. Raises ConfigError for an unknown joint."""
    from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS, check_fault

    if injection.target_type != "joint" or injection.kind not in FAULT_DESCRIPTIONS:
        return False
    check_fault(injection, joints)
    return True


def start_local_emulators(
    config: RunConfig, settings: CanSettings, channel: str, pose: str | None, *, stepped: bool
) -> VirtualPeer:
    """Start emulators of all joint modules at the other end of a virtual bus, in this process.

    Args:
        config: the run, with the robot.
        settings: settings of the backend.
        channel: name of the virtual bus.
        pose: address, HOST:PORT, to which they send motion capture; None: nowhere.
        stepped: whether their time advances only from Sync to Sync.

    Returns:
        A function that runs them.
    """
    from snakesim_can_backend.emulator.server import make_local_emulators

    return make_local_emulators(config, settings, channel, pose, stepped=stepped)


class EmulatorProcess:
    """`snakesim drive emulate can` as a child that dies with this process."""

    def __init__(self, config: RunConfig, settings: CanSettings, pose: str | None, *, stepped: bool) -> None:
        """Start `snakesim drive emulate can` as a child process, and wait until its modules are on the bus.

        Args:
            config: the run, with the robot.
            settings: settings of the backend, which replace those in the configuration.
            pose: address, HOST:PORT, to which the child sends motion capture; None: nowhere.
            stepped: whether the emulators' time advances only from Sync to Sync.

        Raises:
            BackendError: the child cannot be started, or ended at once.
        """
        backends = {**config.backends, "can": msgspec.to_builtins(settings)}
        child_config = msgspec.structs.replace(config, backends=backends)
        arguments = ["--parent", str(os.getpid()), "--pose", pose or "none"]
        for channel in settings.channels:
            arguments += ["--channel", channel]
        if stepped:
            arguments.append("--stepped")
        try:
            self._folder = tempfile.TemporaryDirectory(prefix="snakesim-emulators-", ignore_cleanup_errors=True)
            self._output = Path(self._folder.name, "modules.log")
            self._process = self._start(child_config, arguments)
        except OSError as error:
            raise BackendError(
                f"the emulated joint modules cannot be started: {error}", code="emulator/not-started"
            ) from error
        self._await_ready()

    def _start(self, config: RunConfig, arguments: list[str]) -> subprocess.Popen[bytes]:
        config_path = Path(self._folder.name, "config.json")
        write_config(config, config_path)
        module = "snakesim_can_backend.emulator.command"
        with self._output.open("wb") as output:
            return subprocess.Popen(
                python_command("-m", module, str(config_path), *arguments, "--interactive"),
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=child_environment({"PYTHONUNBUFFERED": "1"}),
                start_new_session=True,
            )

    def _await_ready(self) -> None:
        """Wait until the child prints READY. Raises BackendError."""
        end_s = time.monotonic() + SERVICE_START_LIMIT_S
        while time.monotonic() < end_s:
            with contextlib.suppress(OSError):
                if READY in self._output.read_text(encoding="utf-8", errors="replace"):
                    return
            if self._process.poll() is not None:
                break
            time.sleep(POLL_S)
        self.stop()
        raise BackendError(
            "the emulated joint modules did not start; see their output above", code="emulator/not-started"
        )

    def describe_exit(self) -> str | None:
        """Return a sentence about the exit of the child; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        return f"the emulated joint modules have ended, with exit code {code}"

    def inject(self, fault: Injection, *, begins: bool) -> None:
        """Begin or end a fault of a module. Raises BackendError if the child has ended."""
        from snakesim_can_backend.emulator.faults import format_typed_fault

        assert self._process.stdin is not None
        line = f"{format_typed_fault(fault, begins=begins)}\n"
        try:
            self._process.stdin.write(line.encode())
            self._process.stdin.flush()
        except (OSError, ValueError) as error:  # the latter when it was stopped
            raise BackendError(
                f"the emulated joint modules do not accept {fault}: {error}", code="injection/not-supported"
            ) from error

    def stop(self) -> None:
        """Terminate the child, and kill it if it does not end. Its output is this process's stderr."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        with contextlib.suppress(OSError):  # an unreadable log does not prevent ending
            for line in self._output.read_text(encoding="utf-8", errors="replace").splitlines():
                print_stderr(line)
        self._folder.cleanup()
