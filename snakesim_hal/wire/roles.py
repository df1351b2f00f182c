"""The roles at each key: the one table from which the access rules of routers and `schemas/roles.md` are made.

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
    """What a process is to a robot. Its certificate names the role."""

    ROBOT = "robot"
    GNC = "gnc"
    OPERATOR = "operator"
    VIEWER = "viewer"
    RECORDER = "recorder"
    ADMINISTRATOR = "administrator"


ROLE_DESCRIPTIONS: dict[Role, str] = {
    Role.ROBOT: "the HAL host on the robot's computer, with what runs beside it there",
    Role.GNC: "guidance, navigation and control of one robot",
    Role.OPERATOR: "a person who arms, disarms, resets, stops, and asks for a speed or a direction",
    Role.VIEWER: "a person who watches, and may stop the robot",
    Role.RECORDER: "a process that writes down everything",
    Role.ADMINISTRATOR: "an operator who may also read the routers' own state, and inject faults if the lab allows it",
}

_PERSONS = (Role.OPERATOR, Role.ADMINISTRATOR)
# The roles that publish, by the writer that the key space names. A writer that is missing here may write nothing, and
# a test fails.
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
# The roles that may send a query, by its key.
_ASKERS: dict[str, tuple[Role, ...]] = {
    keys.LEASE: (Role.GNC,),
    keys.LIFECYCLE: _PERSONS,
    keys.SIMULATOR: _PERSONS,
    keys.ESTOP: (Role.GNC, Role.VIEWER, *_PERSONS),
    keys.FAULT_ALL: (Role.ADMINISTRATOR,),
    keys.PARAMETERS: _PERSONS,
    keys.RECEIVED: (Role.ROBOT,),
}
# The roles that answer a query, by its key. All other queries are answered by the robot alone.
_ANSWERERS: dict[str, tuple[Role, ...]] = {
    keys.FAULT_ALL: (Role.ROBOT, Role.GNC),
    keys.PARAMETERS: (Role.GNC,),
    keys.RECEIVED: (Role.RECORDER,),
}
# What follows the name of a service or a process at a key, if anything: here the process's random id.
_SUFFIX_OF_NAME = {keys.PROCESS_ALL: "-$*"}
_WITH_TOKEN = (keys.PROCESS_ALL,)  # keys of samples that have a liveliness token, too
RECORDER = "recorder"  # the name of its process
FAULT_INJECTION_KEYS = (keys.FAULT_ALL,)  # granted only for a robot whose lab file allows it
# What a gnc and a recorder may do only under their own names, at keys that end with `*`.
OWN_NAME_ONLY = ("publish", "declare", "answer")


class KeyPermission(NamedTuple):
    """One kind of Zenoh message that a router lets pass at a key, relative to the robot's namespace."""

    flow: str  # seen from the router: `ingress` comes from the process, `egress` goes to it
    message: str  # as Zenoh's access control names it
    key: str


@dataclass(frozen=True)
class AccessRule:
    """What the roles may do at one key of the key space."""

    key: str
    kind: str  # stream, latched, query, liveliness
    writers: tuple[Role, ...]  # they publish, send the query, or declare the token
    answerers: tuple[Role, ...]  # they answer the query; empty for other kinds

    def list_actions(self, role: Role) -> tuple[str, ...]:
        """Return the actions that a role may take at this key: publish, read, ask, answer, declare, or watch."""
        match self.kind:
            case "query":
                return self._list_query_actions(role)
            case "liveliness":
                write_actions = ["declare"]
                read_actions = ["watch"]
            case _:
                write_actions = ["publish"]
                read_actions = ["read"]
                if self.has_token:
                    write_actions.append("declare")
                    read_actions.append("watch")
        if role in self.writers:
            return (*write_actions, *read_actions)
        return tuple(read_actions)

    def _list_query_actions(self, role: Role) -> tuple[str, ...]:
        actions: list[str] = []
        if role in self.writers:
            actions.append("ask")
        if role in self.answerers:
            actions.append("answer")
        return tuple(actions)

    @property
    def has_token(self) -> bool:
        """Whether there is a liveliness token at the key."""
        return self.kind == "liveliness" or self.key in _WITH_TOKEN


