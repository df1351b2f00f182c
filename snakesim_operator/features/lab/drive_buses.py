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

KERNEL_INTERFACE = re.compile(r"v?can[0-9]{1,3}")  # any other bus on CAN is INTERFACE:CHANNEL of python-can
EMULATED_BUS_PREFIXES = ("vcan", "udp_multicast:", "virtual:", "/dev/pts/")  # no real drive can be on such a bus
SIMULATOR = "sim"
MIXED = "mixed"  # each joint's drive type is in the robot file


@dataclass(frozen=True)
class DriveType:
    """A drive type of SnakeSIM: where its buses are named."""

    kind: Literal["can", "serial"]  # the key of the lab file
    buses_key: str  # in the backend's section of the scenario
    is_can_fd: bool = False


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


def buses_by_drive_type(robot: LabRobot) -> Mapping[str, Sequence[str]]:
    """Return the buses of each drive type.

    A simulator and emulated drives have none. For a backend that is not part of SnakeSIM they are unknown, so the
    result is empty, too.
    """
    if robot.backend == SIMULATOR or robot.emulated:
        return {}
    if robot.backend == MIXED:
        return robot.buses
    drive_type = DRIVE_TYPES.get(robot.backend)
    if drive_type is None:
        return {}
    return {robot.backend: _buses_of_kind(robot, drive_type.kind)}


def _buses_of_kind(robot: LabRobot, kind: Literal["can", "serial"]) -> Sequence[str]:
    match kind:
        case "can":
            return robot.can
        case "serial":
            return robot.serial


def host_settings(robot: LabRobot) -> list[str]:
    """Return the `--set` values that give the host its buses and their bit rates."""
    settings: list[str] = []
    for name, buses in buses_by_drive_type(robot).items():
        drive_type = DRIVE_TYPES[name]
        quoted = ", ".join(f"'{bus}'" for bus in buses)  # in single quotes, because the unit has double ones
        settings.append(f"backends.{name}.{drive_type.buses_key}=[{quoted}]")
        if drive_type.kind == "can":
            settings.append(f"backends.{name}.bit_rate={robot.bitrate}")
        if drive_type.is_can_fd:
            settings.append(f"backends.{name}.data_bit_rate={robot.data_bitrate}")
    return settings


def uses_bus(robot: LabRobot) -> bool:
    """Return whether the drives are on a bus, so that the robot can run in real time only."""
    return robot.backend != SIMULATOR and not robot.emulated


def is_to_be_real(robot: LabRobot) -> bool:
    """Return whether the lab file asks for a robot that really moves.

    For a backend that is not part of SnakeSIM this is unknown, and the result is False.
    """
    for buses in buses_by_drive_type(robot).values():
        if any(not bus.startswith(EMULATED_BUS_PREFIXES) for bus in buses):
            return True
    return False


def can_interfaces(robot: LabRobot) -> list[CanInterface]:
    """Return the interfaces that the robot's machine brings up."""
    if not uses_bus(robot):
        return []
    can_fd_buses: set[str] = set()
    for name, buses in buses_by_drive_type(robot).items():
        if DRIVE_TYPES[name].is_can_fd:
            can_fd_buses.update(buses)
    interfaces: list[CanInterface] = []
    for bus in robot.can:
        if KERNEL_INTERFACE.fullmatch(bus):
            data_bit_rate = robot.data_bitrate if bus in can_fd_buses else None
            interfaces.append(CanInterface(bus, robot.bitrate, data_bit_rate))
    return interfaces


def devices(robot: LabRobot) -> list[str]:
    """Return the device files that the robot's host opens, each once."""
    if not uses_bus(robot):
        return []
    adapter_channels = [bus.partition(":")[2] for bus in robot.can]  # of INTERFACE:CHANNEL
    adapter_devices = [channel for channel in adapter_channels if channel.startswith("/dev/")]
    return list(dict.fromkeys([*robot.serial, *adapter_devices, *robot.devices]))


def check_buses(robots: Mapping[str, LabRobot], source: str) -> None:
    """Check that every robot has the buses that it needs, and that no bus has two robots.

    Args:
        robots: by their names in the lab file.
        source: the lab file, for errors.

    Raises:
        ConfigError: a robot would be driven without its buses, or two robots name the same bus.
    """
    robot_of_bus: dict[tuple[str, str], str] = {}  # by machine and bus
    for name, robot in robots.items():
        where = f"{source}: `robots.{name}"
        _check_settings(robot, where)
        if not uses_bus(robot):
            continue
        _check_buses_of_robot(robot, where)
        for bus in (*robot.can, *robot.serial):
            other = robot_of_bus.setdefault((robot.machine, bus), name)
            if other != name:
                raise ConfigError(
                    f"{where}`: {bus} of machine {robot.machine!r} has the robot {other!r}, too; "
                    "a bus belongs to one robot",
                    code="lab/invalid-file",
                )


def _check_buses_of_robot(robot: LabRobot, where: str) -> None:
    """Check that the lab file names the buses that the robot's backend needs. Raises ConfigError."""
    if robot.backend == MIXED:
        _check_mixed(robot, where)
    elif robot.buses:
        raise ConfigError(
            f"{where}.buses` is for backend `{MIXED}`; for backend {robot.backend!r} use `can` or `serial`",
            code="lab/invalid-file",
        )
    elif robot.backend in DRIVE_TYPES:
        _check_one_type(robot, where)
    else:
        _check_other_backend(robot, where)


