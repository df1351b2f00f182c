"""Who may do what at which key. The one table from which the access rules of routers and `schemas/roles.md` are made.

A role belongs to one robot: the operator of one robot has no rights on another. Reading is open to every role of the
robot, because nothing on its keys is a secret; whatever moves, stops or describes the robot has a named writer. What
the table does not grant is denied.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from snakesim_hal.wire import keys


class Role(StrEnum):
    """What a process is to a robot. Its certificate says so."""

    ROBOT = "robot"
    GNC = "gnc"
    OPERATOR = "operator"
    VIEWER = "viewer"
    RECORDER = "recorder"
    ADMINISTRATOR = "administrator"


ABOUT: dict[Role, str] = {
    Role.ROBOT: "the HAL host on the robot's computer, with what runs beside it there",
    Role.GNC: "guidance, navigation and control of one robot",
    Role.OPERATOR: "a person who arms, disarms, clears, stops, and asks for a speed or a direction",
    Role.VIEWER: "a person who watches, and may stop the robot",
    Role.RECORDER: "a process that writes down everything",
    Role.ADMINISTRATOR: "an operator who may also read the routers' own state, and inject faults if the lab allows it",
}

_PERSONS = (Role.OPERATOR, Role.ADMINISTRATOR)
# By the writer that the key space names. A writer that is missing here may write nothing, and a test fails.
_WRITERS: dict[str, tuple[Role, ...]] = {
    "HAL": (Role.ROBOT,),
    "preview": (Role.ROBOT,),
    "lease holder": (Role.GNC,),
    "guidance": (Role.GNC,),
    "navigation": (Role.GNC,),
    "control": (Role.GNC,),
    "each service": (Role.ROBOT, Role.GNC, Role.RECORDER),
    "each process": (Role.ROBOT, Role.GNC, Role.RECORDER),
    "operator": _PERSONS,
}
_ASKERS: dict[str, tuple[Role, ...]] = {
    keys.LEASE: (Role.GNC,),
    keys.LIFECYCLE: _PERSONS,
    keys.SIMULATOR: _PERSONS,
    keys.ESTOP: (Role.GNC, Role.VIEWER, *_PERSONS),
    keys.FAULT_ALL: (Role.ADMINISTRATOR,),
    keys.SETTINGS: _PERSONS,
}
_ANSWERERS: dict[str, tuple[Role, ...]] = {
    keys.FAULT_ALL: (Role.ROBOT, Role.GNC),
    keys.SETTINGS: (Role.GNC,),
}  # the others: the robot alone
_NAMED = {keys.PROCESS_ALL: "-$*"}  # what follows the name of a service or a process at a key, if anything
_WITH_TOKEN = (keys.PROCESS_ALL,)  # keys of samples that have a liveliness token, too
RECORDER = "recorder"  # the name of its process
INJECTION = (keys.FAULT_ALL,)  # granted only for a robot whose lab file allows it


OWN_NAME_ONLY = ("publish", "declare", "answer")  # at `*`, for a gnc and a recorder


class Permission(NamedTuple):
    """One kind of Zenoh message that a router lets pass at a key, relative to the robot's namespace."""

    flow: str  # seen from the router: `ingress` comes from the process, `egress` goes to it
    message: str  # as Zenoh's access control names it
    key: str


@dataclass(frozen=True)
class Line:
    """One line of the table."""

    key: str
    kind: str  # stream, latched, query, liveliness
    writers: tuple[Role, ...]  # publish; of a query: ask; of liveliness: declare the token
    answerers: tuple[Role, ...]  # of a query

    def acts(self, role: Role) -> tuple[str, ...]:
        """What a role may do here, in words: publish, read, ask, answer, declare, watch."""
        if self.kind == "query":
            return ("ask",) * (role in self.writers) + ("answer",) * (role in self.answerers)
        write = ("publish",) * (self.kind != "liveliness") + ("declare",) * self.has_token
        read = ("read",) * (self.kind != "liveliness") + ("watch",) * self.has_token
        return (*write, *read) if role in self.writers else read

    @property
    def has_token(self) -> bool:
        """Whether there is a liveliness token at the key."""
        return self.kind == "liveliness" or self.key in _WITH_TOKEN


def _line(row: keys.Row) -> Line:
    if row.kind == "query":
        return Line(row.key, row.kind, _ASKERS.get(row.key, ()), _ANSWERERS.get(row.key, (Role.ROBOT,)))
    return Line(row.key, row.kind, _WRITERS.get(row.writer, ()), ())


TABLE: tuple[Line, ...] = tuple(_line(row) for row in keys.SPACE)

_CACHE = "/@adv/**"  # where a latched key keeps its last value, and has the token of its publisher
# Zenoh's messages for each act, as (flow, message, what follows the key).
MESSAGES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "publish": (("ingress", "put", ""), ("egress", "declare_subscriber", "")),
    "read": (("ingress", "declare_subscriber", ""), ("egress", "put", "")),
    "ask": (("ingress", "query", ""), ("egress", "declare_queryable", ""), ("egress", "reply", "")),
    "answer": (("ingress", "declare_queryable", ""), ("egress", "query", ""), ("ingress", "reply", "")),
    "declare": (("ingress", "liveliness_token", ""),),
    "watch": (
        ("ingress", "liveliness_query", ""),
        ("ingress", "declare_liveliness_subscriber", ""),
        ("egress", "liveliness_token", ""),
    ),
}
# Of a latched key in addition. The cache is asked at its own key, and answers at that of the value.
MESSAGES_OF_LATCHED: dict[str, tuple[tuple[str, str, str], ...]] = {
    "publish": (
        ("ingress", "declare_queryable", _CACHE),
        ("egress", "query", _CACHE),
        ("ingress", "reply", ""),
        ("ingress", "liveliness_token", _CACHE),
    ),
    "read": (
        ("ingress", "query", _CACHE),
        ("egress", "declare_queryable", _CACHE),
        ("egress", "reply", ""),
        ("ingress", "liveliness_query", _CACHE),
        ("ingress", "declare_liveliness_subscriber", _CACHE),
        ("egress", "liveliness_token", _CACHE),
    ),
}


def permissions(role: Role, services: Iterable[str] = (), *, faults: bool = False) -> Iterator[Permission]:
    """Everything that a router lets pass for a role of a robot.

    services: of a `gnc`, the names that it may take in `alive/*`, `hal/done/*`, `process/*` and `fault/*`.
    faults: whether faults may be injected into the robot.
    """
    names = {Role.GNC: list(services), Role.RECORDER: [RECORDER]}.get(role)
    # A pattern may be wider than one key: what then is delivered is decided key by key.
    yield Permission("ingress", "declare_subscriber", "**")
    for line in TABLE:
        if line.key in INJECTION and not faults:
            continue
        for act in line.acts(role):
            places = [line.key]
            if names is not None and line.key.endswith("/*") and act in OWN_NAME_ONLY:
                places = [line.key[:-1] + name + _NAMED.get(line.key, "") for name in names]
            more = MESSAGES_OF_LATCHED.get(act, ()) if line.kind == "latched" else ()
            for flow, message, after in (*MESSAGES[act], *more):
                for place in places:
                    yield Permission(flow, message, place + after)
            if act == "publish":  # of what it writes, a process hears who subscribes to it
                yield Permission("egress", "declare_subscriber", "**")
