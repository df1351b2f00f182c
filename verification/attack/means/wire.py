"""The wire as `schemas/` tells it to anybody: keys, encodings, and MessagePack of plain dicts."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import msgspec.msgpack

SCHEMAS = Path(__file__).parents[3] / "schemas"
PASSIVE, POSITION, VELOCITY, TORQUE = range(4)  # modes of a joint

_ROW = re.compile(r"^\| `(?P<key>[^`]+)` \|(?P<rest>.*)\|$")
_MESSAGE = re.compile(r"`snakesim\.(\w+)/\d+`")


class DocumentedKey(NamedTuple):
    """One line of schemas/keys.md."""

    key: str
    message: str | None
    kind: str


def _rows() -> dict[str, DocumentedKey]:
    found: dict[str, DocumentedKey] = {}
    for line in (SCHEMAS / "keys.md").read_text(encoding="utf-8").splitlines():
        if (row := _ROW.match(line)) is None:
            continue
        message = _MESSAGE.search(row["rest"])
        cells = {cell.strip() for cell in row["rest"].split("|")}
        kind = next(iter(cells & {"stream", "latched", "query", "liveliness"}))
        found[row["key"]] = DocumentedKey(row["key"], message and message[1], kind)
    return found


ROWS = _rows()
QUERIES = tuple(key for key, row in ROWS.items() if row.kind == "query")
STREAMS = tuple(key for key, row in ROWS.items() if row.kind in ("stream", "latched"))


def schema(message: str) -> dict[str, Any]:
    """The JSON Schema of a message, as it lies in schemas/messages."""
    return json.loads((SCHEMAS / "messages" / f"{message}.json").read_text(encoding="utf-8"))


def required(message: str) -> set[str]:
    """What a message must carry."""
    return set(schema(message)["$defs"][message]["required"])


def message_of(key: str) -> str:
    """The message that stands at a key; `fault/run` is found as `fault/*`."""
    row = ROWS.get(key) or ROWS.get(f"{key.rpartition('/')[0]}/*")
    if row is None or row.message is None:
        raise KeyError(f"schemas/keys.md has no message at {key!r}")
    return row.message


def encoding_of(key: str) -> str:
    """The Zenoh encoding of what stands at a key."""
    return schema(message_of(key))["encoding"]


encode = msgspec.msgpack.encode


def decode(payload: bytes) -> Any:
    """Plain dicts, lists, numbers and text."""
    return msgspec.msgpack.decode(payload)


def deep(levels: int) -> bytes:
    """MessagePack of a list in a list in a list, and so on."""
    return b"\x91" * levels + b"\xc0"
