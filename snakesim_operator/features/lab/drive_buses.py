"""The buses of a robot's drives: what the host is given, what its machine brings up, and which devices it may open.

A drive type without a bus is emulated inside the host. So a lab file that asks for a real robot names its buses, or it
says `emulated = true`; nothing is rendered otherwise.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from snakesim_hal.base.errors import ConfigError, suggest_word
from snakesim_operator.features.lab.lab_robot import LabRobot

KERNEL_INTERFACE = re.compile(r"v?can[0-9]{1,3}")  # any other bus on CAN is INTERFACE:CHANNEL of python-can
EMULATED_BUSES = ("vcan", "udp_multicast:", "virtual:", "/dev/pts/")  # no real drive can be there
SIMULATOR = "sim"
MIXED = "mixed"  # each joint's drive type is in the robot file


@dataclass(frozen=True)
class DriveType:
    """How a backend of ours is given its buses, in its section of the scenario."""

    kind: Literal["can", "serial"]  # the key of the lab file that names them
    buses_key: str
    is_can_fd: bool = False


DRIVE_TYPES: dict[str, DriveType] = {
    "can": DriveType("can", "channels"),
    "odrive": DriveType("can", "channels"),
    "moteus": DriveType("can", "channels", is_can_fd=True),
    "dynamixel": DriveType("serial", "ports"),
}


@dataclass(frozen=True)
class CanInterface:
    """An interface of the kernel, as its unit brings it up."""

    name: str
    bit_rate: int
    data_bit_rate: int | None  # None: classic CAN

    @property
    def is_virtual(self) -> bool:
        """Whether it has no controller: `vcan0`."""
        return self.name.startswith("v")


def buses_by_drive_type(robot: LabRobot) -> Mapping[str, Sequence[str]]:
    """Returns the buses of each drive type; of a simulator, of emulated drives and of a backend not ours none."""
    if robot.backend == SIMULATOR or robot.emulated:
        return {}
    if robot.backend == MIXED:
        return robot.buses
    drive_type = DRIVE_TYPES.get(robot.backend)
    if drive_type is None:
        return {}
    return {robot.backend: robot.can if drive_type.kind == "can" else robot.serial}


def host_settings(robot: LabRobot) -> list[str]:
    """Returns the `--set` values that give the host its buses and their bit rates."""
    settings: list[str] = []
    for name, buses in buses_by_drive_type(robot).items():
        drive_type = DRIVE_TYPES[name]
        quoted = ", ".join(f"'{bus}'" for bus in buses)  # TOML's literal strings; a unit quotes with the other sign
        settings.append(f"backends.{name}.{drive_type.buses_key}=[{quoted}]")
        if drive_type.kind == "can":
            settings.append(f"backends.{name}.bit_rate={robot.bitrate}")
        if drive_type.is_can_fd:
            settings.append(f"backends.{name}.data_bit_rate={robot.data_bitrate}")
    return settings


def uses_bus(robot: LabRobot) -> bool:
    """Whether its drives are on a bus, so that time passes by itself."""
    return robot.backend != SIMULATOR and not robot.emulated


def is_to_be_real(robot: LabRobot) -> bool:
    """Whether its lab file asks for a robot that really moves; unknown of a backend that is not ours, so no."""
    buses = [bus for own in buses_by_drive_type(robot).values() for bus in own]
    return any(not bus.startswith(EMULATED_BUSES) for bus in buses)


def can_interfaces(robot: LabRobot) -> list[CanInterface]:
    """Returns the interfaces that the robot's machine brings up."""
    if not uses_bus(robot):
        return []
    on_can_fd = {
        bus for name, buses in buses_by_drive_type(robot).items() if DRIVE_TYPES[name].is_can_fd for bus in buses
    }
    return [
        CanInterface(bus, robot.bitrate, robot.data_bitrate if bus in on_can_fd else None)
        for bus in robot.can
        if KERNEL_INTERFACE.fullmatch(bus)
    ]


def devices(robot: LabRobot) -> list[str]:
    """Returns the device files that the robot's host opens."""
    if not uses_bus(robot):
        return []
    behind_adapters = [path for bus in robot.can if (path := bus.partition(":")[2]).startswith("/dev/")]
    return list(dict.fromkeys([*robot.serial, *behind_adapters, *robot.devices]))


