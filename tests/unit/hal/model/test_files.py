"""Any error in a file causes one ConfigError that names the place, the value, and what is allowed."""

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
    """A section of a file."""

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


VALID_VALUES = {"part": {"size_m": 1.0}}

INVALID_VALUES: dict[str, dict[str, Any]] = {
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
    "unknown, nothing like it": {**VALID_VALUES, "zzz": 1},
    "unknown section": {**VALID_VALUES, "prat": {"x": 1}},
    "no list": {**VALID_VALUES, "parts": 1},
    "in a list": {**VALID_VALUES, "parts": [{"size_m": 1}, {"size_m": 9}]},
    "unknown in a list": {**VALID_VALUES, "parts": [{"size": 1}]},
    "in a tuple": {**VALID_VALUES, "at_m": [9.0, 0.0]},
    "tuple too short": {**VALID_VALUES, "at_m": [1.0]},
    "free key": {**VALID_VALUES, "by_name": {"a": {"size_m": 1}, "b": {"size_m": 1, "many": 99}}},
    "unknown under a free key": {
        **VALID_VALUES,
        "by_name": {"ok": {"size_m": 1}, "b-2": {"size_m": 1, "mnay": 1}},
    },
    "missing under a free key": {**VALID_VALUES, "by_name": {"b": {}}},
    "free key that is no section": {**VALID_VALUES, "free": {"a": {}, "b": 3}},
    "flag": {**VALID_VALUES, "open": 1},
    "text": {**VALID_VALUES, "word": 1},
}


def test_section_of_larger_file_is_named_by_its_place() -> None:
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
    """The other shape."""

    edge_m: float
    color: Literal["red", "blue"] = "red"


class Grip(Enum):
    """The kinds of a grip."""

    FIRM = "firm"
    LOOSE = "loose"


class Thing(FileStruct, frozen=True):
    """A file with a choice of shapes."""

    shape: Round | Square | None = None
    shapes: list[Round | Square] = []
    grip: Grip = Grip.FIRM


INVALID_CHOICES: dict[str, dict[str, Any]] = {
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


@pytest.mark.parametrize("case", [*INVALID_VALUES, *INVALID_CHOICES])
def test_invalid_value_is_refused_with_what_is_allowed(case: str) -> None:
    values = INVALID_VALUES[case] if case in INVALID_VALUES else INVALID_CHOICES[case]
    with raises_error(
        ConfigError,
        code=(
            "config/invalid-value",
            "config/missing-key",
            "config/out-of-range",
            "config/unknown-key",
        ),
        field="my.toml",
    ) as refusal:
        decode_table(ConfigTable(values, "my.toml"), Whole if case in INVALID_VALUES else Thing)
    assert "\n" not in str(refusal.value)
    assert refusal.value.__cause__ is None
    assert refusal.value.__suppress_context__


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
def test_long_invalid_value_is_quoted_shortly(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as refusal:
        decode_table(ConfigTable(values, "my.toml"), Whole)
    assert len(str(refusal.value)) < 600


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
def test_arbitrary_values_are_decoded_or_cause_a_config_error(values: dict[str, Any]) -> None:
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
def test_file_with_invalid_syntax_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with raises_error(ConfigError, code="file/invalid-syntax") as refusal:
        read_table(path)
    assert str(refusal.value).startswith(f"{path}: ")


def test_missing_file_error_names_it_and_existing_ones(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.toml").touch()
    with raises_error(ConfigError, code="file/not-found", field="a.toml"):
        read_table(tmp_path / "a.toml")


def test_file_path_is_resolved_from_name_or_path(tmp_path: Path) -> None:
    assert resolve_file_path("triplet", "scenes").is_file()
    assert resolve_file_path("x.toml", "robots", tmp_path) == tmp_path / "x.toml"
    assert resolve_file_path("/abs/x.toml", "robots", tmp_path) == Path("/abs/x.toml")
    assert resolve_file_path("sub/x", "robots", tmp_path) == tmp_path / "sub/x"
    with raises_error(
        ConfigError, code="config/unknown-name", field="planar31", stored=False
    ) as refusal:
        resolve_file_path("planar31", "robots")
    assert all(name in str(refusal.value) for name in list_shipped_names("robots"))


# --- origins of values -----------------------------------------------------------------------------------------


def test_origin_of_a_value_is_its_last_writer(tmp_path: Path) -> None:
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
    assert table.find_origin("free.a.b") == "default"  # an empty section sets no value
    table.set_value("part", {"size_m": 2.0}, "other.toml")
    assert table.find_origin("part.size_m") == "other.toml"
    assert table.find_origin("part.many") == "default"


def test_value_in_a_list_is_set_only_at_valid_index() -> None:
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
        lambda children: st.dictionaries(st.sampled_from("abc"), children, min_size=1),
        max_leaves=9,
    )
)
def test_leaves_set_one_by_one_restore_the_table(value: Any) -> None:
    table = ConfigTable({}, "my.toml")
    for dotted, leaf in iterate_leaves({"root": value}):
        table.set_value(dotted, leaf, "flag")
    assert table.values == {"root": value}
    assert dict(iterate_leaves(table.values)) == dict(iterate_leaves({"root": value}))
    assert all(table.find_origin(dotted) == "flag" for dotted, _ in iterate_leaves(table.values))
