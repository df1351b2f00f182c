"""Checks a message before it is sent, as every reader will: a wrong one is its author's error, with field and value.

Without this check, each reader would count the message as malformed, far from where it was made, and its stream would
stop without an error.
"""

import re
from functools import cache
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError, shorten, suggest_word
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode
from snakesim_hal.wire.custom_sample import CustomMessage
from snakesim_hal.wire.messages import VERSIONS, CustomSample, Message

NOT_PLAIN = (TypeError, ValueError, OverflowError, RecursionError)  # what the encoder raises
MAX_VALUE_LENGTH = 100  # characters of a value that an error quotes
# One step of the path in an error of msgspec, such as `.angle_rad` or `[3]`.
PATH_STEP = re.compile(r"\.(\w+)|\[(\d+)\]")
ANY_KEY = "[...]"  # in such a path: an entry of a table, without its key

_decoder = cache(Decoder[Any])


def encode_checked(key: str, message: Message, custom: CustomMessage | None = None) -> bytes:
    """Encode a message, after a check that readers of its key accept it.

    Args:
        key: where it is sent, relative to the robot's namespace.
        message: the message.
        custom: the description of a custom sensor's message by the robot; None: its class describes it.

    Raises:
        WireError: readers would reject it; names field, value, and what is allowed.
    """
    expected = _find_message_type(key, message, custom)
    payload = encode_unchecked(message)
    try:
        _decoder(expected).decode_payload(payload)
    except WireError as error:
        raise WireError(error.reason, find_wrong_value(message) or error.detail) from None
    return payload


def _find_message_type(key: str, message: Message, custom: CustomMessage | None) -> type[Message]:
    """Return the type that readers of a key expect. Raises WireError if the message is of another one."""
    expected = keys.find_message(key)
    if expected is None:
        known = suggest_word(key, keys.ROW_AT)
        raise WireError("unknown_key", f"there is no such key; {known}`snakesim topic echo` lists them")
    if expected is CustomSample and isinstance(message, CustomSample):
        return type(message) if custom is None else custom.message
    if type(message) is not expected:
        raise WireError("unknown_message", f"a {type(message).__name__}, must be a {expected.__name__}")
    return expected


def encode_unchecked(message: Message) -> bytes:
    """Encode a message, within bounds or not. Raises WireError for values that no message can carry."""
    if type(message) not in VERSIONS and not isinstance(message, CustomSample):
        raise WireError("unknown_message", f"a {type(message).__name__} is no message")
    try:
        return encode(message)
    except NOT_PLAIN as error:
        raise WireError("malformed", find_wrong_value(message) or f"{type(error).__name__}: {error}") from None


def find_wrong_value(message: Message, called: str = "") -> str:
    """Describe the first field value of a message that readers would reject.

    Args:
        message: the message.
        called: name of the message in the text; empty means the name of its class.

    Returns:
        The field, its value and what is allowed; empty if each value is valid by itself.
    """
    name = called or type(message).__name__
    for field in msgspec.structs.fields(type(message)):
        value = getattr(message, field.name)
        where = f"{name}.{field.name}"
        try:
            msgspec.msgpack.decode(encode(value), type=field.type)
        except msgspec.ValidationError as error:
            expected, _, path = str(error).removeprefix("Expected ").partition(" - at ")
            value, where = _follow_path(value, where, path)
            return _describe_wrong_value(where, value, expected)
        except NOT_PLAIN:
            return _describe_wrong_value(
                where, value, "plain Python numbers, texts and lists: use float() or .tolist()"
            )
    return ""


def _follow_path(value: Any, where: str, path: str) -> tuple[Any, str]:
    """Return the inner value that a path in an error of msgspec leads to, and its name."""
    for name, index in PATH_STEP.findall(path.partition(ANY_KEY)[0]):
        if index:
            value = value[int(index)]
            where = f"{where}[{index}]"
        else:
            value = value[name] if isinstance(value, dict) else getattr(value, name)
            where = f"{where}.{name}"
    return value, where


def _describe_wrong_value(where: str, value: object, expected: str) -> str:
    return f"{where} is {shorten(repr(value), MAX_VALUE_LENGTH)}, must be {expected}"