def check_buses(robots: Mapping[str, LabRobot], source: str) -> None:
    """Raises ConfigError for a robot that would be driven without its buses, and for a bus that two robots have."""
    used_by: dict[tuple[str, str], str] = {}
    for name, robot in robots.items():
        where = f"{source}: `robots.{name}"
        _check_settings(robot, where)
        if not uses_bus(robot):
            continue
        if robot.backend == MIXED:
            _check_mixed(robot, where)
        elif robot.buses:
            raise ConfigError(
                f"{where}.buses` is for backend `{MIXED}`; of backend {robot.backend!r} say `can` or `serial`",
                code="lab/invalid-file",
            )
        elif robot.backend in DRIVE_TYPES:
            _check_one_type(robot, where)
        else:
            _check_other_backend(robot, where)
        for bus in (*robot.can, *robot.serial):
            other = used_by.setdefault((robot.machine, bus), name)
            if other != name:
                raise ConfigError(
                    f"{where}`: {bus} of machine {robot.machine!r} has the robot {other!r}, too; a bus is of one robot",
                    code="lab/invalid-file",
                )


def _check_one_type(robot: LabRobot, where: str) -> None:
    match DRIVE_TYPES[robot.backend].kind:
        case "can":
            kind, buses, example = "can", robot.can, 'can = ["can0"]'
            other_kind, other_buses = "serial", robot.serial
        case "serial":
            kind, buses, example = "serial", robot.serial, 'serial = ["/dev/ttyUSB0"]'
            other_kind, other_buses = "can", robot.can
    if other_buses:
        raise ConfigError(
            f"{where}.{other_kind}` = {other_buses}: drives of backend {robot.backend!r} are on buses named in "
            f"`{kind}`, such as {example}; leave `{other_kind}` out",
            code="lab/invalid-file",
        )
    if not buses:
        raise ConfigError(
            f"{where}.{kind}` is empty, and backend {robot.backend!r} without a bus emulates its drives: nothing real "
            f"would move. Name the bus, such as {example}; or say `emulated = true`, if that is meant",
            code="lab/invalid-file",
        )


def _check_mixed(robot: LabRobot, where: str) -> None:
    """Every bus has one drive type, and every drive type has a bus of its kind."""
    if not robot.buses:
        raise ConfigError(
            f"{where}.buses` is missing, and backend `{MIXED}` without buses emulates its drives: nothing real would "
            'move. Say which drive type is on which bus, such as buses = { odrive = ["can0"] }; or `emulated = true`',
            code="lab/invalid-file",
        )
    named: list[str] = []
    for name, buses in robot.buses.items():
        if name not in DRIVE_TYPES:
            raise ConfigError(
                f"{where}.buses.{name}`: no such drive type; {suggest_word(name, list(DRIVE_TYPES))}there are "
                f"{', '.join(DRIVE_TYPES)}",
                code="lab/invalid-file",
            )
        kind = DRIVE_TYPES[name].kind
        known = robot.can if kind == "can" else robot.serial
        if not buses:
            raise ConfigError(
                f"{where}.buses.{name}` is empty; name its buses, or leave it out", code="lab/invalid-file"
            )
        for bus in buses:
            if bus not in known:
                raise ConfigError(
                    f"{where}.buses.{name}` = {bus!r} is not in `{kind}` = {known}; add it there",
                    code="lab/invalid-file",
                )
            if bus in named:
                raise ConfigError(
                    f"{where}.buses.{name}` = {bus!r} has another drive type, too; a bus has one",
                    code="lab/invalid-file",
                )
        named += buses
    if unused := [bus for bus in (*robot.can, *robot.serial) if bus not in named]:
        raise ConfigError(
            f"{where}.buses` does not say which drive type is on {', '.join(unused)}", code="lab/invalid-file"
        )


def _check_other_backend(robot: LabRobot, where: str) -> None:
    """How a backend that is not ours is given its buses is not known here."""
    has_section = any(setting.startswith((f"backends.{robot.backend}.", "backend.")) for setting in robot.set)
    own_scenario = "/" in robot.scenario
    if not (has_section or own_scenario):
        raise ConfigError(
            f"{where}.backend` = {robot.backend!r} is none of {', '.join([SIMULATOR, *DRIVE_TYPES, MIXED])}, so this "
            f"program does not know how it is given a bus. Say it in `set`, such as "
            f"set = [\"backends.{robot.backend}.port='/dev/ttyUSB0'\"], or in a scenario file of your own",
            code="lab/invalid-file",
        )


def _check_settings(robot: LabRobot, where: str) -> None:
    """Buses and bit rates stand in one place, because the units are made from them, too."""
    for setting in robot.set:
        key = setting.partition("=")[0]
        if robot.backend in DRIVE_TYPES:
            key = re.sub(r"^backend\.", f"backends.{robot.backend}.", key)
        section, _, name = key.rpartition(".")
        drive_type = DRIVE_TYPES.get(section.removeprefix("backends."))
        if drive_type is not None and name in (drive_type.buses_key, "bit_rate", "data_bit_rate"):
            raise ConfigError(
                f"{where}.set` has {setting!r}, which `{drive_type.kind}`, `buses`, `bitrate` and `data_bitrate` say: "
                f"the units are made from these, too. Say it there",
                code="lab/invalid-file",
            )
