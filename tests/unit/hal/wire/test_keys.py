"""The key space: every key that is built parses back, and strange keys parse to nothing."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ColorImage, DepthImage, RangeScan, TickDone

CHUNK = st.text(
    st.characters(categories=("L", "N"), include_characters="_-"), min_size=1, max_size=12
)
NAMESPACE = st.lists(CHUNK, min_size=1, max_size=3).map("/".join)


def concrete(key: str) -> str:
    return key.replace("*", "control")


@pytest.mark.parametrize("row", keys.SPACE, ids=lambda row: row.key)
def test_every_key_of_the_space_parses_back(row: keys.KeyRow) -> None:
    key = concrete(row.key)
    assert keys.find_message(key) is row.message
    assert keys.split_namespace(key) is None  # without a namespace there is nothing to split off
    assert row.kind in ("stream", "latched", "query", "liveliness")
    assert row.writer
    assert row.description


def test_keys_are_unique_without_outer_slashes() -> None:
    found = [row.key for row in keys.SPACE]
    assert len(set(found)) == len(found)
    assert not any(key.startswith("/") or key.endswith("/") or "//" in key for key in found)


def test_every_key_constant_is_in_the_space() -> None:
    constants = {
        value for name, value in vars(keys).items() if name[0].isupper() and isinstance(value, str)
    }
    assert constants == {row.key for row in keys.SPACE}


@given(name=CHUNK)
def test_keys_of_a_service_or_sensor_contain_its_name(name: str) -> None:
    assert (
        keys.parse_service(keys.done_key(name)) == keys.parse_service(keys.alive_key(name)) == name
    )
    assert keys.find_message(keys.done_key(name)) is TickDone
    assert keys.find_message(keys.depth_key(name)) is DepthImage
    assert keys.find_message(keys.color_key(name)) is ColorImage
    assert keys.find_message(keys.ranges_key(name)) is RangeScan


@given(namespace=NAMESPACE, row=st.sampled_from(keys.SPACE))
def test_keys_split_into_namespace_and_key(namespace: str, row: keys.KeyRow) -> None:
    key = concrete(row.key)
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
def test_keys_outside_the_space_parse_to_nothing(key: str) -> None:
    assert keys.find_message(key) is None
    assert keys.split_namespace(key) is None


@pytest.mark.parametrize("pattern", ["**", "*", "hal/done/*", "alive/**"])
def test_keys_with_pattern_from_a_stranger_name_no_service(pattern: str) -> None:
    """Zenoh lets anybody put on a pattern; the host then sees the pattern as the key."""
    assert keys.parse_service(pattern) in ("**", "*")
