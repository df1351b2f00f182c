"""Every key of the key space is parsed to its message, and unknown keys are parsed to None."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ColorImage, DepthImage, RangeScan, TickDone

KEY_CHUNKS = st.text(
    st.characters(categories=("L", "N"), include_characters="_-"), min_size=1, max_size=12
)
NAMESPACES = st.lists(KEY_CHUNKS, min_size=1, max_size=3).map("/".join)


def replace_wildcard(key: str) -> str:
    """Replace the wildcard of a key with a name."""
    return key.replace("*", "control")


@pytest.mark.parametrize("row", keys.SPACE, ids=lambda row: row.key)
def test_keys_of_the_space_are_parsed_to_their_message(row: keys.KeyRow) -> None:
    key = replace_wildcard(row.key)
    assert keys.find_message(key) is row.message
    assert keys.split_namespace(key) is None  # this key has no namespace
    assert row.kind in ("stream", "latched", "query", "liveliness")
    assert row.writer
    assert row.description


def test_keys_are_unique_without_outer_slashes() -> None:
    all_keys = [row.key for row in keys.SPACE]
    assert len(set(all_keys)) == len(all_keys)
    assert not any(key.startswith("/") or key.endswith("/") or "//" in key for key in all_keys)


def test_keys_in_constants_equal_the_key_space() -> None:
    constants = {
        value for name, value in vars(keys).items() if name[0].isupper() and isinstance(value, str)
    }
    assert constants == {row.key for row in keys.SPACE}


@given(name=KEY_CHUNKS)
def test_keys_of_a_service_or_sensor_contain_its_name(name: str) -> None:
    assert (
        keys.parse_service(keys.done_key(name)) == keys.parse_service(keys.alive_key(name)) == name
    )
    assert keys.find_message(keys.done_key(name)) is TickDone
    assert keys.find_message(keys.depth_key(name)) is DepthImage
    assert keys.find_message(keys.color_key(name)) is ColorImage
    assert keys.find_message(keys.ranges_key(name)) is RangeScan


@given(namespace=NAMESPACES, row=st.sampled_from(keys.SPACE))
def test_keys_split_into_namespace_and_key(namespace: str, row: keys.KeyRow) -> None:
    key = replace_wildcard(row.key)
    assert keys.split_namespace(f"{namespace}/{key}") == (namespace, key)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "sensor",
        "sensor/joint",
        "sensor/joints/0",
        "sensor/depth",
        "sensor/depth/",
        "sensor/depth/head/left",
        "hal/done",
        "hal/done/a/b",
        "alive",
        "planar13",
    ],
)
def test_keys_outside_the_space_are_parsed_to_none(key: str) -> None:
    assert keys.find_message(key) is None
    assert keys.split_namespace(key) is None


@pytest.mark.parametrize("pattern", ["**", "*", "hal/done/*", "alive/**"])
def test_keys_with_pattern_name_no_service(pattern: str) -> None:
    """Return the wildcard, because any client may put on a pattern, which the host receives as the key."""
    assert keys.parse_service(pattern) in ("**", "*")
