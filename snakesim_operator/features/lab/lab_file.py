"""The lab file: machines, routers, robots, and who has which role. `snakesim lab example` prints one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import FileStruct, Table, decode, read_table
from snakesim_hal.wire.quantities import from_zero
from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.drive_buses import check_buses
from snakesim_operator.features.lab.lab_robot import LabRobot, Name

EXAMPLE = Path(__file__).parent / "example.toml"
ALL = "all"
GNC_SERVICES = ("guidance", "navigation", "control")

Address = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9.:-]{0,252}$")]
Folder = Annotated[str, Meta(pattern=r"^/[A-Za-z0-9_./-]+$", max_length=200)]
PortNumber = Annotated[int, Meta(ge=1, le=65535)]
Days = Annotated[float, Meta(gt=0, le=825, extra_json_schema={"unit": "days"})]


class Machine(FileStruct, frozen=True, kw_only=True):
    """A computer of the lab."""

    address: Address | None = None  # that others reach it at; a router's machine needs one
    folder: Folder = "/etc/snakesim"  # where its rendered files are installed
    user: Name = "snakesim"  # whom the services run as
    program: Folder = "/opt/snakesim/bin/snakesim"
    device_groups: list[Name] = msgspec.field(default_factory=lambda: ["dialout"])  # that may open its serial ports


class Router(FileStruct, frozen=True, kw_only=True):
    """A Zenoh router."""

    machine: Name
    port: PortNumber = 7447


class Grant(FileStruct, frozen=True, kw_only=True):
    """What a machine is to a robot: one certificate, one session file."""

    machine: Name
    role: Literal["gnc", "operator", "viewer", "recorder", "administrator"]
    robot: Name  # or `all`
    services: list[Name] = msgspec.field(default_factory=lambda: list(GNC_SERVICES))  # of a gnc


class LabFile(FileStruct, frozen=True, kw_only=True):
    """A whole lab file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9 _.-]+$")]
    certificate_days: Days = 30  # of the certificates; short, because nothing revokes them
    authority_days: Annotated[float, from_zero(7300, "days")] = 1825
    machines: dict[Name, Machine]
    routers: dict[Name, Router]
    robots: dict[Name, LabRobot]
    roles: list[Grant] = []


@dataclass(frozen=True)
class Lab:
    """A lab file that fits together."""

    file: LabFile
    path: Path

    def endpoints(self) -> list[str]:
        """Return the endpoints of the routers, in the file's order."""
        return [self.endpoint(name) for name in self.file.routers]

    def endpoint(self, router: str) -> str:
        """Return the endpoint of a router: `tls/ADDRESS:PORT`."""
        entry = self.file.routers[router]
        address = self.file.machines[entry.machine].address or ""
        return f"tls/[{address}]:{entry.port}" if ":" in address else f"tls/{address}:{entry.port}"


def load_lab(path: Path) -> Lab:
    """Read and check a lab file. Raises ConfigError that names field, value and what is allowed."""
    table = read_table(path)
    file = decode(table, LabFile)
    _check(file, table)
    check_buses(file.robots, table.source)
    return Lab(file, path)


def _check(file: LabFile, table: Table) -> None:
    if not file.routers:
        raise ConfigError(f"{table.source}: `routers` is empty; a lab has at least one, such as [routers.main]")
    for name, router in file.routers.items():
        _known(table, f"routers.{name}.machine", router.machine, file.machines)
        if file.machines[router.machine].address is None:
            raise ConfigError(
                f"{table.source}: `machines.{router.machine}.address` is missing; the router `{name}` listens there"
            )
    listening = [(router.machine, router.port) for router in file.routers.values()]
    for (name, router), place in zip(file.routers.items(), listening, strict=True):
        if listening.count(place) > 1:
            raise ConfigError(f"{table.source}: `routers.{name}.port` = {router.port} has another router, too")
    for name, robot in file.robots.items():
        if name == ALL:
            raise ConfigError(f"{table.source}: `robots.{ALL}`: this name stands for every robot; choose another")
        _known(table, f"robots.{name}.machine", robot.machine, file.machines)
    _check_roles(file, table)


def _check_roles(file: LabFile, table: Table) -> None:
    seen: set[tuple[str, str, str]] = set()
    for i, grant in enumerate(file.roles):
        at = f"roles.{i}"
        _known(table, f"{at}.machine", grant.machine, file.machines)
        _known(table, f"{at}.robot", grant.robot, [*file.robots, ALL])
        if grant.role == Role.GNC and grant.robot == ALL:
            raise ConfigError(f"{table.source}: `{at}.robot` = 'all': a gnc commands one robot; name it")
        if (entry := (grant.machine, grant.role, grant.robot)) in seen:
            raise ConfigError(f"{table.source}: `{at}` grants {' '.join(entry)} a second time; leave one out")
        seen.add(entry)
        for service in grant.services:
            if service == "hal":
                raise ConfigError(f"{table.source}: `{at}.services` = 'hal': only the robot itself is that")


def _known(table: Table, field: str, name: str, among: Sequence[str] | dict[str, Machine]) -> None:
    if name not in among:
        raise ConfigError(
            f"{table.origin_of(field)}: `{field}` = {shorten(name)!r} is not in this file; it has {', '.join(among)}"
        )
