"""The published schemas in `schemas/` equal those of the code, and messages and shipped files match them."""

import json
import math
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from snakesim_hal.base.errors import WireError
from snakesim_hal.model.files import list_shipped_names, read_table_with_base
from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import VERSIONS, Message
from snakesim_operator.this_computer.schemas import generate_contract_files, write_schemas
from snakesim_testing.hal.strategies import (
    iter_places,
    list_invalid_values,
    make_plain_example,
    make_strategy,
    replace_at,
)

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

REPOSITORY = Path(__file__).parents[4]
PUBLISHED = REPOSITORY / "schemas"
for_each_message = pytest.mark.parametrize(
    "message", list(VERSIONS), ids=lambda message: message.__name__
)


def read_files(folder: Path) -> dict[str, str]:
    """Return the texts of all files in a folder, by their relative path."""
    return {
        str(path.relative_to(folder)): path.read_text(encoding="utf-8")
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_schemas_published_files_equal_generated_files() -> None:
    published = read_files(PUBLISHED)
    generated = dict(generate_contract_files())
    # The schemas of the folder `can` have tests in tests/unit/can_backend.
    published = {name: text for name, text in published.items() if not name.startswith("can/")}
    for handwritten in ("README.md", "protocol.md"):
        del published[handwritten]
    assert sorted(published) == sorted(generated), "run `make schemas` and commit what it changes"
    for name, text in generated.items():
        assert published[name] == text, (
            f"schemas/{name} is out of date; run `make schemas` and commit what it changes"
        )


def test_writing_schemas_removes_files_outside_the_contract(tmp_path: Path) -> None:
    write_schemas(tmp_path)
    (tmp_path / "messages" / "Gone.json").write_text("{}")
    (tmp_path / "README.md").write_text("by hand")
    written = write_schemas(tmp_path)
    remaining = read_files(tmp_path)
    assert remaining.pop("README.md") == "by hand"
    assert remaining == dict(generate_contract_files())
    assert {str(path.relative_to(tmp_path)) for path in written} == set(remaining)


def test_writing_schemas_into_foreign_folder_removes_nothing(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "thesis.json").write_text("{}")
    write_schemas(tmp_path)
    assert (tmp_path / "files" / "thesis.json").is_file()


# --- schemas and messages -------------------------------------------------------------------------------------


@cache
def generate_contract_once() -> dict[str, str]:
    """Return the generated files by name; they are generated only once."""
    return dict(generate_contract_files())


@cache
def make_validator(name: str) -> "Validator":
    """Return the validator of a schema, which is made only once."""
    # The import stands here, without the check of addresses that takes 2 s, because each worker imports this file.
    sys.modules.setdefault("rfc3987_syntax", None)  # pyright: ignore[reportArgumentType]
    from jsonschema import Draft202012Validator

    return Draft202012Validator(json.loads(generate_contract_once()[name]))


def matches_schema(value: Any, name: str) -> bool:
    """Return whether a schema allows this message or file; schemas represent bytes as base64."""
    return make_validator(name).is_valid(json.loads(msgspec.json.encode(value)))


def make_schema_name(message: type[Message]) -> str:
    """Return the file name of the schema of a message type."""
    return f"messages/{message.__name__}.json"


@for_each_message
@given(data=st.data())
@settings(max_examples=8)
def test_message_always_matches_its_schema(message: type[Message], data: st.DataObject) -> None:
    assert matches_schema(data.draw(make_strategy(message)), make_schema_name(message))


@for_each_message
def test_schema_and_decoder_require_the_same_fields(message: type[Message]) -> None:
    schema = json.loads(generate_contract_once()[make_schema_name(message)])
    assert schema["encoding"] == format_encoding(message)
    example = make_plain_example(message)
    assert matches_schema(example, make_schema_name(message))
    for field in example:
        incomplete = {name: value for name, value in example.items() if name != field}
        try:
            MessageDecoder(message).decode(encode(incomplete), format_encoding(message))
            is_decoded = True
        except WireError:
            is_decoded = False
        assert matches_schema(incomplete, make_schema_name(message)) == is_decoded, field


@for_each_message
def test_schema_refuses_values_that_the_decoder_refuses(message: type[Message]) -> None:
    example = make_plain_example(message)
    for place, type_info in iter_places(example, inspect.type_info(message)):
        for invalid in list_invalid_values(type_info):
            is_infinite = isinstance(invalid, float) and not math.isfinite(invalid)
            if is_infinite or isinstance(invalid, bytes):
                continue  # JSON has no such value
            changed = replace_at(example, place, invalid)
            assert not matches_schema(changed, make_schema_name(message)), (
                f"{place} accepts {invalid!r}"
            )


# --- the files that are shipped --------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "schema"), [("robots", "robot"), ("scenes", "scene")])
def test_shipped_file_matches_its_schema_and_contains_its_name(kind: str, schema: str) -> None:
    for name in list_shipped_names(kind):
        values = read_table_with_base(name, kind).values
        assert matches_schema(values, f"files/{schema}.json"), name
        assert values["name"] == name


@pytest.mark.parametrize("name", list_shipped_names("scenarios"))
def test_shipped_scenario_loads_and_matches_run_schema(name: str) -> None:
    config = load_scenario(name).config
    assert config.name == name
    assert matches_schema(config, "files/run.json")
