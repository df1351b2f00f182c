"""The identities in a lab: every router, and every pair of a machine and a role, with the name in its certificate."""

from collections.abc import Iterator
from dataclasses import dataclass

from snakesim_hal.wire.roles import Role
from snakesim_operator.features.lab.lab_file import ALL_ROBOTS, LabPlan

ROUTER = "router"


@dataclass(frozen=True)
class CertificateIdentity:
    """What one certificate stands for."""

    machine: str
    role: Role | None  # None: a router
    subject: str  # the robot, `all`, or the name of the router
    services: tuple[str, ...] = ()  # of a gnc

    @property
    def label(self) -> str:
        """The name on its machine and of its files: `gnc.planar13`, `router.main`."""
        return f"{self.role or ROUTER}.{self.subject}"

    @property
    def common_name(self) -> str:
        """The name in the certificate, in the access rules and in the routers' logs: `gnc.planar13.ws1`."""
        return f"{self.label}.{self.machine}"

    def list_robots(self, lab: LabPlan) -> list[str]:
        """Return the robots whose keys the identity may use; none for a router."""
        if self.subject == ALL_ROBOTS:
            return list(lab.file.robots)
        if self.role is None:
            return []
        return [self.subject]


def iterate_identities(lab: LabPlan) -> Iterator[CertificateIdentity]:
    """Yield all identities of a lab: routers, robots, then the roles in the file's order."""
    for name, router in lab.file.routers.items():
        yield CertificateIdentity(router.machine, None, name)
    for name, robot in lab.file.robots.items():
        yield CertificateIdentity(robot.machine, Role.ROBOT, name)
    for grant in lab.file.roles:
        role = Role(grant.role)
        services = tuple(grant.services) if role is Role.GNC else ()
        yield CertificateIdentity(grant.machine, role, grant.robot, services)
