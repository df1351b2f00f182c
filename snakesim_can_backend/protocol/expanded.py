"""The DBC file with every message of every node.

For tools without an id mask: candump with cantools, SavvyCAN, Wireshark.
"""

import copy
from collections.abc import Iterable

from cantools.database.can import Database, Message

from snakesim_can_backend.protocol.codec import load_database
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    FIRST_NODE,
    LAST_NODE,
    NODE_BITS,
    Opcode,
)

TO_ALL = (Opcode.EMERGENCY, Opcode.SYNC)
TO_ONE_OR_ALL = (Opcode.COMMAND,)


def make_expanded_dbc() -> str:
    """Return the text of the expanded file. `JointState` of node 5 is called `JointState_05`."""
    source = load_database()
    messages: list[Message] = []
    for message in source.messages:
        for node in list_nodes(Opcode(message.frame_id >> NODE_BITS)):
            node_message = copy.deepcopy(message)
            node_message.frame_id = message.frame_id | node
            if node != BROADCAST:
                node_message.name = f"{message.name}_{node:02d}"
            messages.append(node_message)
    database = Database(
        messages, nodes=source.nodes, version=source.version, dbc_specifics=source.dbc, strict=True
    )
    return database.as_dbc_string(sort_signals="default").replace("\r\n", "\n")


def list_nodes(opcode: Opcode) -> Iterable[int]:
    """Return the nodes that send or receive a message."""
    if opcode in TO_ALL:
        return [BROADCAST]
    each = list(range(FIRST_NODE, LAST_NODE + 1))
    return [BROADCAST, *each] if opcode in TO_ONE_OR_ALL else each
