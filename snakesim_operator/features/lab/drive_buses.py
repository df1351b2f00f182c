"""The buses of a robot's drives: settings of the host, interfaces of its machine, and devices that it may open.

The host emulates a drive type that has no bus. To prevent that by mistake, a lab file either names the buses of a robot
or has `emulated = true`; otherwise it is refused.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from snakesim_hal.base.errors import ConfigError, suggest_word
from snakesim_operator.features.lab.lab_robot import LabRobot

# Any other bus on CAN is INTERFACE:CHANNEL of python-can, or local:FOLDER.
KERNEL_INTERFACE = re.compile(r"v?can[0-9]{1,3}")
# No real drive can be on such a bus.
EMULATED_BUS_PREFIXES = "vcan", "local:", "udp_multicast:", "virtual:", "/dev/pts/"
SIMULATOR_BACKEND = "sim"
MIXED_BACKEND = "mixed"  # each joint's drive type is in the robot file


BusInterface = Literal["can", "serial"]


@dataclass(frozen=True)
class DriveType:
    """A drive type of SnakeSIM: where its buses are named."""

    interface: BusInterface  # the key of the lab file
    buses_key: str  # in the backend's section of the scenario
    is_can_fd: bool = False


OTHER_INTERFACE: dict[BusInterface, BusInterface] = {"can": "serial", "serial": "can"}
BUS_EXAMPLES: dict[BusInterface, str] = {
    "can": 'can = ["can0"]',
    "serial": 'serial = ["/dev/ttyUSB0"]',
}
DRIVE_TYPES: dict[str, DriveType] = {
    "can": DriveType("can", "channels"),
    "odrive": DriveType("can", "channels"),
    "moteus": DriveType("can", "channels", is_can_fd=True),
    "cia402": DriveType("can", "channels"),
    "dynamixel": DriveType("serial", "ports"),
    "feetech": DriveType("serial", "ports"),
}


@dataclass(frozen=True)
class CanInterface:
    """A CAN interface of the kernel, which a systemd unit brings up."""

    name: str
    bit_rate: int
    data_bit_rate: int | None  # None: classic CAN

    @property
    def is_virtual(self) -> bool:
        """Return whether the interface has no hardware, as `vcan0`."""
        return self.name.startswith("v")


def group_buses_by_drive_type(robot: LabRobot) -> Mapping[str, Sequence[str]]:
    """Return the buses of each drive type.

    A simulator and emulated drives have none. For a backend that is not part of SnakeSIM they are unknown, so the
    result is empty, too.
    """
    if robot.backend == SIMULATOR_BACKEND or robot.emulated:
        return {}
    if robot.backend == MIXED_BACKEND:
        return robot.buses
    drive_type = DRIVE_TYPES.get(robot.backend)
    if drive_type is None:
        return {}
    return {robot.backend: _get_buses_of_interface(robot, drive_type.interface)}


def _get_buses_of_interface(robot: LabRobot, interface: Literal["can", "serial"]) -> Sequence[str]:
    match interface:
        case "can":
            return robot.can
        case "serial":
            return robot.serial


def make_host_settings(robot: LabRobot) -> list[str]:
    """Return the `--set` values, as KEY=VALUE, that configure the host's buses and their bit rates."""
    settings: list[str] = []
    for drive_type_name, buses in group_buses_by_drive_type(robot).items():
        drive_type = DRIVE_TYPES[drive_type_name]
        # In single quotes, because the unit has double ones.
        quoted_buses = ", ".join(f"'{bus}'" for bus in buses)
        settings.append(f"backends.{drive_type_name}.{drive_type.buses_key}=[{quoted_buses}]")
        if drive_type.interface == "can":
            settings.append(f"backends.{drive_type_name}.bit_rate={robot.bitrate}")
        if drive_type.is_can_fd:
            settings.append(f"backends.{drive_type_name}.data_bit_rate={robot.data_bitrate}")
    return settings


def is_on_bus(robot: LabRobot) -> bool:
    """Return whether the drives are on a bus, so that the robot can run in real time only."""
    return robot.backend != SIMULATOR_BACKEND and not robot.emulated


def has_real_drives(robot: LabRobot) -> bool:
    """Return whether the lab file asks for a robot that really moves.

    For a backend that is not part of SnakeSIM this is unknown, and the result is False.
    """
    for buses in group_buses_by_drive_type(robot).values():
        if any(not bus.startswith(EMULATED_BUS_PREFIXES) for bus in buses):
            return True
    return False


