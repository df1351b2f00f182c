"""Reading files: whatever is wrong ends in one ConfigError that says where, what, and what is allowed instead."""

from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct, Table, decode, find_file, leaves, list_shipped, read_table
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
    at_m: tuple[Annotated[float, Meta(ge=-5, le=5, extra_json_schema={"unit": "m"})], float] = (0.0, 0.0)
    open: bool = False
    word: str = ""


GOOD = {"part": {"size_m": 1.0}}

WRONG: dict[str, tuple[dict[str, Any], list[str]]] = {
    "missing": ({"part": {}}, ["`part.size_m` is missing", "a number > 0 and <= 2 in m"]),
    "missing section": ({}, ["`part` is missing", "a section with size_m, many"]),
    "type": ({"part": {"size_m": "big"}}, ["`part.size_m` = 'big'", "a number > 0 and <= 2 in m"]),
    "section for number": ({"part": {"size_m": {"x": 1}}}, ["`part.size_m`", "a number"]),
    "number for section": ({"part": 3}, ["`part` = 3", "a section with size_m"]),
    "below": ({"part": {"size_m": 0.0}}, ["`part.size_m` = 0.0 m", "> 0"]),
    "above": ({"part": {"size_m": 3}}, ["`part.size_m` = 3 m", "<= 2"]),
    "nan": ({"part": {"size_m": float("nan")}}, ["`part.size_m` = nan m"]),
    "infinite": ({"part": {"size_m": float("inf")}}, ["`part.size_m` = inf m"]),
    "fraction": ({"part": {"size_m": 1, "many": 1.5}}, ["`part.many` = 1.5", "a whole number >= 1 and < 10"]),
    "unknown": ({"part": {"size_m": 1, "mnay": 2}}, ["unknown field `part.mnay`", "did you mean `many`?"]),
    "unknown, nothing like it": ({**GOOD, "zzz": 1}, ["unknown field `zzz`", "known fields: at_m, by_name, free"]),
    "unknown section": ({**GOOD, "prat": {"x": 1}}, ["unknown field `prat`", "did you mean `part`?"]),
    "no list": ({**GOOD, "parts": 1}, ["`parts` = 1", "a list, each a section with size_m"]),
    "in a list": ({**GOOD, "parts": [{"size_m": 1}, {"size_m": 9}]}, ["`parts.1.size_m` = 9 m", "<= 2"]),
    "unknown in a list": ({**GOOD, "parts": [{"size": 1}]}, ["unknown field `parts.0.size`", "`size_m`"]),
    "in a tuple": ({**GOOD, "at_m": [9.0, 0.0]}, ["`at_m.0` = 9.0 m", ">= -5 and <= 5"]),
    "tuple too short": ({**GOOD, "at_m": [1.0]}, ["`at_m` = [1.0]", "2 values"]),
    "free key": (
        {**GOOD, "by_name": {"a": {"size_m": 1}, "b": {"size_m": 1, "many": 99}}},
        ["`by_name.b.many` = 99", ">= 1 and < 10"],
    ),
    "unknown under a free key": (
        {**GOOD, "by_name": {"ok": {"size_m": 1}, "b-2": {"size_m": 1, "mnay": 1}}},
        ["unknown field `by_name.b-2.mnay`", "did you mean `many`?"],
    ),
    "missing under a free key": ({**GOOD, "by_name": {"b": {}}}, ["`by_name.b.size_m` is missing"]),
    "free key that is no section": ({**GOOD, "free": {"a": {}, "b": 3}}, ["`free.b` = 3"]),
    "flag": ({**GOOD, "open": 1}, ["`open` = 1", "true or false"]),
    "text": ({**GOOD, "word": 1}, ["`word` = 1", "a text"]),
}


def test_a_section_of_a_larger_file_names_its_place_there() -> None:
    table = Table({"size_m": 5}, "my.toml", {"box.size_m": "--set box.size_m=5"})
    with raises_error(ConfigError, code="config/out-of-range", field="--set", value=5):
        decode(table, Part, "box")


