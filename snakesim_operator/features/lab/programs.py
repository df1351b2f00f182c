"""The programs that run on a lab's machines all the time: routers, hosts, services and recorders."""

from collections.abc import Iterator
from dataclasses import dataclass

from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.drive_buses import can_interfaces, devices, host_settings, uses_bus
from snakesim_operator.features.lab.identities import Identity, identities
from snakesim_operator.features.lab.lab_file import Lab
from snakesim_operator.features.lab.lab_robot import LabRobot

STATE = "/var/lib/snakesim"


@dataclass(frozen=True)
class Program:
    """A program that a machine starts by itself. Operators, viewers and administrators start theirs by hand."""

    identity: Identity
    about: str
    arguments: tuple[str, ...]  # of the `snakesim` command
    service: str = ""  # of a gnc
    of_robot: str = ""  # of a recorder
    interfaces: tuple[str, ...] = ()  # of the kernel's CAN, that must be up before it
    devices: tuple[str, ...] = ()  # device files that it opens

    @property
    def name(self) -> str:
        """The name of its unit and its container."""
        label = f"{self.kind}.{self.of_robot}" if self.of_robot else self.identity.label
        if self.service:
            return f"snakesim-{label}-{self.service}"
        return f"snakesim-{label}"

    @property
    def kind(self) -> str:
        """`router`, `robot`, `gnc` or `recorder`: what it may do on its machine depends on that."""
        return self.identity.label.partition(".")[0]


def programs(lab: Lab, machine: str) -> Iterator[Program]:
    """Yield all programs that a machine of the lab runs all the time.

    Args:
        lab: The lab.
        machine: Name of the machine in the lab file.
    """
    folder = lab.file.machines[machine].folder
    for identity in identities(lab):
        if identity.machine != machine:
            continue
        session_file = f"{folder}/{identity.label}.json5"
        match identity.role:
            case None:
                yield Program(identity, f"Zenoh router {identity.of}", ("start", "router", session_file))
            case Role.ROBOT:
                yield _host_program(identity, lab, session_file)
            case Role.GNC:
                scenario = _scenario(lab.file.robots[identity.of])
                for service in identity.services:
                    arguments = ("start", "service", service, *scenario, "--session", session_file)
                    yield Program(identity, f"{service} of {identity.of}", arguments, service)
            case Role.RECORDER:
                for robot_name in identity.robots(lab):
                    # Without `--out`, the recording gets a name with the time.
                    arguments = ("record", "--session", session_file, "--namespace", robot_name)
                    yield Program(identity, f"recorder of {robot_name}", arguments, of_robot=robot_name)
            case _:
                pass  # operators, viewers and administrators start their programs by hand


def _host_program(identity: Identity, lab: Lab, session_file: str) -> Program:
    """Return the program that runs the HAL host of a robot."""
    robot = lab.file.robots[identity.of]
    out = f"{STATE}/{identity.of}"
    return Program(
        identity,
        f"HAL host of {identity.of}",
        ("start", "host", *_scenario(robot), "--session", session_file, "--out", out),
        interfaces=tuple(interface.name for interface in can_interfaces(robot)),
        devices=tuple(devices(robot)),
    )


def _scenario(robot: LabRobot) -> tuple[str, ...]:
    """Return the options for the scenario. Host and services get the same, because they compare them."""
    words = [robot.scenario, "--backend", robot.backend]
    if uses_bus(robot):
        words += ["--clock-mode", "realtime"]  # the only one of drives on a bus, whatever mode the scenario has
    for setting in (*host_settings(robot), *robot.set):
        words += ["--set", setting]
    return tuple(words)