def _make_access_rule(row: keys.KeyRow) -> AccessRule:
    if row.kind == "query":
        writers = _ASKERS.get(row.key, ())
        answerers = _ANSWERERS.get(row.key, (Role.ROBOT,))
        return AccessRule(row.key, row.kind, writers, answerers)
    return AccessRule(row.key, row.kind, _WRITERS.get(row.writer, ()), answerers=())


ACCESS_RULES: tuple[AccessRule, ...] = tuple(_make_access_rule(row) for row in keys.SPACE)

_CACHE = "/@adv/**"  # where a latched key keeps its last value, and has the token of its publisher
# Zenoh's messages for each action, as (flow, message, suffix of the key).
ZENOH_MESSAGES_BY_ACTION: dict[str, tuple[tuple[str, str, str], ...]] = {
    "publish": (("ingress", "put", ""), ("egress", "declare_subscriber", "")),
    "read": (("ingress", "declare_subscriber", ""), ("egress", "put", "")),
    "ask": (("ingress", "query", ""), ("egress", "declare_queryable", ""), ("egress", "reply", "")),
    "answer": (
        ("ingress", "declare_queryable", ""),
        ("egress", "query", ""),
        ("ingress", "reply", ""),
    ),
    "declare": (("ingress", "liveliness_token", ""),),
    "watch": (
        ("ingress", "liveliness_query", ""),
        ("ingress", "declare_liveliness_subscriber", ""),
        ("egress", "liveliness_token", ""),
    ),
}
# Further messages for each action at a latched key. A process queries the cache at the cache's own key, and the cache
# replies at the key of the value.
LATCHED_ZENOH_MESSAGES_BY_ACTION: dict[str, tuple[tuple[str, str, str], ...]] = {
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


def iterate_permissions(
    role: Role, services: Iterable[str] = (), *, allow_fault_injection: bool = False
) -> Iterator[KeyPermission]:
    """Yield the rules of Zenoh's access control for a role of a robot: each message that a router lets pass.

    Args:
        role: Role of a process.
        services: Names under which a process with the role `gnc` may act, which are those of its services. They limit
            the keys `alive/*`, `hal/done/*`, `process/*` and `fault/*`.
        allow_fault_injection: Whether faults may be injected into the robot.
    """
    allowed_names = _find_allowed_names(role, services)
    # Every role may declare a subscription to a pattern that is wider than its rights, such as `**`. That is safe,
    # because the router forwards a sample only with an `egress` permission for its own key.
    yield KeyPermission("ingress", "declare_subscriber", "**")
    for rule in ACCESS_RULES:
        if rule.key in FAULT_INJECTION_KEYS and not allow_fault_injection:
            continue
        for action in rule.list_actions(role):
            key_exprs = [rule.key]
            if allowed_names is not None and action in OWN_NAME_ONLY:
                key_exprs = _make_key_exprs_of_names(rule.key, allowed_names)
            for flow, message, key_suffix in _list_zenoh_messages(rule, action):
                for key_expr in key_exprs:
                    yield KeyPermission(flow, message, key_expr + key_suffix)
            if action == "publish":
                # The router sends a publisher the subscriptions to its keys.
                yield KeyPermission("egress", "declare_subscriber", "**")


def _find_allowed_names(role: Role, services: Iterable[str]) -> list[str] | None:
    """Return the only names under which a role may act; None for a role that may act under any name."""
    match role:
        case Role.GNC:
            return list(services)
        case Role.RECORDER:
            return [RECORDER]
        case _:
            return None


def _make_key_exprs_of_names(key: str, names: list[str]) -> list[str]:
    """Return the key expressions that a pattern allows for some names.

    Args:
        key: Key of the key space. If it ends with `/*`, each name takes the place of the wildcard.
        names: Names of services or processes.
    """
    if not key.endswith("/*"):
        return [key]
    suffix = _SUFFIX_OF_NAME.get(key, "")
    return [key[:-1] + name + suffix for name in names]


def _list_zenoh_messages(rule: AccessRule, action: str) -> tuple[tuple[str, str, str], ...]:
    """Return the messages of Zenoh that an action at a key needs, each as (flow, message, suffix of the key)."""
    if rule.kind == "latched":
        return (
            *ZENOH_MESSAGES_BY_ACTION[action],
            *LATCHED_ZENOH_MESSAGES_BY_ACTION.get(action, ()),
        )
    return ZENOH_MESSAGES_BY_ACTION[action]
