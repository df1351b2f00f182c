"""Writes `schemas/roles.md`: the table of roles as a page for people."""

from collections.abc import Iterable, Iterator

from snakesim_hal.wire.roles import INJECTION, MESSAGES, MESSAGES_OF_LATCHED, ROLE_DESCRIPTIONS, TABLE, KeyRights, Role

INTRODUCTION = """\
# Roles

Made by `make schemas` from `snakesim_hal/wire/roles.py`, as are the access rules that `snakesim lab render` writes
for a lab's routers. A certificate gives a process one role for one robot. Keys are below that robot's namespace. What
no cell grants is denied: other keys, other robots, `delete`, a query where a stream is, a wildcard that covers a key
where no wildcard is granted. [docs/how-to/lab.md](../docs/how-to/lab.md) shows how a lab is set up.
"""
NOTES = """\
A `gnc` publishes, declares and answers at `*` only under the names of its own services, as the lab file lists them, and
a recorder under the name `recorder`. At `process/*` these names are followed by `-` and an id.
Fault injection is granted only for a robot with `faults = true` in the lab file. An administrator may also query the
routers' own state (`@/**`), read-only. Subscribing is granted for any pattern within the robot's namespace: what is
then delivered is decided key by key.
"""


def roles_page() -> str:
    """Return the documentation page about the roles in a lab, generated from the table of permissions."""
    return "\n".join(
        [
            INTRODUCTION,
            *_table(("role", "is"), ROLE_DESCRIPTIONS.items()),
            "",
            *_table(("key", *Role), [_key_row(line) for line in TABLE]),
            "",
            NOTES,
            "## In Zenoh's words",
            "",
            "What a router lets in from such a process, and what it sends to it.",
            "",
            *_table(("act", "in", "out"), _message_rows()),
            "",
        ]
    )


def _key_row(line: KeyRights) -> tuple[str, ...]:
    """Return a key, and what each role may do at it."""
    condition = " (if allowed)" if line.key in INJECTION else ""
    cells = [f"`{line.key}`{condition}"]
    for role in Role:
        cells.append(", ".join(line.acts(role)) or "-")
    return tuple(cells)


def _message_rows() -> Iterator[tuple[str, ...]]:
    """Yield each act with the Zenoh messages that it consists of, into the router and out of it."""
    for suffix, acts in (("", MESSAGES), (", of a latched key also", MESSAGES_OF_LATCHED)):
        for act, messages in acts.items():
            yield f"{act}{suffix}", _format_messages(messages, "ingress"), _format_messages(messages, "egress")


def _format_messages(messages: Iterable[tuple[str, str, str]], flow: str) -> str:
    """Return the messages of a flow, as a cell. messages: flow, name, and what follows the key."""
    names: list[str] = []
    for message_flow, message, key_suffix in messages:
        if message_flow != flow:
            continue
        place = f" at `KEY{key_suffix}`" if key_suffix else ""
        names.append(f"`{message}`{place}")
    return ", ".join(names) or "-"


def _table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    titles = list(header)
    lines = [_table_line(titles), _table_line(["---"] * len(titles))]
    lines += [_table_line(row) for row in rows]
    return lines


def _table_line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
