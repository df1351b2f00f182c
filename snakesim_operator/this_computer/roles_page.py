"""`schemas/roles.md`: the table of roles, as a page for people."""

from collections.abc import Iterable, Iterator

from snakesim_hal.wire.roles import ABOUT, INJECTION, MESSAGES, MESSAGES_OF_LATCHED, TABLE, Line, Role

INTRODUCTION = """\
# Roles

Made by `make schemas` from `snakesim_hal/wire/roles.py`, as are the access rules that `snakesim deploy render` writes
for a lab's routers. A certificate gives a process one role for one robot; keys are below that robot's namespace. What
no cell grants is denied: other keys, other robots, `delete`, a query where a stream is, a wildcard that covers a key
where no wildcard is granted. [docs/lab.md](../docs/lab.md) shows how a lab is set up.
"""
NOTES = """\
A `gnc` publishes, declares and answers at `*` only under the names of its own services, as the lab file lists them, and
a recorder under the name `recorder`; at `process/*` these names are followed by `-` and an id.
Fault injection is granted only for a robot with `faults = true` in the lab file. An administrator may also query the
routers' own state (`@/**`), read-only. Subscribing is granted for any pattern within the robot's namespace: what is
then delivered is decided key by key.
"""


def roles_page() -> str:
    """The page's text."""
    rows = [INTRODUCTION, *_table(("role", "is"), ((role, about) for role, about in ABOUT.items())), ""]
    rows += [*_table(("key", *Role), (_row(line) for line in TABLE)), "", NOTES, "## In Zenoh's words", ""]
    rows += ["What a router lets in from such a process, and what it sends to it.", ""]
    return "\n".join([*rows, *_table(("act", "in", "out"), _acts()), ""])


def _row(line: Line) -> tuple[str, ...]:
    marked = " (if allowed)" if line.key in INJECTION else ""
    return (f"`{line.key}`{marked}", *(", ".join(line.acts(role)) or "-" for role in Role))


def _acts() -> Iterator[tuple[str, ...]]:
    for about, acts in (("", MESSAGES), (", of a latched key also", MESSAGES_OF_LATCHED)):
        for act, messages in acts.items():
            yield f"{act}{about}", *(_passing(messages, flow) for flow in ("ingress", "egress"))


def _passing(messages: Iterable[tuple[str, str, str]], flow: str) -> str:
    """The messages of a flow, as a cell."""
    named = [f"`{message}`" + (f" at `KEY{after}`" if after else "") for at, message, after in messages if at == flow]
    return ", ".join(named) or "-"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    titles = list(head)
    return [f"| {' | '.join(cells)} |" for cells in (titles, ["---"] * len(titles), *(list(row) for row in rows))]
