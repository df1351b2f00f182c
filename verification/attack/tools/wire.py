"""The protocol as `schemas/` documents it: keys, encodings, and MessagePack of plain dicts.

It reads the table of keys in `schemas/keys.md` and the schemas of the messages in `schemas/messages`. Any client can do
the same.
"""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import msgspec.msgpack

SCHEMAS = Path(__file__).parents[3] / "schemas"
PASSIVE, POSITION, VELOCITY, TORQUE = range(4)  # modes of a joint
KEY_KINDS = {"stream", "latched", "query", "liveliness"}

_TABLE_ROW = re.compile(r"^\| `(?P<key>[^`]+)` \|(?P<cells>.*)\|$")
_MESSAGE_NAME = re.compile(r"`snakesim\.(\w+)/\d+`")

encode = msgspec.msgpack.encode
decode = msgspec.msgpack.decode


class DocumentedKey(NamedTuple):
    """One row of the table in `schemas/keys.md`."""

    key: str
    message: str | None
    kind: str


def _read_documented_keys() -> dict[str, DocumentedKey]:
    """Read all rows of the table, by their key."""
    documented: dict[str, DocumentedKey] = {}
    for line in (SCHEMAS / "keys.md").read_text(encoding="utf-8").splitlines():
        row = _TABLE_ROW.match(line)
        if row is None:
            continue
        key = row["key"]
        message = _MESSAGE_NAME.search(row["cells"])
        cells = {cell.strip() for cell in row["cells"].split("|")}
        kind = next(iter(cells & KEY_KINDS))
        documented[key] = DocumentedKey(key, message and message[1], kind)
    return documented


DOCUMENTED_KEYS = _read_documented_keys()
QUERY_KEYS = tuple(key for key, row in DOCUMENTED_KEYS.items() if row.kind == "query")
PUBLISHED_KEYS = tuple(
    key for key, row in DOCUMENTED_KEYS.items() if row.kind in ("stream", "latched")
)


def is_latched(key: str) -> bool:
    """Return whether a late subscriber gets the last value of a key."""
    return DOCUMENTED_KEYS[key].kind == "latched"


def is_stream(key: str) -> bool:
    """Return whether a key is published again and again."""
    return DOCUMENTED_KEYS[key].kind == "stream"


def find_message_name(key: str) -> str:
    """Return the name of the message of a key. A key such as `fault/run` has the message of `fault/*`.

    Raises:
        KeyError: The key is not documented, or has no message.
    """
    parent = key.rpartition("/")[0]
    row = DOCUMENTED_KEYS.get(key) or DOCUMENTED_KEYS.get(f"{parent}/*")
    if row is None or row.message is None:
        raise KeyError(f"schemas/keys.md has no message for {key!r}")
    return row.message


def read_schema(message_name: str) -> dict[str, Any]:
    """Return the JSON Schema of a message."""
    path = SCHEMAS / "messages" / f"{message_name}.json"
    return json.loads(path.read_text(encoding="utf-8"))


def find_required_fields(key: str) -> set[str]:
    """Return the names of the fields that the message of a key must contain."""
    message_name = find_message_name(key)
    return set(read_schema(message_name)["$defs"][message_name]["required"])


def find_encoding(key: str) -> str:
    """Return the Zenoh encoding of the message of a key."""
    return read_schema(find_message_name(key))["encoding"]


def make_nested_list_payload(depth: int) -> bytes:
    """Return the MessagePack of `None` inside a list inside a list, and so on."""
    return b"\x91" * depth + b"\xc0"