def test_the_error_names_the_file_in_which_the_field_should_stand() -> None:
    table = Table({}, "outer.toml")
    table.put("parts", [], "outer.toml")
    table.put("part", {"many": 2, "typo": {"x": 1}}, "inner.toml")
    with raises_error(ConfigError, code="config/unknown-key", field="inner.toml"):
        decode(table, Whole)
    del table.values["part"]["typo"]
    with raises_error(ConfigError, code="config/missing-key", field="inner.toml"):
        decode(table, Whole)
    table.put("part.size_m", 7, "--set part.size_m=7")
    with raises_error(ConfigError, code="config/out-of-range", field="--set", value=7):
        decode(table, Whole)
    table.put("part.size_m", 1, "--set part.size_m=1")
    table.put("part.sise_m", 7, "--set part.sise_m=7")
    with raises_error(ConfigError, code="config/unknown-key", field="--set"):
        decode(table, Whole)


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


UNION: dict[str, tuple[dict[str, Any], list[str]]] = {
    "unknown kind": ({"shape": {"kind": "spiral"}}, ["`shape.kind` = 'spiral'", "one of 'round', 'square'"]),
    "unknown kind in a list": (
        {"shapes": [{"kind": "round", "radius_m": 1}, {"kind": "x"}]},
        ["`shapes.1.kind` = 'x'", "one of 'round', 'square'"],
    ),
    "kind of another type": ({"shape": {"kind": 3}}, ["`shape.kind` = 3", "one of 'round', 'square'"]),
    "no kind": ({"shape": {"radius_m": 1}}, ["`shape.kind` is missing", "one of 'round', 'square'"]),
    "no section": ({"shape": 3}, ["`shape` = 3", "kind = 'round', radius_m", "kind = 'square', edge_m, color"]),
    "field of the other kind": (
        {"shape": {"kind": "square", "edge_m": 1, "radius_m": 1}},
        ["unknown field `shape.radius_m`", "known fields: color, edge_m, kind"],
    ),
    "field missing": ({"shape": {"kind": "square"}}, ["`shape.edge_m` is missing", "a number"]),
    "wrong in the second kind": (
        {"shape": {"kind": "square", "edge_m": 1, "color": "green"}},
        ["`shape.color` = 'green'", "one of 'blue', 'red'"],
    ),
    "enumeration": ({"grip": "soft"}, ["`grip` = 'soft'", "one of 'firm', 'loose'"]),
}


@pytest.mark.parametrize("wrong", [*WRONG, *UNION])
def test_a_wrong_value_is_explained_by_what_is_allowed(wrong: str) -> None:
    values, words = WRONG.get(wrong) or UNION[wrong]
    with pytest.raises(ConfigError) as caught:
        decode(Table(values, "my.toml"), Whole if wrong in WRONG else Thing)
    said = str(caught.value)
    assert said.startswith("my.toml: ")
    for word in words:
        assert word in said, said
    assert "\n" not in said and caught.value.__cause__ is None and caught.value.__suppress_context__


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
        decode(Table(values, "my.toml"), Whole)
    assert len(str(caught.value)) < 600


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-20, 20) | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["part", "parts", "by_name", "free", "at_m", "size_m", "many", "x.y"]), inner)
    ),
    max_leaves=8,
)


@given(values=st.dictionaries(st.sampled_from(["part", "parts", "by_name", "free", "at_m", "open", "zz"]), JSON))
def test_any_values_decode_or_end_in_a_config_error(values: dict[str, Any]) -> None:
    try:
        assert isinstance(decode(Table(values, "my.toml"), Whole), Whole)
    except ConfigError as error:
        assert str(error).startswith("my.toml: ")


