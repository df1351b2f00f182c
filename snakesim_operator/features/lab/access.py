"""The access rules of a router, made from the table of roles: who may send and receive what, everything else denied."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import IMAGES, MAX_IMAGE_BYTES, MAX_PAYLOAD_BYTES
from snakesim_hal.wire.roles import Permission, Role, list_permissions
from snakesim_operator.features.lab.identities import Identity, identities
from snakesim_operator.features.lab.lab_file import ALL, Lab

ANY = "**"
# Tools look for robots with a wildcard in the place of the namespace, as in `**/alive/hal`.
SEARCHED = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")
EVERY_MESSAGE = (
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
REQUEST_BYTES = 16 * 1024  # of a query, and of its answer where nothing is latched
COMMAND_BYTES = 64 * 1024  # of a command to 256 joints, or what a person asks for
ENVELOPE_BYTES = 4096  # key and encoding beside a payload


def access_control(lab: Lab) -> dict[str, Any]:
    """Return Zenoh's `access_control` section for the routers of a lab."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in identities(lab):
        name = identity.common_name
        own = _rules(identity, lab)
        rules += own
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"id": name, "rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(identity: Identity, lab: Lab) -> list[dict[str, Any]]:
    """Return the rules of one identity. Keys with the same messages and flow share a rule."""
    messages: dict[tuple[str, str], set[str]] = defaultdict(set)  # by key and flow
    for flow, message, key in _permitted(identity, lab):
        messages[key, flow].add(message)
    together: dict[tuple[str, tuple[str, ...]], list[str]] = defaultdict(list)
    for (key, flow), named in messages.items():
        together[flow, tuple(sorted(named))].append(key)
    return [
        {
            "id": f"{identity.common_name}/{number}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(named),
            "key_exprs": sorted(places),
        }
        for number, ((flow, named), places) in enumerate(sorted(together.items()), 1)
    ]


def _permitted(identity: Identity, lab: Lab) -> Iterator[Permission]:
    """Yield everything that may pass between a router and an identity, with whole keys."""
    if identity.role is None:  # another router, which has checked what it forwards
        for flow in ("ingress", "egress"):
            for message in EVERY_MESSAGE:
                for key in (ANY, f"{ANY}/@adv/{ANY}"):
                    yield Permission(flow, message, key)
        return
    for robot in identity.robots(lab):
        faults = lab.file.robots[robot].faults
        within = ANY if identity.of == ALL else f"{robot}/{ANY}"
        for flow, message, key in list_permissions(identity.role, identity.services, faults=faults):
            yield Permission(flow, message, f"{robot}/{key}")
            if key != ANY and message in SEARCHED:  # a query with a wildcard reaches every queryable
                yield Permission(flow, message, f"{within if flow == 'ingress' else ANY}/{key}")
    if identity.role is Role.ADMINISTRATOR:
        yield Permission("ingress", "query", f"@/{ANY}")
        yield Permission("egress", "reply", f"@/{ANY}")


def size_limits() -> list[dict[str, Any]]:
    """Return Zenoh's `low_pass_filter`: the maximum size of a message, by key. Routers drop longer ones."""
    images = [row.key for row in keys.SPACE if row.message in IMAGES]
    queries = [row.key for row in keys.SPACE if row.kind == "query"]
    small = [keys.JOINT_COMMAND, keys.INTENT, keys.DONE_ALL]
    others = [row.key for row in keys.SPACE if row.message and row.key not in (*images, *queries, *small)]
    latched = [f"{row.key}/@adv/{ANY}" for row in keys.SPACE if row.kind == "latched"]
    return [
        {
            "id": name,
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": [f"{ANY}/{place}" for place in places],
            "size_limit": max_bytes,
        }
        for name, places, max_bytes in (
            ("images", images, MAX_IMAGE_BYTES),
            ("requests", queries, REQUEST_BYTES),
            ("commands", small, COMMAND_BYTES),
            ("others", [*others, *latched], MAX_PAYLOAD_BYTES),
        )
    ]