def _check_one_type(robot: LabRobot, where: str) -> None:
    """Check a robot whose drives all have one type: it has buses of that type's kind, and no others.

    Args:
        robot: The robot's entry in the lab file.
        where: Place of the entry, for errors.

    Raises:
        ConfigError: the robot has buses of another kind, or none.
    """
    match DRIVE_TYPES[robot.backend].kind:
        case "can":
            kind = "can"
            other_kind = "serial"
            example = 'can = ["can0"]'
        case "serial":
            kind = "serial"
            other_kind = "can"
            example = 'serial = ["/dev/ttyUSB0"]'
    other_buses = _buses_of_kind(robot, other_kind)
    if other_buses:
        raise ConfigError(
            f"{where}.{other_kind}` = {other_buses}: drives of backend {robot.backend!r} are on buses named in "
            f"`{kind}`, such as {example}; leave `{other_kind}` out",
            code="lab/invalid-file",
        )
    if not _buses_of_kind(robot, kind):
        raise ConfigError(
            f"{where}.{kind}` is empty, and backend {robot.backend!r} without a bus emulates its drives: nothing real "
            f"would move. Name the bus, such as {example}; or set `emulated = true`, if that is meant",
            code="lab/invalid-file",
        )


def _check_mixed(robot: LabRobot, where: str) -> None:
    """Check a robot with several drive types: every bus has one type, and every type has a bus of its kind.

    Args:
        robot: The robot's entry in the lab file.
        where: Place of the entry, for errors.

    Raises:
        ConfigError: a bus has no drive type, or several.
    """
    if not robot.buses:
        raise ConfigError(
            f"{where}.buses` is missing, and backend `{MIXED}` without buses emulates its drives: nothing real would "
            'move. Say which drive type is on which bus, such as buses = { odrive = ["can0"] }; or `emulated = true`',
            code="lab/invalid-file",
        )
    assigned: list[str] = []  # buses that have a drive type
    for name, buses in robot.buses.items():
        _check_buses_of_type(robot, name, where)
        for bus in buses:
            if bus in assigned:
                raise ConfigError(
                    f"{where}.buses.{name}` = {bus!r} has another drive type, too; a bus has one",
                    code="lab/invalid-file",
                )
        assigned += buses
    unassigned = [bus for bus in (*robot.can, *robot.serial) if bus not in assigned]
    if unassigned:
        raise ConfigError(
            f"{where}.buses` does not name the drive type that is on {', '.join(unassigned)}", code="lab/invalid-file"
        )


def _check_buses_of_type(robot: LabRobot, name: str, where: str) -> None:
    """Check that a drive type in `buses` exists, and that its buses are listed under its kind, `can` or `serial`.

    Args:
        robot: The robot's entry in the lab file.
        name: Name of the drive type.
        where: Place of the entry, for errors.

    Raises:
        ConfigError: there is no such drive type, or a bus is not listed.
    """
    if name not in DRIVE_TYPES:
        raise ConfigError(
            f"{where}.buses.{name}`: no such drive type; {suggest_word(name, list(DRIVE_TYPES))}there are "
            f"{', '.join(DRIVE_TYPES)}",
            code="lab/invalid-file",
        )
    buses = robot.buses[name]
    if not buses:
        raise ConfigError(f"{where}.buses.{name}` is empty; name its buses, or leave it out", code="lab/invalid-file")
    kind = DRIVE_TYPES[name].kind
    listed = _buses_of_kind(robot, kind)
    for bus in buses:
        if bus not in listed:
            raise ConfigError(
                f"{where}.buses.{name}` = {bus!r} is not in `{kind}` = {listed}; add it there", code="lab/invalid-file"
            )


def _check_other_backend(robot: LabRobot, where: str) -> None:
    """Check that a backend that is not part of SnakeSIM is configured by settings or by a scenario file."""
    has_section = any(setting.startswith((f"backends.{robot.backend}.", "backend.")) for setting in robot.set)
    names_scenario_file = "/" in robot.scenario
    if not (has_section or names_scenario_file):
        raise ConfigError(
            f"{where}.backend` = {robot.backend!r} is none of {', '.join([SIMULATOR, *DRIVE_TYPES, MIXED])}, so this "
            f"program does not know how to set its bus. Configure the bus in `set`, such as "
            f"set = [\"backends.{robot.backend}.port='/dev/ttyUSB0'\"], or in a scenario file of your own",
            code="lab/invalid-file",
        )


def _check_settings(robot: LabRobot, where: str) -> None:
    """Check that no setting names buses or bit rates: the units need them, and read them from their own keys."""
    for setting in robot.set:
        key = setting.partition("=")[0]
        if robot.backend in DRIVE_TYPES:
            key = re.sub(r"^backend\.", f"backends.{robot.backend}.", key)
        section, _, name = key.rpartition(".")
        drive_type = DRIVE_TYPES.get(section.removeprefix("backends."))
        if drive_type is not None and name in (drive_type.buses_key, "bit_rate", "data_bit_rate"):
            raise ConfigError(
                f"{where}.set` has {setting!r}, which `{drive_type.kind}`, `buses`, `bitrate` and `data_bitrate` set: "
                f"the units are made from these, too. Say it there",
                code="lab/invalid-file",
            )
