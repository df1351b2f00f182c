"""A backend over drives of one type, or of several: settings, checks before a start, and the buses that it opens.

A driver type is a subclass of `DriverTypeBackend`. If it is the backend of a run, it drives all joints of the robot. In
the backend `mixed` it drives those whose `driver` is its name.
"""

from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.buses import RobotBuses
from snakesim_drivers.kit.drive_backend import DriveBackend, DriveBackendParts, DriverClock
from snakesim_drivers.kit.drive_settings import (
    DriveSettings,
    assign_port_indices,
    make_emulated_body,
    make_joint_label,
    validate_body_settings,
    validate_bus_settings,
)
from snakesim_drivers.kit.drives import Drives
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import make_receiver
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint, Measurement
from snakesim_hal.model.robot_file.robot import RobotFile, remove_measurements
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motor import validate_position_gains
from snakesim_hal.wire.messages import ClockMode


@dataclass(frozen=True)
class DriverTypePart:
    """The joints of a robot that are of one driver type."""

    driver_type: "type[DriverTypeBackend]"
    settings: Any  # an instance of the driver type's own `Settings`
    section: str  # where they are in the scenario
    joints: Mapping[int, Joint]  # by their indices in the robot

    @property
    def ports(self) -> Sequence[str]:
        """The names of the buses of this driver type; empty if its drives are emulated in this process."""
        return self.driver_type.list_ports(self.settings)


@dataclass(frozen=True)
class DriverTypeContext:
    """What a driver type gets to plan and open its buses in a robot."""

    config: RunConfig  # the run
    settings: Any  # an instance of the driver type's own `Settings`
    joints: Mapping[int, Joint]  # those that it drives, by their indices in the robot
    clock: DriverClock  # the time of the robot
    # Moved by these joints' drives if they are emulated here (None: they are on a bus).
    body: EmulatedBody | None


