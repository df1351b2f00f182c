"""Writes `schemas/roles.md`: the table of roles as a page for people."""

from collections.abc import Iterable, Iterator

from snakesim_hal.wire.roles import (
    ACCESS_RULES,
    FAULT_INJECTION_KEYS,
    LATCHED_ZENOH_MESSAGES_BY_ACTION,
    ROLE_DESCRIPTIONS,
    ZENOH_MESSAGES_BY_ACTION,
    AccessRule,
    Role,
)

INTRODUCTION = """\
# Roles

`make schemas` makes this page from `snakesim_hal/wire/roles.py`. `snakesim lab render` makes the access rules of a
lab's routers from the same table. A certificate gives a process one role for one robot. Keys are below that robot's
namespace. [docs/how-to/lab.md](../docs/how-to/lab.md) shows how a lab is set up.

What no cell grants is denied. Examples are other keys, other robots, `delete`, and a query where a stream is. A
wildcard is denied if it covers a key for which none is granted.
"""
NOTES = """\
A `gnc` publishes, declares and answers at `*` only under the names of its own services, as the lab file lists them. A
recorder does so only under the name `recorder`. At `process/*` these names are followed by `-` and an id.
Fault injection is granted only for a robot with `faults = true` in the lab file. An administrator may also query the
routers' own state (`@/**`), read-only. Subscribing is granted for any pattern within the robot's namespace. The
router then decides key by key what it delivers.
"""


def make_roles_page() -> str:
    """Generate the documentation page about the roles in a lab from the table of permissions, as Markdown."""
    return "\n".join(
        [
            INTRODUCTION,
            *_format_table(("role", "is"), ROLE_DESCRIPTIONS.items()),
            "",
            *_format_table(("key", *Role), [_make_key_row(rights) for rights in ACCESS_RULES]),
            "",
            NOTES,
            "## In Zenoh's words",
            "",
            "These Zenoh messages are accepted by a router from a process with this right, and sent to it.",
            "",
            *_format_table(("act", "in", "out"), _iter_message_rows()),
            "",
        ]
    )


def _make_key_row(rights: AccessRule) -> tuple[str, ...]:
    """Return one row of the table: a key, and the actions that each role may do at it."""
    condition = " (if allowed)" if rights.key in FAULT_INJECTION_KEYS else ""
    cells = [f"`{rights.key}`{condition}"]
    for role in Role:
        cells.append(", ".join(rights.list_actions(role)) or "-")
    return tuple(cells)


def _iter_message_rows() -> Iterator[tuple[str, ...]]:
    """Yield rows of an action and its Zenoh messages: those into the router, and those out of it."""
    for suffix, acts in (
        ("", ZENOH_MESSAGES_BY_ACTION),
        (", of a latched key also", LATCHED_ZENOH_MESSAGES_BY_ACTION),
    ):
        for act, messages in acts.items():
            yield (
                f"{act}{suffix}",
                _format_messages(messages, "ingress"),
                _format_messages(messages, "egress"),
            )


def _format_messages(messages: Iterable[tuple[str, str, str]], flow: str) -> str:
    """Return the messages of one direction as text for a cell of the table.

    Args:
        messages: Direction, name and suffix of the key for each message.
        flow: Direction: "ingress" into the router, or "egress" out of it.
    """
    names: list[str] = []
    for message_flow, message, key_suffix in messages:
        if message_flow != flow:
            continue
        place = f" at `KEY{key_suffix}`" if key_suffix else ""
        names.append(f"`{message}`{place}")
    return ", ".join(names) or "-"


def _format_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    titles = list(header)
    lines = [_format_table_row(titles), _format_table_row(["---"] * len(titles))]
    lines += [_format_table_row(row) for row in rows]
    return lines


def _format_table_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
