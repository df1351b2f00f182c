"""Reading files: whatever is wrong ends in one ConfigError that says where, what, and what is allowed instead."""

from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import (
    ConfigTable,
    FileStruct,
    decode_table,
    iterate_leaves,
    list_shipped_names,
    read_table,
    resolve_file_path,
)
from snakesim_testing.messages import raises_error


class Part(FileStruct, frozen=True):
    """Something inside."""

    size_m: Annotated[float, Meta(gt=0, le=2, extra_json_schema={"unit": "m"})]
    many: Annotated[int, Meta(ge=1, lt=10)] = 1


class Whole(FileStruct, frozen=True):
    """A file."""

    part: Part
    parts: list[Part] = []
    by_name: dict[str, Part] = {}
    free: dict[str, dict[str, Any]] = {}
    at_m: tuple[Annotated[float, Meta(ge=-5, le=5, extra_json_schema={"unit": "m"})], float] = (
        0.0,
        0.0,
    )
    open: bool = False
    word: str = ""


GOOD = {"part": {"size_m": 1.0}}

WRONG: dict[str, dict[str, Any]] = {
    "missing": {"part": {}},
    "missing section": {},
    "type": {"part": {"size_m": "big"}},
    "section for number": {"part": {"size_m": {"x": 1}}},
    "number for section": {"part": 3},
    "below": {"part": {"size_m": 0.0}},
    "above": {"part": {"size_m": 3}},
    "nan": {"part": {"size_m": float("nan")}},
    "infinite": {"part": {"size_m": float("inf")}},
    "fraction": {"part": {"size_m": 1, "many": 1.5}},
    "unknown": {"part": {"size_m": 1, "mnay": 2}},
    "unknown, nothing like it": {**GOOD, "zzz": 1},
    "unknown section": {**GOOD, "prat": {"x": 1}},
    "no list": {**GOOD, "parts": 1},
    "in a list": {**GOOD, "parts": [{"size_m": 1}, {"size_m": 9}]},
    "unknown in a list": {**GOOD, "parts": [{"size": 1}]},
    "in a tuple": {**GOOD, "at_m": [9.0, 0.0]},
    "tuple too short": {**GOOD, "at_m": [1.0]},
    "free key": {**GOOD, "by_name": {"a": {"size_m": 1}, "b": {"size_m": 1, "many": 99}}},
    "unknown under a free key": {
        **GOOD,
        "by_name": {"ok": {"size_m": 1}, "b-2": {"size_m": 1, "mnay": 1}},
    },
    "missing under a free key": {**GOOD, "by_name": {"b": {}}},
    "free key that is no section": {**GOOD, "free": {"a": {}, "b": 3}},
    "flag": {**GOOD, "open": 1},
    "text": {**GOOD, "word": 1},
}


def test_a_section_of_a_larger_file_names_its_place_there() -> None:
    table = ConfigTable({"size_m": 5}, "my.toml", {"box.size_m": "--set box.size_m=5"})
    with raises_error(ConfigError, code="config/out-of-range", field="--set", value=5):
        decode_table(table, Part, "box")


def test_missing_field_error_names_file_where_it_belongs() -> None:
    table = ConfigTable({}, "outer.toml")
    table.set_value("parts", [], "outer.toml")
    table.set_value("part", {"many": 2, "typo": {"x": 1}}, "inner.toml")
    with raises_error(ConfigError, code="config/unknown-key", field="inner.toml"):
        decode_table(table, Whole)
    del table.values["part"]["typo"]
    with raises_error(ConfigError, code="config/missing-key", field="inner.toml"):
        decode_table(table, Whole)
    table.set_value("part.size_m", 7, "--set part.size_m=7")
    with raises_error(ConfigError, code="config/out-of-range", field="--set", value=7):
        decode_table(table, Whole)
    table.set_value("part.size_m", 1, "--set part.size_m=1")
    table.set_value("part.sise_m", 7, "--set part.sise_m=7")
    with raises_error(ConfigError, code="config/unknown-key", field="--set"):
        decode_table(table, Whole)


class Round(FileStruct, frozen=True, tag="round", tag_field="kind"):
    """One of two shapes."""

    radius_m: float


class Square(FileStruct, frozen=True, tag="square", tag_field="kind"):
    """The other."""

    edge_m: float
    color: Literal["red", "blue"] = "red"


class Grip(Enum):
    """How it holds."""

    FIRM = "firm"
    LOOSE = "loose"


class Thing(FileStruct, frozen=True):
    """Has a shape."""

    shape: Round | Square | None = None
    shapes: list[Round | Square] = []
    grip: Grip = Grip.FIRM


UNION: dict[str, dict[str, Any]] = {
    "unknown kind": {"shape": {"kind": "spiral"}},
    "unknown kind in a list": {"shapes": [{"kind": "round", "radius_m": 1}, {"kind": "x"}]},
    "kind of another type": {"shape": {"kind": 3}},
    "no kind": {"shape": {"radius_m": 1}},
    "no section": {"shape": 3},
    "field of the other kind": {"shape": {"kind": "square", "edge_m": 1, "radius_m": 1}},
    "field missing": {"shape": {"kind": "square"}},
    "wrong in the second kind": {"shape": {"kind": "square", "edge_m": 1, "color": "green"}},
    "enumeration": {"grip": "soft"},
}