def list_can_interfaces(robot: LabRobot) -> list[CanInterface]:
    """Return the interfaces that the robot's machine brings up."""
    if not is_on_bus(robot):
        return []
    can_fd_buses: set[str] = set()
    for name, buses in group_buses_by_drive_type(robot).items():
        if DRIVE_TYPES[name].is_can_fd:
            can_fd_buses.update(buses)
    interfaces: list[CanInterface] = []
    for bus in robot.can:
        if KERNEL_INTERFACE.fullmatch(bus):
            data_bit_rate = robot.data_bitrate if bus in can_fd_buses else None
            interfaces.append(CanInterface(bus, robot.bitrate, data_bit_rate))
    return interfaces


def list_device_files(robot: LabRobot) -> list[str]:
    """Return the device files that the robot's host opens, each once."""
    if not is_on_bus(robot):
        return []
    adapter_channels = [bus.partition(":")[2] for bus in robot.can]  # of INTERFACE:CHANNEL
    adapter_devices = [channel for channel in adapter_channels if channel.startswith("/dev/")]
    return list(dict.fromkeys([*robot.serial, *adapter_devices, *robot.devices]))


def validate_robot_buses(robots: Mapping[str, LabRobot], source: str) -> None:
    """Check that every robot has the buses that it needs, and that no bus has two robots.

    Args:
        robots: Robots by their names in the lab file.
        source: Path of the lab file, for error messages.

    Raises:
        ConfigError: A robot names no bus, or two robots name the same bus.
    """
    robot_by_bus: dict[tuple[str, str], str] = {}  # by machine and bus
    for name, robot in robots.items():
        context = f"{source}: `robots.{name}"  # helpers append `.KEY` and the closing backtick
        _validate_absence_of_bus_settings(robot, context)
        if not is_on_bus(robot):
            continue
        _validate_bus_assignment(robot, context)
        for bus in (*robot.can, *robot.serial):
            # The name of the first robot on this bus, which is this robot if the bus was free.
            other_robot = robot_by_bus.setdefault((robot.machine, bus), name)
            if other_robot != name:
                raise ConfigError(
                    f"{context}`: {bus} of machine {robot.machine!r} has the robot {other_robot!r}, too; "
                    "a bus belongs to one robot",
                    code="lab/invalid-file",
                )


def _validate_bus_assignment(robot: LabRobot, context: str) -> None:
    """Check that the lab file names the buses that the robot's backend needs. Raises ConfigError."""
    if robot.backend == MIXED_BACKEND:
        _validate_mixed_drive_types(robot, context)
    elif robot.buses:
        raise ConfigError(
            f"{context}.buses` is for backend `{MIXED_BACKEND}`; for backend {robot.backend!r} use `can` or `serial`",
            code="lab/invalid-file",
        )
    elif robot.backend in DRIVE_TYPES:
        _validate_buses_of_single_drive_type(robot, context)
    else:
        _validate_external_backend(robot, context)


def _validate_buses_of_single_drive_type(robot: LabRobot, context: str) -> None:
    """Check the buses of a robot whose drives are all of one type: only buses of that type's interface may be named.

    Args:
        robot: The robot's entry in the lab file.
        context: File and key of the entry for error messages, with an open backtick before the key.

    Raises:
        ConfigError: The robot has buses of the other interface (CAN or serial), or none.
    """
    interface = DRIVE_TYPES[robot.backend].interface
    other_interface = OTHER_INTERFACE[interface]
    example = BUS_EXAMPLES[interface]
    other_buses = _get_buses_of_interface(robot, other_interface)
    if other_buses:
        raise ConfigError(
            f"{context}.{other_interface}` = {other_buses}: drives of backend {robot.backend!r} are on buses named in "
            f"`{interface}`, such as {example}; leave `{other_interface}` out",
            code="lab/invalid-file",
        )
    if not _get_buses_of_interface(robot, interface):
        raise ConfigError(
            f"{context}.{interface}` is empty, and backend {robot.backend!r} without a bus emulates its drives: "
            f"nothing real would move. Name the bus, such as {example}; or set `emulated = true`, if that is meant",
            code="lab/invalid-file",
        )


