"""Which robots a command addresses: those on the given endpoint, else all that run on this computer."""

from dataclasses import dataclass

from snakesim_hal.errors import NotConnectedError, RefusedError
from snakesim_hal.network.local_registry import LocalRobot, local_robots
from snakesim_hal.network.session import DEFAULT_ENDPOINT, Link, Session, open_session
from snakesim_hal.wire import keys

CONNECT_S = 1.0
HAL_EVERYWHERE = f"**/{keys.alive('hal')}"


@dataclass(frozen=True)
class Where:
    """The command's network options."""

    endpoint: str | None = None  # None: every network of a robot on this computer, and the default endpoint
    namespace: str | None = None  # None: every robot there

    def local(self) -> list[LocalRobot]:
        """Addressed robots on this computer."""
        return [
            robot
            for robot in local_robots()
            if self.endpoint in (None, robot.endpoint) and self.namespace in (None, robot.namespace)
        ]

    def endpoints(self) -> list[str]:
        """Endpoints of all networks to search."""
        if self.endpoint is not None:
            return [self.endpoint]
        return list(dict.fromkeys([*(robot.endpoint for robot in self.local()), DEFAULT_ENDPOINT]))


def robots_on(session: Session) -> list[str]:
    """The namespaces of all robots whose HAL is alive on a network."""
    return [namespace_of(key) for key in session.present(HAL_EVERYWHERE)]


def namespace_of(key: str) -> str:
    """The namespace of a full key."""
    split = keys.split_namespace(key)
    return key if split is None else split[0]


def find_robots(where: Where) -> list[Link]:
    """Every addressed robot that can be reached."""
    found: list[Link] = []
    for endpoint in where.endpoints():
        try:
            with open_session(Link(endpoint), CONNECT_S) as session:
                names = robots_on(session)
        except NotConnectedError:
            continue
        found += [Link(endpoint, name) for name in names if where.namespace in (None, name)]
    return found


def the_one(where: Where, command: str) -> Link:
    """The single addressed robot. Raises NotConnectedError when there is none, RefusedError when there are more."""
    found = find_robots(where)
    if not found:
        named = "" if where.namespace is None else f" named {where.namespace}"
        raise NotConnectedError(
            f"no robot{named} on {', '.join(where.endpoints())}; start a run there, or give --endpoint"
        )
    if len(found) > 1:
        choices = [f"  snakesim {command} --endpoint {link.endpoint} --namespace {link.namespace}" for link in found]
        raise RefusedError("several robots found; choose one:", *choices)
    return found[0]
