"""A backend over drives of one type, or of several: settings, checks before a start, and the buses that it opens.

A driver type is a class below `DriverTypeBackend`. As a backend it has all joints of a robot; beside others, in
`mixed`, those whose `driver` is its name.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.buses import Bus, Buses
from snakesim_drivers.kit.drive_backend import DriveBackend, DriverClock, Drives
from snakesim_drivers.kit.drive_settings import (
    DriveSettings,
    assign_ports,
    check_body,
    check_buses,
    joint_label,
    make_body,
)
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import make_receiver
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import check_gains
from snakesim_hal.wire.messages import ClockMode


@dataclass(frozen=True)
class DriverTypePart:
    """The joints of a robot that are of one driver type."""

    driver_type: "type[DriverTypeBackend]"
    settings: Any  # the driver_type's own `Settings`
    section: str  # where they are in the scenario
    joints: Mapping[int, Joint]  # by their numbers in the robot

    @property
    def ports(self) -> Sequence[str]:
        """Its buses."""
        return self.driver_type.ports(self.settings)


class DriverTypeBackend(DriveBackend):
    """A `snakesim_hal.backend.Backend` on drives, real or emulated. A driver type gives what is declared first."""

    Settings: ClassVar[type[Any]]  # `BodySettings`; of drives, `DriveSettings`
    name: ClassVar[str]  # of the backend, and of the driver type in a robot file

    @classmethod
    def ports(cls, settings: Any) -> Sequence[str]:
        """Names of the buses in its settings; empty: its drives are emulated, here."""
        raise NotImplementedError

    @classmethod
    def bus_faults(cls, settings: Any) -> Collection[str]:
        """Kinds that can be injected into its buses."""
        raise NotImplementedError

    @classmethod
    def check_drives(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Raise ConfigError for joints that no drive of this type can be, and for buses that cannot carry them."""
        raise NotImplementedError

    @classmethod
    def buses(
        cls,
        config: RunConfig,
        settings: Any,
        joints: Mapping[int, Joint],
        clock: DriverClock,
        body: EmulatedBody | None,
    ) -> list[Bus]:
        """Each bus that has some of the joints. body: of these joints, if their drives are emulated here."""
        raise NotImplementedError

    # --- of all driver types ----------------------------------------------------------------------------------------

    @classmethod
    def split_by_driver_type(cls, config: RunConfig, settings: Any) -> list[DriverTypePart]:
        """The robot, by driver types. Raises ConfigError."""
        joints = dict(enumerate(config.robot.joint_table))
        for joint in joints.values():
            if joint.drive.driver not in ("", cls.name):
                raise ConfigError(
                    f"{joint_label(config, joint)}: `driver` = {joint.drive.driver!r} in the robot file, and backend "
                    f"{config.backend!r} drives {cls.name} alone; correct it, or take the backend `mixed`"
                )
        return [DriverTypePart(cls, settings, config.backend_section, joints)]

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[ClockMode, ...]:
        """Drives on a bus support real time only; emulated ones in this process lockstep, too. Raises ConfigError."""
        check_gains(config.robot)
        parts = cls.split_by_driver_type(config, settings)
        here = not any(part.ports for part in parts)
        bus_faults = set[str].intersection(*({*part.driver_type.bus_faults(part.settings)} for part in parts))
        buses = sum(max(len(part.ports), 1) for part in parts)
        check_body(config, settings, emulators=here, buses=buses, bus_faults=bus_faults)
        for part in parts:
            joints = list(part.joints.values())
            check_buses(config, part.settings, part.section, joints, part.ports)
            part.driver_type.check_drives(config, part.settings, joints)
        return ("lockstep", "realtime") if here else ("realtime",)

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Open the buses and find every drive; nothing is enabled. Raises ConfigError and BackendError."""
        self.check(config, settings)
        parts, clock = self.split_by_driver_type(config, settings), DriverClock(config)
        here = not any(part.ports for part in parts)
        mocap = make_receiver(config, settings.pose_listen, emulators=here, clock=lambda _timestamp_ns: clock.now_ns())

        def open_buses(readings: DriveReadings) -> Buses:
            pose = mocap.address if mocap is not None else None
            whole = make_body(config, settings, self.name, pose) if here else None
            buses: list[Bus] = []
            for part in parts:
                body = whole.select(list(part.joints)) if whole is not None else None
                buses += part.driver_type.buses(config, part.settings, part.joints, clock, body)
            return Buses(config, readings, buses, clock.now_ns)

        hardware = "+".join(port for part in parts for port in part.ports)
        slowest = max(self.decimation(part.settings) for part in parts)
        watchdog_s = {joint: part.settings.watchdog_s for part in parts for joint in part.joints}
        watchdogs_s = [watchdog_s[joint] for joint in range(len(watchdog_s))]
        super().__init__(config, self.name, hardware, clock, mocap, open_buses, watchdogs_s, slowest)

    @staticmethod
    def decimation(settings: DriveSettings) -> int:
        """Of the run: how often its buses ask and tell."""
        return settings.decimation


def group_by_port(
    joints: Mapping[int, Joint],
    settings: DriveSettings,
    ports: Sequence[str],
    open_drives: Callable[[str, Sequence[int], DriveReadings], Drives],
) -> list[Bus]:
    """A bus for each port that has some of the joints, which a driver type opens by its name."""
    on = assign_ports(list(joints.values()), ports)
    found: list[Bus] = []
    for number, port in enumerate(ports):
        mine = tuple(j for j, bus in zip(joints, on, strict=True) if bus == number)
        if mine:
            open_these = partial(open_drives, port, mine)
            found.append(Bus(port, mine, open_these, settings.decimation, settings.watchdog_s))
    return found