class BusesBackend(DriveBackend):
    """A backend on the buses of one driver type or of several: checks before a start, and everything around the buses.

    Not for driver types: they derive from `DriverTypeBackend`.
    """

    name: ClassVar[str]  # of the backend

    @classmethod
    @abstractmethod
    def group_joints_by_driver_type(cls, config: RunConfig, settings: Any) -> list[DriverTypePart]:
        """Return the joints of each driver type in a robot.

        Raises:
            ConfigError: A joint is of no driver type that the backend has.
        """

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[ClockMode, ...]:
        """Check that a run is possible with the drives of its robot, without opening any bus.

        Args:
            config: Configuration of the run.
            settings: Settings of this backend.

        Returns:
            The possible clock modes: drives on a bus support real time only, and emulators in this process support
            lockstep, too.

        Raises:
            ConfigError: The configuration does not suit the drives.
        """
        validate_position_gains(config.robot)
        parts = cls.group_joints_by_driver_type(config, settings)
        are_emulated_in_process = _are_emulated_in_process(parts)
        possible_fault_kinds = [
            {*part.driver_type.list_bus_faults(part.settings)} for part in parts
        ]
        common_fault_kinds = set[str].intersection(*possible_fault_kinds)
        bus_count = sum(max(len(part.ports), 1) for part in parts)
        validate_body_settings(
            config,
            settings,
            are_emulated=are_emulated_in_process,
            bus_count=bus_count,
            bus_fault_kinds=common_fault_kinds,
        )
        for part in parts:
            joints = list(part.joints.values())
            validate_bus_settings(config, part.settings, part.section, joints, part.ports)
            part.driver_type.check_drives(config, part.settings, joints)
        return ("lockstep", "realtime") if are_emulated_in_process else ("realtime",)

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Open the buses of all driver types and bring up every drive; no drive is enabled.

        Without channels in the settings, the drives are emulated in this process, on one body.

        Args:
            config: Configuration of the run.
            settings: Settings of this backend.

        Raises:
            ConfigError: The configuration does not suit the drives.
            BackendError: A bus cannot be opened, or a drive is missing.
        """
        self.check(config, settings)
        parts = self.group_joints_by_driver_type(config, settings)
        clock = DriverClock(config)
        are_emulated_in_process = _are_emulated_in_process(parts)
        mocap = make_receiver(
            config,
            settings.pose_listen,
            are_emulated=are_emulated_in_process,
            clock=lambda _timestamp_ns: clock.now_ns(),
        )

        def open_buses(readings: DriveReadings) -> RobotBuses:
            """Open the buses of all driver types, with an emulated body if there is no real bus."""
            body = None
            if are_emulated_in_process:
                pose_address = mocap.address if mocap is not None else None
                body = make_emulated_body(config, settings, self.name, pose_address)
            specs: list[BusSpec] = []
            for part in parts:
                part_body = body.select(list(part.joints)) if body is not None else None
                context = DriverTypeContext(config, part.settings, part.joints, clock, part_body)
                specs += part.driver_type.plan_buses(context)
            advance_time = clock.advance_start_up_time if config.clock_mode == "lockstep" else None
            return RobotBuses(config, readings, specs, clock.now_ns, advance_time)

        drive_backend_parts = DriveBackendParts(
            name=self.name,
            hardware="+".join(port for part in parts for port in part.ports),
            clock=clock,
            mocap=mocap,
            open_drives=open_buses,
            watchdog_timeouts_s=_list_watchdog_timeouts_s(parts),
            decimation=max(part.settings.decimation for part in parts),
            joints_without_watchdog=frozenset(
                joint
                for part in parts
                if not part.driver_type.has_watchdog
                for joint in part.joints
            ),
        )
        super().__init__(config, drive_backend_parts)


class DriverTypeBackend(BusesBackend):
    """A driver type, and the backend on its drives, real or emulated.

    Derive from it. See docs/hardware/write-a-driver.md.

    A driver type sets `name`, `Settings`, a subclass of `DriveSettings`, and perhaps `supported_modes`, and implements
    the four abstract class methods. The host's thread calls all of them, before the backend is opened or while it is.
    `list_ports`, `list_bus_faults` and `check_drives` open nothing, as `Backend.check` does, which calls them.
    """

    has_watchdog: ClassVar[bool] = True  # False: a drive whose host dies holds its last setpoint
    unmeasured: ClassVar[Collection[Measurement]] = ()  # what drives of this type do not measure
    # True: the driver converts between torque and current, by the torque constant in the robot file. False: the drives
    # exchange torques, which they compute themselves, and the value in the file has no effect.
    uses_torque_constant: ClassVar[bool] = False

    @classmethod
    def limit_modes(cls, robot: RobotFile) -> RobotFile:
        return remove_measurements(super().limit_modes(robot), cls.unmeasured)

    @classmethod
    @abstractmethod
    def list_ports(cls, settings: Any) -> Sequence[str]:
        """Return the names of the buses in the settings; empty if the drives are emulated in this process."""

    @classmethod
    @abstractmethod
    def list_bus_faults(cls, settings: Any) -> Collection[str]:
        """Return the kinds of faults that `Drives.inject` can inject into the buses, such as "cut"."""

    @classmethod
    @abstractmethod
    def check_drives(cls, config: RunConfig, settings: Any, joints: Sequence[Joint]) -> None:
        """Check that drives of this type suit the joints, and that the buses can carry their messages.

        Args:
            config: The run.
            settings: An instance of `Settings`.
            joints: The joints that drives of this type move.

        Raises:
            ConfigError: A joint, or the load of a bus, does not suit this driver type.
        """

    @classmethod
    @abstractmethod
    def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
        """Return the buses that have some of the joints. `BusSpec.open` opens each of them later.

        `make_bus_specs_by_port` makes them for drives on named ports.
        """

    @classmethod
    def group_joints_by_driver_type(cls, config: RunConfig, settings: Any) -> list[DriverTypePart]:
        """Return all joints as one part, because a robot with this backend has drives of this type alone.

        Args:
            config: Configuration of the run, with the robot.
            settings: An instance of `Settings`.

        Raises:
            ConfigError: The robot file names another driver type for a joint.
        """
        joints = dict(enumerate(config.robot.joint_table))
        for joint in joints.values():
            if joint.drive.driver not in ("", cls.name):
                raise ConfigError(
                    f"{make_joint_label(config, joint)}: `driver` = {joint.drive.driver!r} in the robot file, and "
                    f"backend {config.backend!r} drives {cls.name} alone; correct it, or take the backend `mixed`"
                )
        return [DriverTypePart(cls, settings, config.backend_section, joints)]


def _are_emulated_in_process(parts: Sequence[DriverTypePart]) -> bool:
    """Return whether no driver type has a bus, so that all drives are emulated in this process."""
    return not any(part.ports for part in parts)


def _list_watchdog_timeouts_s(parts: Sequence[DriverTypePart]) -> list[float]:
    """Return the watchdog time of every joint, from tail to head."""
    watchdog_s: dict[int, float] = {}
    for part in parts:
        for joint in part.joints:
            watchdog_s[joint] = part.settings.watchdog_s
    return [watchdog_s[joint] for joint in range(len(watchdog_s))]


def make_bus_specs_by_port(
    joints: Mapping[int, Joint],
    settings: DriveSettings,
    ports: Sequence[str],
    open_drives: Callable[[str, Sequence[int], DriveReadings], Drives],
) -> list[BusSpec]:
    """Return the specification of a bus for each port that has some of the joints.

    Args:
        joints: The joints of a driver type, by their indices in the robot, from tail to head.
        settings: Settings of the driver type.
        ports: Names of the ports, at least one. Drives that are emulated in this process have one with any name.
        open_drives: Function that opens the bus on a port. Its arguments are the name of the port, the indices of its
            joints in the robot, and the readings that its drives fill.

    Returns:
        The buses in the order of `ports`, without the ports to which no joint is assigned.

    Raises:
        ValueError: There is no port.
    """
    if not ports:
        raise ValueError('no port for the drives; for emulated drives, pass one such as ["memory"]')
    port_indices = assign_port_indices(list(joints.values()), ports)
    specs: list[BusSpec] = []
    for port_index, port in enumerate(ports):
        joints_on_port = tuple(
            joint for joint, index in zip(joints, port_indices, strict=True) if index == port_index
        )
        if not joints_on_port:
            continue
        spec = BusSpec(
            name=port,
            joints=joints_on_port,
            open=partial(open_drives, port, joints_on_port),
            decimation=settings.decimation,
            watchdog_s=settings.watchdog_s,
        )
        specs.append(spec)
    return specs
