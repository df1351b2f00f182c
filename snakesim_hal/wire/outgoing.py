"""Judges a message before it is sent, as every reader will: a wrong one is its author's error, with field and value.

Without this it would be counted by its readers, far from where it was made, and its stream would stop without a word.
"""

import re
from functools import cache
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError, did_you_mean, short
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, encoding_of
from snakesim_hal.wire.messages import VERSIONS, Message, OwnSample
from snakesim_hal.wire.own_sample import OwnKind

NOT_PLAIN = (TypeError, ValueError, OverflowError, RecursionError)  # what the encoder raises
LONGEST_VALUE = 100
STEP = re.compile(r"\.(\w+)|\[(\d+)\]")  # of the path in an error of msgspec

_decoder = cache(Decoder[Any])


def checked(key: str, message: Message, own: OwnKind | None = None) -> bytes:
    """The bytes of a message that readers of `key` accept. Raises WireError: field, value, and what is allowed.

    own: what the robot's description says of the message, if that is a sensor's own; None: its class says it.
    """
    wanted = keys.message_at(key)
    if wanted is None:
        known = did_you_mean(key, keys.ROW_AT)
        raise WireError("unknown_key", f"there is no such key; {known}`snakesim echo` lists them")
    if wanted is OwnSample and isinstance(message, OwnSample):
        wanted = type(message) if own is None else own.message
    elif type(message) is not wanted:
        raise WireError("unknown_message", f"a {type(message).__name__}, must be a {wanted.__name__}")
    payload = packed(message)
    try:
        _decoder(wanted).decode(payload, encoding_of(wanted))
    except WireError as error:
        raise WireError(error.reason, what_is_wrong(message) or error.detail) from None
    return payload


def packed(message: Message) -> bytes:
    """The bytes of a message, within bounds or not. Raises WireError for values that no message can carry."""
    if type(message) not in VERSIONS and not isinstance(message, OwnSample):
        raise WireError("unknown_message", f"a {type(message).__name__} is no message")
    try:
        return encode(message)
    except NOT_PLAIN as error:
        raise WireError("malformed", what_is_wrong(message) or f"{type(error).__name__}: {error}") from None


def what_is_wrong(message: Message, called: str = "") -> str:
    """The first value that no reader accepts, and what is allowed; empty: none is wrong by itself."""
    for field in msgspec.structs.fields(type(message)):
        value, where = getattr(message, field.name), f"{called or type(message).__name__}.{field.name}"
        try:
            msgspec.msgpack.decode(encode(value), type=field.type)
            continue
        except msgspec.ValidationError as error:
            expected, _, place = str(error).removeprefix("Expected ").partition(" - at ")
            for name, index in STEP.findall(place.partition("[...]")[0]):  # `[...]`: in a table, with whatever key
                if index:
                    value, where = value[int(index)], f"{where}[{index}]"
                else:
                    value = value[name] if isinstance(value, dict) else getattr(value, name)
                    where = f"{where}.{name}"
        except NOT_PLAIN:
            expected = "plain Python numbers, texts and lists: use float() or .tolist()"
        return f"{where} is {short(repr(value), LONGEST_VALUE)}, must be {expected}"
    return ""
