"""The backend `can`: joint modules as a driver type of the driver kit, with sensors of their own."""

from snakesim_can_backend.bus.adapter import check_channels
from snakesim_can_backend.bus.load import check_load, reports_of
from snakesim_can_backend.driver.modules import Modules
from snakesim_can_backend.driver.own_emulators import check_emulators, check_faults
from snakesim_can_backend.driver.parameters import check_drives, check_ratings, check_watchdog
from snakesim_can_backend.driver.sensors import Sensors, described
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.mounted import check_mounted
from snakesim_drivers.kit.drive_backend import DriveBackend, DriverClock
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import check_pose, make_receiver
from snakesim_hal.backend import Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import ClockMode, LifecycleState, SensorDescription

NAME = "can"


class CanBackend(DriveBackend):
    """A `snakesim_hal.backend.Backend` on joint modules, real or emulated."""

    Settings = CanSettings
    reset_grace_cycles = 0  # the monitor has its own grace for each kind of fault
    modules: Modules
    _sensors: Sensors

    @staticmethod
    def check(config: RunConfig, settings: CanSettings) -> tuple[ClockMode, ...]:
        """Real modules support real time only; emulators that it starts support lockstep. Raises ConfigError."""
        check_load(config, settings)
        check_gains(config.robot)
        check_drives(config.robot, settings)
        check_mounted(
            config.robot, config.backend_section, settings.mounted, emulators=settings.emulators_run != "none"
        )
        check_ratings(config.robot)
        check_watchdog(config, settings)
        check_pose(config, settings.pose_listen)
        check_emulators(config, settings)
        check_faults(config, settings)
        check_channels(settings.channels)
        return ("realtime",) if settings.emulators_run == "none" else ("lockstep", "realtime")

    def __init__(self, config: RunConfig, settings: CanSettings) -> None:
        """Open the buses and find every module; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        clock, emulators = DriverClock(config), settings.emulators_run != "none"
        mocap = make_receiver(
            config, settings.pose_listen, emulators=emulators, clock=lambda _timestamp_ns: clock.now_ns()
        )
        self._reports = reports_of(config, settings)

        def make_modules(readings: DriveReadings) -> Modules:
            pose = mocap.address if mocap is not None else None
            self.modules = Modules(config, settings, clock, pose, readings)
            self._sensors = Sensors(config, self._reports, self.modules.reading, mocap)
            return self.modules

        watchdogs_s = [settings.watchdog_s] * len(config.robot.joint_table)
        super().__init__(config, NAME, "+".join(settings.channels), clock, mocap, make_modules, watchdogs_s)

    def _send_lifecycle(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        self.modules.announce(lifecycle, isolated)

    def _make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        return self._sensors.sample(tick, timestamp_ns)

    def _find_silent_drives(self) -> list[Finding]:
        return []  # the monitor finds it, by the answers to Syncs

    def _describe_sensors(self, config: RunConfig, pose_delay_s: float | None) -> list[SensorDescription]:
        return described(config, self._reports, pose_delay_s=pose_delay_s)
