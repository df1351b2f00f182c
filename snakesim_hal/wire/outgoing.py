"""Checks a message before it is sent, as every reader will: a wrong one is its author's error, with field and value.

Without this check, each reader would count the message as malformed, far from where it was made, and its stream would
stop without an error.
"""

import re
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError, shorten, suggest_word
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import EncodedMessage, encode, get_decoder
from snakesim_hal.wire.custom_sample import CustomMessage
from snakesim_hal.wire.messages import VERSIONS, CustomSample, Message

ENCODING_ERRORS = (TypeError, ValueError, OverflowError, RecursionError)  # what the encoder raises
MAX_VALUE_LENGTH = 100  # characters of a value that an error quotes
# One step of the path in an error of msgspec, such as `.angle_rad` or `[3]`.
PATH_STEP = re.compile(r"\.(\w+)|\[(\d+)\]")
ANY_KEY = "[...]"  # in such a path: an entry of a table, without its key


def encode_checked(
    key: str, message: Message, custom: CustomMessage | None = None
) -> EncodedMessage:
    """Encode a message, and check that readers of its key accept it.

    Args:
        key: Key of the message, relative to the robot's namespace.
        message: Message to encode.
        custom: Message of a custom sensor as the robot describes it. None if the class of the message describes it.

    Returns:
        The bytes to send, and the message that readers decode from them.

    Raises:
        WireError: Readers would reject the message. The error names the field, its value, and what is allowed.
    """
    expected_type = _find_message_type(key, message, custom)
    payload = encode_unchecked(message)
    try:
        decoded = get_decoder(expected_type).decode_payload(payload)
    except WireError as error:
        raise WireError(error.reason, describe_invalid_field(message) or error.detail) from None
    return EncodedMessage(payload, decoded)


def _find_message_type(key: str, message: Message, custom: CustomMessage | None) -> type[Message]:
    """Return the type that readers of a key expect. Raises WireError if the message is of another one."""
    expected = keys.find_message(key)
    if expected is None:
        known = suggest_word(key, keys.ROW_AT)
        raise WireError(
            "unknown_key", f"there is no such key; {known}`snakesim topic echo` lists them"
        )
    if expected is CustomSample and isinstance(message, CustomSample):
        return type(message) if custom is None else custom.message
    if type(message) is not expected:
        raise WireError(
            "unknown_message", f"a {type(message).__name__}, must be a {expected.__name__}"
        )
    return expected


def encode_unchecked(message: Message) -> bytes:
    """Encode a message, within bounds or not. Raises WireError for values that no message can carry."""
    if type(message) not in VERSIONS and not isinstance(message, CustomSample):
        raise WireError("unknown_message", f"a {type(message).__name__} is no message")
    try:
        return encode(message)
    except ENCODING_ERRORS as error:
        raise WireError(
            "malformed", describe_invalid_field(message) or f"{type(error).__name__}: {error}"
        ) from None


def describe_invalid_field(message: Message, message_label: str = "") -> str:
    """Describe the first field value of a message that readers would reject.

    Args:
        message: Message to check.
        message_label: Name of the message in the text. Empty for the name of its class.

    Returns:
        The field, its value and what is allowed; empty if each value is valid by itself.
    """
    name = message_label or type(message).__name__
    for field in msgspec.structs.fields(type(message)):
        value = getattr(message, field.name)
        field_path = f"{name}.{field.name}"
        try:
            msgspec.msgpack.decode(encode(value), type=field.type)
        except msgspec.ValidationError as error:
            # An error of msgspec reads "Expected `float` <= 1.0 - at `$[3]`"; the path may be missing.
            expected, _, inner_path = str(error).removeprefix("Expected ").partition(" - at ")
            value, field_path = _follow_path(value, field_path, inner_path)
            return _describe_wrong_value(field_path, value, expected)
        except ENCODING_ERRORS:
            return _describe_wrong_value(
                field_path, value, "plain Python numbers, texts and lists: use float() or .tolist()"
            )
    return ""


def _follow_path(value: Any, field_path: str, inner_path: str) -> tuple[Any, str]:
    """Return the inner value that a path in an error of msgspec leads to, and the whole path to it.

    Args:
        value: Value of a field.
        field_path: Message and field, such as `JointState.angle_rad`.
        inner_path: Path in the error of msgspec, such as `$[3]`.
    """
    for name, index in PATH_STEP.findall(inner_path.partition(ANY_KEY)[0]):
        if index:
            value = value[int(index)]
            field_path = f"{field_path}[{index}]"
        else:
            value = value[name] if isinstance(value, dict) else getattr(value, name)
            field_path = f"{field_path}.{name}"
    return value, field_path


def _describe_wrong_value(field_path: str, value: object, expected: str) -> str:
    return f"{field_path} is {shorten(repr(value), MAX_VALUE_LENGTH)}, must be {expected}"
