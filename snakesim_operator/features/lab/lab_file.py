"""The lab file: machines, routers, robots, and who has which role. `snakesim lab example` prints one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import ConfigTable, FileStruct, decode_table, read_table
from snakesim_hal.wire.quantities import from_zero
from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.drive_buses import validate_robot_buses
from snakesim_operator.features.lab.lab_robot import LabRobot, Name

EXAMPLE_PATH = Path(__file__).parent / "example.toml"
ALL_ROBOTS = "all"
GNC_SERVICES = ("guidance", "navigation", "control")

Address = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$")]
Folder = Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./-]+$", max_length=200)]
PortNumber = Annotated[int, Meta(ge=1, le=65535)]
Days = Annotated[float, Meta(gt=0, le=825, extra_json_schema={"unit": "days"})]


class LabMachine(FileStruct, frozen=True, kw_only=True):
    """A computer of the lab."""

    address: Address | None = None
    """Address at which other machines reach this one. A router's machine needs one."""

    folder: Folder = "/etc/snakesim"
    """Folder in which its rendered files are installed."""

    user: Name = "snakesim"
    """User account that runs the services."""

    program: Folder = "/opt/snakesim/bin/snakesim"
    """Path of the `snakesim` command on this machine."""

    device_groups: list[Name] = msgspec.field(default_factory=lambda: ["dialout"])
    """Groups of the system that may open its serial ports."""


class LabRouter(FileStruct, frozen=True, kw_only=True):
    """A Zenoh router."""

    machine: Name
    """Machine that the router runs on."""

    port: PortNumber = 7447
    """TCP port at which the router listens."""


class RobotGrant(FileStruct, frozen=True, kw_only=True):
    """What a machine is to a robot: one certificate, one session file."""

    machine: Name
    """Machine that gets the role, with one certificate and one session file."""

    role: Literal["gnc", "operator", "viewer", "recorder", "administrator"]
    """Role of the machine: what it may publish, read and ask, see schemas/roles.md."""

    robot: Name
    """Robot that the role is for, or `all`. A gnc has one robot."""

    services: list[Name] = msgspec.field(default_factory=lambda: list(GNC_SERVICES))
    """Services that a gnc runs. Other roles ignore it."""


class LabFile(FileStruct, frozen=True, kw_only=True):
    """A whole lab file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9 _.-]+$")]
    """Name of the lab, which its certificates contain."""

    certificate_days: Days = 30
    """Lifetime of a machine's certificate. Short, because certificates are not revoked."""

    authority_days: Annotated[float, from_zero(7300, "days")] = 1825
    """Lifetime of the lab's certificate authority."""

    machines: dict[Name, LabMachine]
    """Computers by name, as sections such as `[machines.bench]`."""

    routers: dict[Name, LabRouter]
    """Zenoh routers by name, as sections such as `[routers.main]`. A lab has at least one."""

    robots: dict[Name, LabRobot]
    """Robots by name, as sections such as `[robots.snake]`."""

    roles: list[RobotGrant] = []
    """Roles of the machines, each an entry `[[roles]]`."""


@dataclass(frozen=True)
class LabPlan:
    """A lab file that fits together."""

    file: LabFile
    path: Path

    def list_endpoints(self) -> list[str]:
        """Return the endpoints of the routers, in the file's order."""
        return [self.make_endpoint(name) for name in self.file.routers]

    def make_endpoint(self, router: str) -> str:
        """Return the endpoint of a router: `tls/ADDRESS:PORT`."""
        entry = self.file.routers[router]
        address = self.file.machines[entry.machine].address or ""
        return f"tls/[{address}]:{entry.port}" if ":" in address else f"tls/{address}:{entry.port}"


def load_lab(path: Path) -> LabPlan:
    """Read and check a lab file. Raises ConfigError that names field, value and what is allowed."""
    table = read_table(path)
    file = decode_table(table, LabFile)
    _validate_references(file, table)
    validate_robot_buses(file.robots, table.source)
    return LabPlan(file, path)


def _validate_references(file: LabFile, table: ConfigTable) -> None:
    """Check that the entries of a lab file refer to existing machines, and do not contradict each other.

    Args:
        file: The decoded lab file.
        table: The lab file as it was read, for error messages.

    Raises:
        ConfigError: An entry is missing, or refers to something that does not exist.
    """
    if not file.routers:
        raise ConfigError(
            f"{table.source}: `routers` is empty; a lab has at least one, such as [routers.main]",
            code="lab/invalid-file",
        )
    for name, router in file.routers.items():
        _require_known_name(table, f"routers.{name}.machine", router.machine, file.machines)
        if file.machines[router.machine].address is None:
            raise ConfigError(
                f"{table.source}: `machines.{router.machine}.address` is missing; the router `{name}` listens there",
                code="lab/invalid-file",
            )
    _validate_unique_ports(file, table)
    for name, robot in file.robots.items():
        if name == ALL_ROBOTS:
            raise ConfigError(
                f"{table.source}: `robots.{ALL_ROBOTS}`: this name stands for every robot; choose another",
                code="lab/invalid-file",
            )
        _require_known_name(table, f"robots.{name}.machine", robot.machine, file.machines)
    _validate_roles(file, table)


def _validate_unique_ports(file: LabFile, table: ConfigTable) -> None:
    """Raise ConfigError if two routers listen at the same port of a machine."""
    ports = [(router.machine, router.port) for router in file.routers.values()]
    for name, router in file.routers.items():
        if ports.count((router.machine, router.port)) > 1:
            raise ConfigError(
                f"{table.source}: `routers.{name}.port` = {router.port} has another router, too",
                code="lab/invalid-file",
            )


def _validate_roles(file: LabFile, table: ConfigTable) -> None:
    """Check the entries of `[[roles]]`, each of which grants a role on a robot to a machine.

    Args:
        file: The decoded lab file.
        table: The lab file as it was read, for error messages.

    Raises:
        ConfigError: An entry refers to something that does not exist, is repeated, or is not allowed.
    """
    earlier_grants: set[tuple[str, str, str]] = set()  # (machine, role, robot)
    for index, grant in enumerate(file.roles):
        entry_key = f"roles.{index}"
        _require_known_name(table, f"{entry_key}.machine", grant.machine, file.machines)
        _require_known_name(table, f"{entry_key}.robot", grant.robot, [*file.robots, ALL_ROBOTS])
        if grant.role == Role.GNC and grant.robot == ALL_ROBOTS:
            raise ConfigError(
                f"{table.source}: `{entry_key}.robot` = 'all': a gnc commands one robot; name it",
                code="lab/invalid-file",
            )
        machine_role_robot = (grant.machine, grant.role, grant.robot)
        if machine_role_robot in earlier_grants:
            raise ConfigError(
                f"{table.source}: `{entry_key}` grants {' '.join(machine_role_robot)} a second time; leave one out",
                code="lab/invalid-file",
            )
        earlier_grants.add(machine_role_robot)
        if "hal" in grant.services:
            raise ConfigError(
                f"{table.source}: `{entry_key}.services` = 'hal': only the robot itself is that",
                code="lab/invalid-file",
            )


def _require_known_name(
    table: ConfigTable, field: str, name: str, known_names: Sequence[str] | dict[str, LabMachine]
) -> None:
    if name not in known_names:
        raise ConfigError(
            f"{table.find_origin(field)}: `{field}` = {shorten(name)!r} is not in this file; it has "
            f"{', '.join(known_names)}",
            code="lab/invalid-file",
        )