# --- files on disk ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.toml", b"robot = \n", ["not valid TOML", "line 1"]),
        ("a.toml", b"a = 1\na = 2\n", ["not valid TOML"]),
        ("a.json", b"", ["not valid JSON"]),
        ("a.json", b"[1, 2]", ["holds a list"]),
        ("a.json", b"{", ["not valid JSON"]),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, name: str, content: bytes, words: list[str]) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read_table(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert all(word in str(caught.value) for word in words)


def test_a_file_that_is_not_there_is_named_and_so_are_those_that_are(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.toml").touch()
    with raises_error(ConfigError, code="file/not-found", field="a.toml"):
        read_table(tmp_path / "a.toml")


def test_find_takes_names_and_paths(tmp_path: Path) -> None:
    assert find_file("triplet", "scenes").is_file()
    assert find_file("x.toml", "robots", tmp_path) == tmp_path / "x.toml"
    assert find_file("/abs/x.toml", "robots", tmp_path) == Path("/abs/x.toml")
    assert find_file("sub/x", "robots", tmp_path) == tmp_path / "sub/x"
    with pytest.raises(ConfigError) as caught:
        find_file("planar31", "robots")
    assert "no robot called 'planar31'" in str(caught.value)
    assert all(name in str(caught.value) for name in list_shipped("robots"))


# --- where values come from ------------------------------------------------------------------------------------


def test_origins_follow_the_last_writer(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("word = 'x'\n[part]\nsize_m = 1.0\nmany = 2\n[[parts]]\nsize_m = 1.0\n[free]\n")
    table = read_table(tmp_path / "a.toml")
    file = str(tmp_path / "a.toml")
    table.put("part.many", 3, "--many 3")
    table.put("parts.0.size_m", 0.5, "--set parts.0.size_m=0.5")
    assert decode(table, Whole).parts[0].size_m == 0.5
    assert table.origin_of("part.size_m") == file
    assert table.origin_of("part.many") == "--many 3"
    assert table.origin_of("parts.0.size_m") == "--set parts.0.size_m=0.5"
    assert table.origin_of("at_m") == "default"
    assert table.origin_of("free.a.b") == "default"  # an empty section sets nothing
    table.put("part", {"size_m": 2.0}, "other.toml")
    assert (table.origin_of("part.size_m"), table.origin_of("part.many")) == ("other.toml", "default")


def test_putting_into_lists() -> None:
    table = Table({"at_m": [0.0, 0.0], "parts": [{"size_m": 1.0}], "word": "x"}, "my.toml")
    table.put("at_m.1", 2.0, "--set at_m.1=2")
    assert table.values["at_m"] == [0.0, 2.0]
    for dotted, words in {
        "parts.1.size_m": "`parts.1`: the list has entries 0 to 0",
        "parts.-1.size_m": "`parts.-1`: the list has entries 0 to 0",
        "parts.first.size_m": "`parts.first`: the list has entries 0 to 0; name one by its number",
        "at_m.2": "`at_m.2`: the list has entries 0 to 1",
        "word.length": "`word` is the value 'x', not a section",
    }.items():
        with pytest.raises(ConfigError) as caught:
            table.put(dotted, 1, f"--set {dotted}=1")
        assert str(caught.value).startswith(f"--set {dotted}=1: ") and words in str(caught.value)
    table.values["parts"] = []
    with raises_error(ConfigError, code="config/unknown-key"):
        table.put("parts.0.size_m", 1, "--set")


@given(st.recursive(st.integers(), lambda x: st.dictionaries(st.sampled_from("abc"), x, min_size=1), max_leaves=9))
def test_leaves_and_put_are_each_others_inverse(value: Any) -> None:
    table = Table({}, "my.toml")
    for dotted, leaf in leaves({"root": value}):
        table.put(dotted, leaf, "flag")
    assert table.values == {"root": value}
    assert dict(leaves(table.values)) == dict(leaves({"root": value}))
    assert all(table.origin_of(dotted) == "flag" for dotted, _ in leaves(table.values))
