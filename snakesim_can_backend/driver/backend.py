"""The backend `can`: joint modules as a driver type of the driver kit, with contact sensors and IMUs."""

from snakesim_can_backend.bus.adapter import validate_channels
from snakesim_can_backend.bus.load import plan_reports, validate_bus_load
from snakesim_can_backend.driver.modules import JointModules
from snakesim_can_backend.driver.own_emulators import (
    validate_emulator_settings,
    validate_fault_plan,
)
from snakesim_can_backend.driver.parameters import (
    validate_joint_drives,
    validate_ratings,
    validate_watchdog,
)
from snakesim_can_backend.driver.probe import ModuleProbe
from snakesim_can_backend.driver.sensors import SampleBuilder, describe_sensors
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import validate_mounting_overrides
from snakesim_drivers.kit.drive_backend import DriveBackend, DriveBackendParts, DriverClock
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import make_receiver, validate_pose_settings
from snakesim_hal.backend import Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import validate_position_gains
from snakesim_hal.wire.messages import ClockMode, LifecycleState, SensorDescription

NAME = "can"


class CanBackend(DriveBackend):
    """The backend on joint modules, real or emulated."""

    Settings = CanSettings
    reset_grace_cycles = 0  # the monitor itself gives modules time to follow a reset
    modules: JointModules
    _sample_builder: SampleBuilder

    @classmethod
    def open_probe(cls, config: RunConfig, settings: CanSettings) -> ModuleProbe:
        return ModuleProbe(config, settings)

    @classmethod
    def check(cls, config: RunConfig, settings: CanSettings) -> tuple[ClockMode, ...]:
        """Check that a run is possible with these settings, before a bus is opened.

        Args:
            config: Configuration of the run.
            settings: Settings of this backend.

        Returns:
            The supported clock modes: real modules support real time only, and emulators of this driver support
            lockstep, too.

        Raises:
            ConfigError: The run is not possible; the message has the reason, and what to change.
        """
        has_emulators = settings.emulators_run != "none"
        validate_bus_load(config, settings)
        validate_position_gains(config.robot)
        validate_joint_drives(config.robot, settings)
        validate_mounting_overrides(
            config.robot, config.backend_section, settings.mounted, are_emulated=has_emulators
        )
        validate_ratings(config.robot)
        validate_watchdog(config, settings)
        validate_pose_settings(config, settings.pose_listen)
        validate_emulator_settings(config, settings)
        validate_fault_plan(config, settings)
        validate_channels(settings.channels, is_emulator=settings.emulators_run == "process")
        if has_emulators:
            return ("lockstep", "realtime")
        return ("realtime",)

    def __init__(self, config: RunConfig, settings: CanSettings) -> None:
        """Open the buses and find every joint module; no module is enabled.

        Args:
            config: Configuration of the run.
            settings: Settings of this backend, with its channels.

        Raises:
            ConfigError: The run is not possible with these settings.
            BackendError: A bus cannot be opened, or a module is missing.
        """
        self.check(config, settings)
        clock = DriverClock(config)
        # The reference firmware has no world to see.
        sends_pose = settings.emulators_run in ("here", "process")
        mocap = make_receiver(
            config,
            settings.pose_listen,
            are_emulated=sends_pose,
            clock=lambda _timestamp_ns: clock.now_ns(),
        )
        self._reports = plan_reports(config, settings)

        def open_modules(readings: DriveReadings) -> JointModules:
            pose_address = mocap.address if mocap is not None else None
            self.modules = JointModules(config, settings, clock, pose_address, readings)
            self._sample_builder = SampleBuilder(
                config, self._reports, self.modules.module_reports, mocap
            )
            return self.modules

        parts = DriveBackendParts(
            name=NAME,
            hardware="+".join(settings.channels),
            clock=clock,
            mocap=mocap,
            open_drives=open_modules,
            watchdog_timeouts_s=[settings.watchdog_s] * len(config.robot.joint_table),
        )
        super().__init__(config, parts)

    def _send_lifecycle_state(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        self.modules.send_lifecycle_commands(lifecycle, isolated)

    def _make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        return self._sample_builder.make_samples(tick, timestamp_ns)

    def _find_silent_drives(self) -> list[FaultFinding]:
        return []  # the monitor finds silent modules, by their answers to Syncs

    def _describe_sensors(
        self, config: RunConfig, pose_delay_s: float | None
    ) -> list[SensorDescription]:
        return describe_sensors(config, self._reports, pose_delay_s=pose_delay_s)
