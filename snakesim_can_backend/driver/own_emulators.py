"""Emulated joint modules that a driver starts itself: in its own process on a virtual bus, or as a child on vcan."""

import os
import tempfile
from pathlib import Path

import msgspec

from snakesim_can_backend.bus.bus import VirtualPeer
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.emulator_child import EmulatorChild, start_python_emulator
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.fault_kinds import FAULT_KINDS, FaultInjection
from snakesim_hal.model.fault_plan import validate_faults_for_backend
from snakesim_hal.model.scenario import RunConfig, write_config

READY_TEXT = "modules ready"  # a child prints it when its modules are on the bus


def validate_emulator_settings(config: RunConfig, settings: CanSettings) -> None:
    """Check the settings of emulated joint modules: where they run, their channels, and their injected faults.

    Args:
        config: Configuration of the run, with the robot.
        settings: Settings of the backend.

    Raises:
        ConfigError: One of these conditions is true: emulators have a bus of their own ("here", "firmware") although
            channels are named; modules are elsewhere ("process" or "none") although no channel is named; faults are
            given although there are no emulators ("none"); or a fault is invalid.
    """
    from snakesim_can_backend.emulator.faults import parse_fault
    from snakesim_can_backend.emulator.reference_firmware import validate_firmware_settings

    emulator_location = settings.emulators_run
    if emulator_location == "firmware":
        validate_firmware_settings(settings)
    if emulator_location == "firmware" and settings.channels:
        raise ConfigError(
            f'`backends.can.emulators` = "firmware" has a bus of its own: remove `channels` = {settings.channels}',
            code="bus/not-virtual",
        )
    if emulator_location == "here" and settings.channels:
        raise ConfigError(
            f'`backends.can.emulators` = "here" is a virtual bus inside the driver, and `channels` = '
            f"{settings.channels} names real ones: leave `channels` empty, or set emulators = "
            f'"process"',
            code="bus/not-virtual",
        )
    if emulator_location not in ("here", "firmware") and not settings.channels:
        raise ConfigError(
            f'`backends.can.emulators` = "{emulator_location}" needs a bus: '
            'name it in `backends.can.channels`, such as ["vcan0"]',
            code="bus/not-virtual",
        )
    if settings.faults and emulator_location == "none":
        raise ConfigError(
            "`backends.can.faults` are for emulators; give them to `snakesim drive emulate can --fault` instead",
            code="injection/not-supported",
        )
    for fault_spec in settings.faults:
        parse_fault(fault_spec, config.robot.chain.modules)


def validate_fault_plan(config: RunConfig, settings: CanSettings) -> None:
    """Check that the planned faults of joints and buses are possible. Raises ConfigError."""
    from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS

    has_emulators = settings.emulators_run != "none"
    has_virtual_bus = not settings.channels
    supported = set(FAULT_KINDS["bus"]) - {"slow"}
    reason = "its modules are not the driver's own emulators"
    if has_emulators:
        supported |= set(FAULT_DESCRIPTIONS)
        reason = f"its modules support {', '.join(FAULT_DESCRIPTIONS)}"
    if not has_virtual_bus:
        supported -= {"full"}
        reason += "; and a program cannot fill the queue of a kernel interface"
    validate_faults_for_backend(
        config, supported_kinds=supported, bus_count=max(len(settings.channels), 1), reason=reason
    )


def supports_fault(injection: FaultInjection, joint_count: int) -> bool:
    """Return whether emulated joint modules support a fault. Raises ConfigError for an unknown joint."""
    from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS, validate_fault

    if injection.target_type != "joint" or injection.kind not in FAULT_DESCRIPTIONS:
        return False
    validate_fault(injection, joint_count)
    return True


def start_in_process_emulators(
    config: RunConfig,
    settings: CanSettings,
    channel: str,
    pose_address: str | None,
    *,
    is_stepped: bool,
) -> VirtualPeer:
    """Start emulators of all joint modules at the other end of a virtual bus, in this process.

    Args:
        config: Configuration of the run, with the robot.
        settings: Settings of the backend.
        channel: Name of the virtual bus.
        pose_address: HOST:PORT to which they send motion capture; None if they do not send.
        is_stepped: Whether their time advances only from Sync to Sync.

    Returns:
        The other end of the bus; calling it runs the emulators.
    """
    from snakesim_can_backend.emulator.server import make_in_process_emulators

    return make_in_process_emulators(config, settings, channel, pose_address, is_stepped=is_stepped)


class EmulatorProcess:
    """`snakesim drive emulate can` as a child that dies with this process."""

    def __init__(
        self,
        config: RunConfig,
        settings: CanSettings,
        pose_address: str | None,
        *,
        is_stepped: bool,
    ) -> None:
        """Start `snakesim drive emulate can` as a child process, and wait until its modules are on the bus.

        Args:
            config: Configuration of the run, with the robot.
            settings: Settings of the backend, which replace those in the configuration.
            pose_address: HOST:PORT to which the child sends motion capture; None if it does not send.
            is_stepped: Whether the emulators' time advances only from Sync to Sync.

        Raises:
            BackendError: The child cannot be started, ended at once, or was not ready in time.
        """
        try:
            self._folder = tempfile.TemporaryDirectory(
                prefix="snakesim-emulators-", ignore_cleanup_errors=True
            )
            output_path = Path(self._folder.name, "modules.log")
            self._child = self._start(
                config, settings, pose_address, output_path, is_stepped=is_stepped
            )
        except OSError as error:
            raise BackendError(
                f"the emulated joint modules cannot be started: {error}",
                code="emulator/not-started",
            ) from error
        if not self._child.wait_until_ready(READY_TEXT):
            self.stop()
            raise BackendError(
                "the emulated joint modules did not start; see their output above",
                code="emulator/not-started",
            )

    def _start(
        self,
        config: RunConfig,
        settings: CanSettings,
        pose_address: str | None,
        output_path: Path,
        *,
        is_stepped: bool,
    ) -> EmulatorChild:
        """Write the configuration for the child, and start it. Raises OSError."""
        backends = {**config.backends, "can": msgspec.to_builtins(settings)}
        config_path = Path(self._folder.name, "config.json")
        write_config(msgspec.structs.replace(config, backends=backends), config_path)
        arguments = ["--parent", str(os.getpid()), "--pose", pose_address or "none"]
        for channel in settings.channels:
            arguments += ["--channel", channel]
        if is_stepped:
            arguments.append("--stepped")
        module = "snakesim_can_backend.emulator.command"
        return start_python_emulator(
            ["-m", module, str(config_path), *arguments, "--interactive"], output_path
        )

    def describe_exit(self) -> str | None:
        """Return a sentence about the exit of the child; None while it runs."""
        code = self._child.exit_code
        if code is None:
            return None
        return f"the emulated joint modules have ended, with exit code {code}"

    def inject(self, fault: FaultInjection, *, begins: bool) -> None:
        """Start or end a fault of a module. Raises BackendError if the child has ended."""
        from snakesim_drivers.emulation.emulator_control import format_typed_fault

        try:
            self._child.write_line(format_typed_fault(fault, begins=begins))
        except (OSError, ValueError) as error:  # the latter when it was stopped
            raise BackendError(
                f"the emulated joint modules do not accept {fault}: {error}",
                code="injection/not-supported",
            ) from error

    def stop(self) -> None:
        """Terminate the child, and kill it if it does not end. Its output is this process's stderr."""
        self._child.stop()
        for line in self._child.read_output().splitlines():
            print_stderr(line)
        self._folder.cleanup()
