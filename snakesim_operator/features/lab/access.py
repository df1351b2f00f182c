"""The access rules of a router, made from the table of roles: who may send and receive what, everything else denied."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import IMAGE_MESSAGE_TYPES, MAX_IMAGE_BYTES, MAX_PAYLOAD_BYTES
from snakesim_hal.wire.roles import KeyPermission, Role, iterate_permissions
from snakesim_operator.features.lab.identities import CertificateIdentity, iterate_identities
from snakesim_operator.features.lab.lab_file import ALL_ROBOTS, LabPlan

ANY_KEY = "**"
# Tools look for robots with a wildcard in the place of the namespace, as in `**/alive/hal`.
SEARCH_MESSAGES = (
    "declare_subscriber",
    "query",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
ALL_MESSAGES = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
MAX_REQUEST_BYTES = 16 * 1024  # of a query, and of its answer where nothing is latched
MAX_COMMAND_BYTES = 64 * 1024  # of a command to 256 joints, or what a person asks for
MAX_ENVELOPE_BYTES = 4096  # key and encoding beside a payload


def make_access_control(lab: LabPlan) -> dict[str, Any]:
    """Return Zenoh's `access_control` section for the routers of a lab.

    Everything that no rule allows is denied.

    Args:
        lab: The lab, which defines the identities: routers, robots and the machines with a role.

    Returns:
        The section as Zenoh's configuration file has it. Each identity is one subject, recognized by the common name
        of its certificate, and has one policy, which lists its rules.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in iterate_identities(lab):
        name = identity.common_name
        identity_rules = _make_rules(identity, lab)
        rule_ids = [rule["id"] for rule in identity_rules]
        rules += identity_rules
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"id": name, "rules": rule_ids, "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _make_rules(identity: CertificateIdentity, lab: LabPlan) -> list[dict[str, Any]]:
    """Return the rules of Zenoh's access control for one identity.

    All keys at which the same messages may pass in the same direction (flow) share one rule.

    Args:
        identity: The router, robot or machine that the rules are for.
        lab: The lab.

    Returns:
        The rules as Zenoh's configuration file has them, each with an id.
    """
    # (key, flow) -> messages.
    messages_by_key_and_flow: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flow, message, key in _iterate_permissions(identity, lab):
        messages_by_key_and_flow[key, flow].add(message)

    # (flow, messages) -> keys.
    keys_by_flow_and_messages: dict[tuple[str, tuple[str, ...]], list[str]] = defaultdict(list)
    for (key, flow), messages in messages_by_key_and_flow.items():
        keys_by_flow_and_messages[flow, tuple(sorted(messages))].append(key)

    rules: list[dict[str, Any]] = []
    for rule_number, ((flow, rule_messages), rule_keys) in enumerate(
        sorted(keys_by_flow_and_messages.items()), 1
    ):
        rule = {
            "id": f"{identity.common_name}/{rule_number}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(rule_messages),
            "key_exprs": sorted(rule_keys),
        }
        rules.append(rule)
    return rules


def _iterate_permissions(identity: CertificateIdentity, lab: LabPlan) -> Iterator[KeyPermission]:
    """Yield every kind of message that may pass between a router and an identity.

    Keys begin with the robot's namespace, unlike those of the table of roles.

    Args:
        identity: The router, robot or machine.
        lab: The lab, with its robots.

    Yields:
        Direction, kind of message and key.
    """
    if identity.role is None:
        yield from _iterate_router_permissions()
        return
    for robot in identity.list_robots(lab):
        faults = lab.file.robots[robot].faults
        for flow, message, key in iterate_permissions(
            identity.role, identity.services, allow_fault_injection=faults
        ):
            yield KeyPermission(flow, message, f"{robot}/{key}")
            if key == ANY_KEY or message not in SEARCH_MESSAGES:
                continue
            # Tools search for robots with a wildcard instead of the namespace. A process of one robot may search only
            # within its namespace, because a query with a wildcard reaches every queryable.
            searches_one_robot = flow == "ingress" and identity.subject != ALL_ROBOTS
            namespace = f"{robot}/{ANY_KEY}" if searches_one_robot else ANY_KEY
            yield KeyPermission(flow, message, f"{namespace}/{key}")
    if identity.role is Role.ADMINISTRATOR:
        yield KeyPermission("ingress", "query", f"@/{ANY_KEY}")
        yield KeyPermission("egress", "reply", f"@/{ANY_KEY}")


def _iterate_router_permissions() -> Iterator[KeyPermission]:
    """Yield everything, because another router has already checked what it forwards."""
    for flow in ("ingress", "egress"):
        for message in ALL_MESSAGES:
            yield KeyPermission(flow, message, ANY_KEY)
            yield KeyPermission(flow, message, f"{ANY_KEY}/@adv/{ANY_KEY}")


def make_size_limits() -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter` section: the maximum size of a message in bytes, by key.

    Routers drop longer messages. Every key of the key space belongs to one of four groups with a common maximum.
    """
    image_keys = [row.key for row in keys.SPACE if row.message in IMAGE_MESSAGE_TYPES]
    query_keys = [row.key for row in keys.SPACE if row.kind == "query"]
    command_keys = [keys.JOINT_COMMAND, keys.INTENT, keys.DONE_ALL]
    grouped_keys = (*image_keys, *query_keys, *command_keys)
    other_keys = [row.key for row in keys.SPACE if row.message and row.key not in grouped_keys]
    # Zenoh transfers the stored values of latched keys below `@adv`.
    stored_keys = [f"{row.key}/@adv/{ANY_KEY}" for row in keys.SPACE if row.kind == "latched"]
    return [
        _make_size_limit("images", image_keys, MAX_IMAGE_BYTES),
        _make_size_limit("requests", query_keys, MAX_REQUEST_BYTES),
        _make_size_limit("commands", command_keys, MAX_COMMAND_BYTES),
        _make_size_limit("others", [*other_keys, *stored_keys], MAX_PAYLOAD_BYTES),
    ]


def _make_size_limit(name: str, key_list: list[str], max_bytes: int) -> dict[str, Any]:
    """Return one entry of the `low_pass_filter` section, for keys in any namespace."""
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": ["put", "delete", "query", "reply"],
        "key_exprs": [f"{ANY_KEY}/{key}" for key in key_list],
        "size_limit": max_bytes,
    }
