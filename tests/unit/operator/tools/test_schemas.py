"""The published contract in `schemas/` is what the code says, to the letter, and what the code sends fits it."""

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
each_message = pytest.mark.parametrize(
    "message", list(VERSIONS), ids=lambda message: message.__name__
)


def files_under(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): p.read_text(encoding="utf-8")
        for p in folder.rglob("*")
        if p.is_file()
    }


def test_the_published_files_are_what_the_code_says() -> None:
    published, generated = files_under(PUBLISHED), dict(generate_contract_files())
    # Tests/unit/can_backend.
    published = {name: text for name, text in published.items() if not name.startswith("can/")}
    for by_hand in ("README.md", "protocol.md"):
        del published[by_hand]
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
    found = files_under(tmp_path)
    assert found.pop("README.md") == "by hand"
    assert found == dict(generate_contract_files())
    assert {str(path.relative_to(tmp_path)) for path in written} == set(found)


def test_writing_schemas_into_foreign_folder_removes_nothing(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "thesis.json").write_text("{}")
    write_schemas(tmp_path)
    assert (tmp_path / "files" / "thesis.json").is_file()


# --- schema against messages -----------------------------------------------------------------------------------


@cache
def published_contract() -> dict[str, str]:
    return dict(generate_contract_files())


@cache
def validator(name: str) -> "Validator":
    # Imported here, and without its check of addresses, which takes 2 s: each worker imports this file.
    sys.modules.setdefault("rfc3987_syntax", None)  # pyright: ignore[reportArgumentType]
    from jsonschema import Draft202012Validator

    return Draft202012Validator(json.loads(published_contract()[name]))


def fits(value: Any, name: str) -> bool:
    """Whether a message or file is what a published schema allows; bytes are base64 there."""
    return validator(name).is_valid(json.loads(msgspec.json.encode(value)))


def schema_name(message: type[Message]) -> str:
    return f"messages/{message.__name__}.json"


@each_message
@given(data=st.data())
@settings(max_examples=8)
def test_every_message_fits_its_schema(message: type[Message], data: st.DataObject) -> None:
    assert fits(data.draw(make_strategy(message)), schema_name(message))


@each_message
def test_schema_and_decoder_agree_on_what_is_missing(message: type[Message]) -> None:
    assert json.loads(published_contract()[schema_name(message)])["encoding"] == format_encoding(
        message
    )
    example = make_plain_example(message)
    assert fits(example, schema_name(message))
    for field in example:
        rest = {name: value for name, value in example.items() if name != field}
        try:
            MessageDecoder(message).decode(encode(rest), format_encoding(message))
            taken = True
        except WireError:
            taken = False
        assert fits(rest, schema_name(message)) == taken, field


@each_message
def test_schema_and_decoder_agree_on_what_is_out_of_bounds(message: type[Message]) -> None:
    example = make_plain_example(message)
    for at, info in iter_places(example, inspect.type_info(message)):
        for poison in list_invalid_values(info):
            if isinstance(poison, bytes) or (
                isinstance(poison, float) and not math.isfinite(poison)
            ):
                continue  # JSON has no such value
            assert not fits(replace_at(example, at, poison), schema_name(message)), (
                f"{at} took {poison!r}"
            )


# --- the files that are shipped --------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "schema"), [("robots", "robot"), ("scenes", "scene")])
def test_every_shipped_file_fits_its_schema_and_names_itself(kind: str, schema: str) -> None:
    for name in list_shipped_names(kind):
        values = read_table_with_base(name, kind).values
        assert fits(values, f"files/{schema}.json"), name
        assert values["name"] == name


@pytest.mark.parametrize("name", list_shipped_names("scenarios"))
def test_every_shipped_scenario_loads_and_fits_run_schema(name: str) -> None:
    config = load_scenario(name).config
    assert config.name == name
    assert fits(config, "files/run.json")
