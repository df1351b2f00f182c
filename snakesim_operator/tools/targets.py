"""Which robots a command is about: those on the endpoint that is named, else all that run on this computer."""

from dataclasses import dataclass

from snakesim_hal.errors import NotConnectedError, RefusedError
from snakesim_hal.network.local_registry import LocalRobot, local_robots
from snakesim_hal.network.session import DEFAULT_ENDPOINT, Link, Session, open_session
from snakesim_hal.wire import keys

CONNECT_S = 1.0
HAL_EVERYWHERE = f"**/{keys.alive('hal')}"


@dataclass(frozen=True)
class Where:
    """What the command line says of where to look."""

    endpoint: str | None = None  # None: every network of a robot on this computer, and the default endpoint
    namespace: str | None = None  # None: every robot there

    def local(self) -> list[LocalRobot]:
        """Robots of this computer that are meant."""
        return [
            robot
            for robot in local_robots()
            if self.endpoint in (None, robot.endpoint) and self.namespace in (None, robot.namespace)
        ]

    def endpoints(self) -> list[str]:
        """Every network to look at."""
        if self.endpoint is not None:
            return [self.endpoint]
        return list(dict.fromkeys([*(robot.endpoint for robot in self.local()), DEFAULT_ENDPOINT]))


def robots_on(session: Session) -> list[str]:
    """The namespaces of all robots whose HAL is alive on a network."""
    return [namespace_of(key) for key in session.present(HAL_EVERYWHERE)]


def namespace_of(key: str) -> str:
    """The robot that a key is of, seen from outside its namespace."""
    split = keys.split_namespace(key)
    return key if split is None else split[0]


def find_robots(where: Where) -> list[Link]:
    """Every robot that is meant and can be reached."""
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
    """The one robot that is meant. Raises NotConnectedError when there is none, RefusedError when there are more."""
    found = find_robots(where)
    if not found:
        named = "" if where.namespace is None else f" named {where.namespace}"
        raise NotConnectedError(
            f"no robot{named} on {', '.join(where.endpoints())}; start a run there, or say where with --endpoint"
        )
    if len(found) > 1:
        choices = [f"  snakesim {command} --endpoint {link.endpoint} --namespace {link.namespace}" for link in found]
        raise RefusedError("several robots are here; say which one is meant:", *choices)
    return found[0]
