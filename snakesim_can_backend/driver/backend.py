"""The backend `can`: joint modules as a driver type of the driver kit, with contact sensors and IMUs."""

from snakesim_can_backend.bus.adapter import check_channels
from snakesim_can_backend.bus.load import check_load, plan_reports
from snakesim_can_backend.driver.modules import JointModules
from snakesim_can_backend.driver.own_emulators import check_emulators, check_faults
from snakesim_can_backend.driver.parameters import check_drives, check_ratings, check_watchdog
from snakesim_can_backend.driver.sensors import SampleBuilder, describe_sensors
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import check_mounted
from snakesim_drivers.kit.drive_backend import DriveBackend, DriveBackendParts, DriverClock
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import check_pose, make_receiver
from snakesim_hal.backend import Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import ClockMode, LifecycleState, SensorDescription

NAME = "can"


class CanBackend(DriveBackend):
    """The backend on joint modules, real or emulated."""

    Settings = CanSettings
    reset_grace_cycles = 0  # the monitor itself gives modules time to follow a reset
    modules: JointModules
    _sample_builder: SampleBuilder

    @classmethod
    def check(cls, config: RunConfig, settings: CanSettings) -> tuple[ClockMode, ...]:
        """Check that a run is possible with these settings, before a bus is opened.

        Args:
            config: configuration of the run.
            settings: settings of this backend.

        Returns:
            The supported clock modes: real time only on real modules, and lockstep too on emulators of this driver.

        Raises:
            ConfigError: it is not possible; the message has the reason, and what to change.
        """
        has_emulators = settings.emulators_run != "none"
        check_load(config, settings)
        check_gains(config.robot)
        check_drives(config.robot, settings)
        check_mounted(config.robot, config.backend_section, settings.mounted, emulators=has_emulators)
        check_ratings(config.robot)
        check_watchdog(config, settings)
        check_pose(config, settings.pose_listen)
        check_emulators(config, settings)
        check_faults(config, settings)
        check_channels(settings.channels)
        if has_emulators:
            return ("lockstep", "realtime")
        return ("realtime",)

    def __init__(self, config: RunConfig, settings: CanSettings) -> None:
        """Open the buses and find every joint module; no module is enabled.

        Args:
            config: configuration of the run.
            settings: settings of this backend, with its channels.

        Raises:
            ConfigError: the run is not possible with these settings.
            BackendError: a bus cannot be opened, or a module is missing.
        """
        self.check(config, settings)
        clock = DriverClock(config)
        has_emulators = settings.emulators_run != "none"
        mocap = make_receiver(
            config, settings.pose_listen, emulators=has_emulators, clock=lambda _timestamp_ns: clock.now_ns()
        )
        self._reports = plan_reports(config, settings)

        def open_modules(readings: DriveReadings) -> JointModules:
            pose = mocap.address if mocap is not None else None
            self.modules = JointModules(config, settings, clock, pose, readings)
            self._sample_builder = SampleBuilder(config, self._reports, self.modules.reading, mocap)
            return self.modules

        parts = DriveBackendParts(
            name=NAME,
            hardware="+".join(settings.channels),
            clock=clock,
            mocap=mocap,
            open_drives=open_modules,
            watchdogs_s=[settings.watchdog_s] * len(config.robot.joint_table),
        )
        super().__init__(config, parts)

    def _send_lifecycle(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        self.modules.announce(lifecycle, isolated)

    def _make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        return self._sample_builder.make_samples(tick, timestamp_ns)

    def _find_silent_drives(self) -> list[Finding]:
        return []  # the monitor finds silent modules, by their answers to Syncs

    def _describe_sensors(self, config: RunConfig, pose_delay_s: float | None) -> list[SensorDescription]:
        return describe_sensors(config, self._reports, pose_delay_s=pose_delay_s)