@pytest.mark.parametrize("wrong", [*WRONG, *UNION])
def test_a_wrong_value_is_explained_by_what_is_allowed(wrong: str) -> None:
    values = WRONG[wrong] if wrong in WRONG else UNION[wrong]
    with raises_error(
        ConfigError,
        code=(
            "config/invalid-value",
            "config/missing-key",
            "config/out-of-range",
            "config/unknown-key",
        ),
        field="my.toml",
    ) as caught:
        decode_table(ConfigTable(values, "my.toml"), Whole if wrong in WRONG else Thing)
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__


@pytest.mark.parametrize(
    "values",
    [
        {"part": {"size_m": "x" * 100_000}},
        {"part": {"size_m": 1}, "x" * 100_000: 1},
        {"part": {"size_m": 1, "many": 1 << 60_000}},
        {"part": {"size_m": 1}, "a` - at `$.parts[7].size_m": 1},
        {"part": {"size_m": 1}, "a\nb": 1},
    ],
)
def test_what_is_quoted_is_short(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        decode_table(ConfigTable(values, "my.toml"), Whole)
    assert len(str(caught.value)) < 600


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-20, 20) | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["part", "parts", "by_name", "free", "at_m", "size_m", "many", "x.y"]),
            inner,
        )
    ),
    max_leaves=8,
)


@given(
    values=st.dictionaries(
        st.sampled_from(["part", "parts", "by_name", "free", "at_m", "open", "zz"]), JSON
    )
)
def test_any_values_decode_or_end_in_a_config_error(values: dict[str, Any]) -> None:
    try:
        assert isinstance(decode_table(ConfigTable(values, "my.toml"), Whole), Whole)
    except ConfigError as error:
        assert str(error).startswith("my.toml: ")


# --- files on disk ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.toml", b"robot = \n"),
        ("a.toml", b"a = 1\na = 2\n"),
        ("a.json", b""),
        ("a.json", b"[1, 2]"),
        ("a.json", b"{"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with raises_error(ConfigError, code="file/invalid-syntax") as caught:
        read_table(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_missing_file_error_names_it_and_existing_ones(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.toml").touch()
    with raises_error(ConfigError, code="file/not-found", field="a.toml"):
        read_table(tmp_path / "a.toml")


def test_find_takes_names_and_paths(tmp_path: Path) -> None:
    assert resolve_file_path("triplet", "scenes").is_file()
    assert resolve_file_path("x.toml", "robots", tmp_path) == tmp_path / "x.toml"
    assert resolve_file_path("/abs/x.toml", "robots", tmp_path) == Path("/abs/x.toml")
    assert resolve_file_path("sub/x", "robots", tmp_path) == tmp_path / "sub/x"
    with raises_error(
        ConfigError, code="config/unknown-name", field="planar31", stored=False
    ) as caught:
        resolve_file_path("planar31", "robots")
    assert all(name in str(caught.value) for name in list_shipped_names("robots"))


# --- where values come from ------------------------------------------------------------------------------------


def test_origins_follow_the_last_writer(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(
        "word = 'x'\n[part]\nsize_m = 1.0\nmany = 2\n[[parts]]\nsize_m = 1.0\n[free]\n"
    )
    table = read_table(tmp_path / "a.toml")
    file = str(tmp_path / "a.toml")
    table.set_value("part.many", 3, "--many 3")
    table.set_value("parts.0.size_m", 0.5, "--set parts.0.size_m=0.5")
    assert decode_table(table, Whole).parts[0].size_m == 0.5
    assert table.find_origin("part.size_m") == file
    assert table.find_origin("part.many") == "--many 3"
    assert table.find_origin("parts.0.size_m") == "--set parts.0.size_m=0.5"
    assert table.find_origin("at_m") == "default"
    assert table.find_origin("free.a.b") == "default"  # an empty section sets nothing
    table.set_value("part", {"size_m": 2.0}, "other.toml")
    assert table.find_origin("part.size_m") == "other.toml"
    assert table.find_origin("part.many") == "default"


def test_putting_into_lists() -> None:
    table = ConfigTable({"at_m": [0.0, 0.0], "parts": [{"size_m": 1.0}], "word": "x"}, "my.toml")
    table.set_value("at_m.1", 2.0, "--set at_m.1=2")
    assert table.values["at_m"] == [0.0, 2.0]
    for dotted in (
        "parts.1.size_m",
        "parts.-1.size_m",
        "parts.first.size_m",
        "at_m.2",
        "word.length",
    ):
        with raises_error(ConfigError, code="config/unknown-key", field=f"--set {dotted}=1"):
            table.set_value(dotted, 1, f"--set {dotted}=1")
    table.values["parts"] = []
    with raises_error(ConfigError, code="config/unknown-key"):
        table.set_value("parts.0.size_m", 1, "--set")


@given(
    st.recursive(
        st.integers(),
        lambda x: st.dictionaries(st.sampled_from("abc"), x, min_size=1),
        max_leaves=9,
    )
)
def test_leaves_and_put_are_each_others_inverse(value: Any) -> None:
    table = ConfigTable({}, "my.toml")
    for dotted, leaf in iterate_leaves({"root": value}):
        table.set_value(dotted, leaf, "flag")
    assert table.values == {"root": value}
    assert dict(iterate_leaves(table.values)) == dict(iterate_leaves({"root": value}))
    assert all(table.find_origin(dotted) == "flag" for dotted, _ in iterate_leaves(table.values))