def _validate_mixed_drive_types(robot: LabRobot, context: str) -> None:
    """Check the buses of a robot with several drive types: each bus must be assigned to exactly one drive type.

    Args:
        robot: The robot's entry in the lab file.
        context: File and key of the entry for error messages, with an open backtick before the key.

    Raises:
        ConfigError: The table `buses` is missing, a bus is assigned to no drive type or to more than one, or a drive
            type is unknown or on a bus of the wrong interface (CAN or serial).
    """
    if not robot.buses:
        raise ConfigError(
            f"{context}.buses` is missing, and backend `{MIXED_BACKEND}` without buses emulates its drives: "
            "nothing real would move. Say which drive type is on which bus, such as "
            'buses = { odrive = ["can0"] }; or `emulated = true`',
            code="lab/invalid-file",
        )
    assigned_buses: list[str] = []  # buses that have a drive type
    for drive_type, buses in robot.buses.items():
        _validate_buses_of_drive_type(robot, drive_type, context)
        for bus in buses:
            if bus in assigned_buses:
                raise ConfigError(
                    f"{context}.buses.{drive_type}` = {bus!r} has another drive type, too; a bus has one",
                    code="lab/invalid-file",
                )
        assigned_buses += buses
    unassigned_buses = [bus for bus in (*robot.can, *robot.serial) if bus not in assigned_buses]
    if unassigned_buses:
        raise ConfigError(
            f"{context}.buses` does not name the drive type that is on {', '.join(unassigned_buses)}",
            code="lab/invalid-file",
        )


def _validate_buses_of_drive_type(robot: LabRobot, drive_type: str, context: str) -> None:
    """Check that a drive type in `buses` exists, and that its buses are listed under `can` or `serial`.

    Args:
        robot: The robot's entry in the lab file.
        drive_type: Name of the drive type.
        context: File and key of the entry for error messages, with an open backtick before the key.

    Raises:
        ConfigError: There is no such drive type, it has no bus, or a bus is not listed.
    """
    if drive_type not in DRIVE_TYPES:
        raise ConfigError(
            f"{context}.buses.{drive_type}`: no such drive type; "
            f"{suggest_word(drive_type, list(DRIVE_TYPES))}there are {', '.join(DRIVE_TYPES)}",
            code="lab/invalid-file",
        )
    buses = robot.buses[drive_type]
    if not buses:
        raise ConfigError(
            f"{context}.buses.{drive_type}` is empty; name its buses, or leave it out",
            code="lab/invalid-file",
        )
    interface = DRIVE_TYPES[drive_type].interface
    listed_buses = _get_buses_of_interface(robot, interface)
    for bus in buses:
        if bus not in listed_buses:
            raise ConfigError(
                f"{context}.buses.{drive_type}` = {bus!r} is not in `{interface}` = {listed_buses}; add it there",
                code="lab/invalid-file",
            )


def _validate_external_backend(robot: LabRobot, context: str) -> None:
    """Check that a backend that is not part of SnakeSIM is configured by settings or by a scenario file."""
    has_section = any(
        setting.startswith((f"backends.{robot.backend}.", "backend.")) for setting in robot.set
    )
    names_scenario_file = "/" in robot.scenario
    if not (has_section or names_scenario_file):
        raise ConfigError(
            f"{context}.backend` = {robot.backend!r} is none of "
            f"{', '.join([SIMULATOR_BACKEND, *DRIVE_TYPES, MIXED_BACKEND])}, so this program does not know how to set "
            f"its bus. Configure the bus in `set`, such as set = "
            f"[\"backends.{robot.backend}.port='/dev/ttyUSB0'\"], or in a scenario file of your own",
            code="lab/invalid-file",
        )


def _validate_absence_of_bus_settings(robot: LabRobot, context: str) -> None:
    """Check that no setting names buses or bit rates: the units need them, and read them from their own keys."""
    for setting in robot.set:
        key = setting.partition("=")[0]
        if robot.backend in DRIVE_TYPES:
            key = re.sub(r"^backend\.", f"backends.{robot.backend}.", key)
        section, _, name = key.rpartition(".")
        drive_type = DRIVE_TYPES.get(section.removeprefix("backends."))
        if drive_type is not None and name in (drive_type.buses_key, "bit_rate", "data_bit_rate"):
            raise ConfigError(
                f"{context}.set` has {setting!r}, which `{drive_type.interface}`, `buses`, `bitrate` and "
                f"`data_bitrate` set: the units are made from these, too. Say it there",
                code="lab/invalid-file",
            )
