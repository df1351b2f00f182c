"""The programs that run on a lab's machines all the time: routers, hosts, services and recorders."""

from collections.abc import Iterator
from dataclasses import dataclass

from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.drive_buses import (
    is_on_bus,
    list_can_interfaces,
    list_device_files,
    make_host_settings,
)
from snakesim_operator.features.lab.identities import CertificateIdentity, iterate_identities
from snakesim_operator.features.lab.lab_file import LabPlan
from snakesim_operator.features.lab.lab_robot import LabRobot

STATE_FOLDER = "/var/lib/snakesim"


@dataclass(frozen=True)
class MachineProgram:
    """A program that a machine starts by itself. Operators, viewers and administrators start theirs by hand."""

    identity: CertificateIdentity
    description: str
    arguments: tuple[str, ...]  # of the `snakesim` command
    service: str = ""  # of a gnc
    recorded_robot: str = ""  # of a recorder
    interfaces: tuple[str, ...] = ()  # of the kernel's CAN, that must be up before it
    devices: tuple[str, ...] = ()  # device files that it opens

    @property
    def name(self) -> str:
        """The name of its unit and its container."""
        label = f"{self.kind}.{self.recorded_robot}" if self.recorded_robot else self.identity.label
        if self.service:
            return f"snakesim-{label}-{self.service}"
        return f"snakesim-{label}"

    @property
    def kind(self) -> str:
        """`router`, `robot`, `gnc` or `recorder`: what it may do on its machine depends on that."""
        return self.identity.label.partition(".")[0]


def iterate_programs(lab: LabPlan, machine: str) -> Iterator[MachineProgram]:
    """Yield all programs that a machine of the lab runs all the time.

    Args:
        lab: The lab.
        machine: Name of the machine in the lab file.
    """
    folder = lab.file.machines[machine].folder
    for identity in iterate_identities(lab):
        if identity.machine != machine:
            continue
        session_file = f"{folder}/{identity.label}.json5"
        match identity.role:
            case None:
                yield MachineProgram(
                    identity, f"Zenoh router {identity.subject}", ("start", "router", session_file)
                )
            case Role.ROBOT:
                yield _make_host_program(identity, lab, session_file)
            case Role.GNC:
                scenario = _make_scenario_options(lab.file.robots[identity.subject])
                for service in identity.services:
                    arguments = ("start", "service", service, *scenario, "--session", session_file)
                    yield MachineProgram(
                        identity, f"{service} of {identity.subject}", arguments, service
                    )
            case Role.RECORDER:
                for robot_name in identity.list_robots(lab):
                    # Without `--out`, the recording gets a name with the time.
                    arguments = ("record", "--session", session_file, "--namespace", robot_name)
                    yield MachineProgram(
                        identity, f"recorder of {robot_name}", arguments, recorded_robot=robot_name
                    )
            case _:
                pass  # operators, viewers and administrators start their programs by hand


def _make_host_program(
    identity: CertificateIdentity, lab: LabPlan, session_file: str
) -> MachineProgram:
    """Return the program that runs the HAL host of a robot."""
    robot = lab.file.robots[identity.subject]
    out = f"{STATE_FOLDER}/{identity.subject}"
    return MachineProgram(
        identity,
        f"HAL host of {identity.subject}",
        ("start", "host", *_make_scenario_options(robot), "--session", session_file, "--out", out),
        interfaces=tuple(interface.name for interface in list_can_interfaces(robot)),
        devices=tuple(list_device_files(robot)),
    )


def _make_scenario_options(robot: LabRobot) -> tuple[str, ...]:
    """Return the options for the scenario. Host and services get the same, because they compare them."""
    words = [robot.scenario, "--backend", robot.backend]
    if is_on_bus(robot):
        # The only one of drives on a bus, whatever mode the scenario has.
        words += ["--clock-mode", "realtime"]
    for setting in (*make_host_settings(robot), *robot.set):
        words += ["--set", setting]
    return tuple(words)
