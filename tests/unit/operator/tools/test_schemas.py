"""The published contract in `schemas/` is what the code says, to the letter, and what the code sends fits it."""

import json
import math
import re
from base64 import b64encode
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from snakesim_hal.errors import WireError
from snakesim_hal.model.files import read_part, shipped
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig, load
from snakesim_hal.model.scene import SceneFile
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, encoding_of
from snakesim_hal.wire.messages import VERSIONS, Message
from snakesim_operator.tools.schemas import contract, write_schemas
from snakesim_operator.tools.schemas import schema_of as published_schema
from tests.unit.hal.strategies import messages_of, places, plain_example, poisons, replaced

REPOSITORY = Path(__file__).parents[4]
PUBLISHED = REPOSITORY / "schemas"
each_message = pytest.mark.parametrize("message", list(VERSIONS), ids=lambda message: message.__name__)


def files_under(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text(encoding="utf-8") for p in folder.rglob("*") if p.is_file()}


def test_the_published_files_are_what_the_code_says() -> None:
    published, generated = files_under(PUBLISHED), dict(contract())
    published = {
        name: text for name, text in published.items() if not name.startswith("can/")
    }  # tests/unit/can_backend
    for by_hand in ("README.md", "protocol.md"):
        del published[by_hand]
    assert sorted(published) == sorted(generated), "run `make schemas` and commit what it changes"
    for name, text in generated.items():
        assert published[name] == text, f"schemas/{name} is out of date; run `make schemas` and commit what it changes"


def test_writing_removes_what_is_not_part_of_the_contract_any_more(tmp_path: Path) -> None:
    write_schemas(tmp_path)
    (tmp_path / "messages" / "Gone.json").write_text("{}")
    (tmp_path / "README.md").write_text("by hand")
    written = write_schemas(tmp_path)
    found = files_under(tmp_path)
    assert found.pop("README.md") == "by hand"
    assert found == dict(contract())
    assert {str(path.relative_to(tmp_path)) for path in written} == set(found)


def test_writing_into_a_folder_of_somebody_else_removes_nothing_of_it(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "thesis.json").write_text("{}")
    write_schemas(tmp_path)
    assert (tmp_path / "files" / "thesis.json").is_file()


def test_the_key_table_lists_every_key_with_its_message_and_version() -> None:
    table = dict(contract())["keys.md"]
    for row in keys.SPACE:
        line = next(line for line in table.splitlines() if line.startswith(f"| `{row.key}` |"))
        if row.message is not None:
            name = row.message.__name__
            assert f"messages/{name}.json" in line and f"`snakesim.{name}/{VERSIONS[row.message]}`" in line


# --- schema against messages -----------------------------------------------------------------------------------


def mismatches(  # noqa: C901 - one branch a keyword
    value: Any, schema: dict[str, Any], root: dict[str, Any], at: str = "$"
) -> list[str]:
    """Where a JSON value does not fit a JSON Schema; knows the keywords that msgspec writes, and no others."""
    known = {"$ref", "$schema", "$defs", "encoding", "title", "description", "default", "unit", "contentEncoding"} | {
        *("type", "enum", "const", "anyOf", "properties", "required", "additionalProperties", "items", "prefixItems"),
        *("minItems", "maxItems", "minLength", "maxLength", "pattern", "minProperties", "maxProperties"),
        *("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "propertyNames", "discriminator"),
    }
    assert set(schema) <= known, f"{at}: the check does not know {set(schema) - known}"
    wrong: list[str] = []
    if isinstance(value, bytes) and schema.get("contentEncoding") == "base64":
        value = b64encode(value).decode()
    if "$ref" in schema:
        target: Any = root
        for step in schema["$ref"].removeprefix("#/").split("/"):
            target = target[step]
        wrong += mismatches(value, target, root, at)
    if "anyOf" in schema and all(mismatches(value, option, root, at) for option in schema["anyOf"]):
        wrong.append(f"{at}: none of the alternatives")
    if "enum" in schema and value not in schema["enum"]:
        wrong.append(f"{at}: {value!r} is none of {schema['enum']}")
    if "const" in schema and value != schema["const"]:
        wrong.append(f"{at}: {value!r} is not {schema['const']!r}")
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}
    match schema.get("type"):
        case None:
            return wrong
        case "integer":
            fits = isinstance(value, int) and not isinstance(value, bool)
        case "number":
            fits = isinstance(value, int | float) and not isinstance(value, bool)
        case kind:
            fits = isinstance(value, kinds[kind])
    if not fits:
        return [*wrong, f"{at}: {value!r} is no {schema['type']}"]
    wrong += out_of_bounds(value, schema, at)
    if isinstance(value, dict):
        wrong += [f"{at}.{name}: missing" for name in schema.get("required", []) if name not in value]
        fields, others = schema.get("properties", {}), schema.get("additionalProperties", True)
        for name, inner in value.items():
            if name in fields:
                wrong += mismatches(inner, fields[name], root, f"{at}.{name}")
            elif isinstance(others, dict):
                wrong += mismatches(inner, others, root, f"{at}.{name}")
            elif not others:
                wrong.append(f"{at}.{name}: unknown")
    if isinstance(value, list):
        places = schema.get("prefixItems", [])
        rest = schema.get("items", True)
        for i, inner in enumerate(value):
            if i < len(places):
                wrong += mismatches(inner, places[i], root, f"{at}[{i}]")
            elif isinstance(rest, dict):
                wrong += mismatches(inner, rest, root, f"{at}[{i}]")
            elif not rest:
                wrong.append(f"{at}[{i}]: too many")
    return wrong


def out_of_bounds(value: Any, schema: dict[str, Any], at: str) -> list[str]:
    size = len(value) if isinstance(value, str | list | dict) else 0
    broken = {
        "minimum": lambda bound: value < bound,
        "maximum": lambda bound: value > bound,
        "exclusiveMinimum": lambda bound: value <= bound,
        "exclusiveMaximum": lambda bound: value >= bound,
        **{name: lambda bound: size < bound for name in ("minItems", "minLength", "minProperties")},
        **{name: lambda bound: size > bound for name in ("maxItems", "maxLength", "maxProperties")},
        "pattern": lambda bound: re.search(bound, str(value)) is None,
    }
    return [f"{at}: {name} {schema[name]}" for name in broken if name in schema and broken[name](schema[name])]


def schema_of(name: str) -> dict[str, Any]:
    return json.loads(SCHEMAS[name])


def message_schema(message: type[Message]) -> dict[str, Any]:
    return {"encoding": encoding_of(message), **published_schema(message)}


SCHEMAS = {f"messages/{message.__name__}.json": json.dumps(message_schema(message)) for message in VERSIONS}
SCHEMAS |= {
    f"files/{name}.json": json.dumps(published_schema(struct))
    for name, struct in (("robot", RobotFile), ("scene", SceneFile), ("run", RunConfig))
}


def test_the_schemas_checked_here_are_the_published_ones() -> None:
    generated = dict(contract())
    for name, text in SCHEMAS.items():
        schema = json.loads(generated[name])
        assert schema.pop("$schema").startswith("https://json-schema.org/")
        assert schema == json.loads(text), name


@each_message
@given(data=st.data())
@settings(max_examples=8)
def test_every_message_fits_its_schema(message: type[Message], data: st.DataObject) -> None:
    plain = json.loads(msgspec.json.encode(data.draw(messages_of(message))))
    schema = schema_of(f"messages/{message.__name__}.json")
    assert mismatches(plain, schema, schema) == []


@each_message
def test_schema_and_decoder_agree_on_what_is_missing(message: type[Message]) -> None:
    schema = schema_of(f"messages/{message.__name__}.json")
    assert schema["encoding"] == encoding_of(message)
    example = plain_example(message)
    assert mismatches(example, schema, schema) == []
    for field in example:
        rest = {name: value for name, value in example.items() if name != field}
        try:
            Decoder(message).decode(encode(rest), encoding_of(message))
            taken = True
        except WireError:
            taken = False
        assert (mismatches(rest, schema, schema) == []) == taken, field


@each_message
def test_schema_and_decoder_agree_on_what_is_out_of_bounds(message: type[Message]) -> None:
    schema = schema_of(f"messages/{message.__name__}.json")
    example = plain_example(message)
    for at, info in places(example, inspect.type_info(message)):
        for poison in poisons(info):
            if isinstance(poison, bytes) or (isinstance(poison, float) and not math.isfinite(poison)):
                continue  # JSON has no such value
            assert mismatches(replaced(example, at, poison), schema, schema) != [], f"{at} took {poison!r}"


# --- the files that are shipped --------------------------------------------------------------------------------


def test_something_is_shipped() -> None:
    assert "planar13" in shipped("robots") and "triplet" in shipped("scenes") and "triplet" in shipped("scenarios")


@pytest.mark.parametrize(("kind", "schema"), [("robots", "robot"), ("scenes", "scene")])
def test_every_shipped_file_fits_its_schema_and_names_itself(kind: str, schema: str) -> None:
    for name in shipped(kind):
        values = read_part(name, kind).values
        published = schema_of(f"files/{schema}.json")
        assert mismatches(values, published, published) == [], name
        assert values["name"] == name


@pytest.mark.parametrize("name", shipped("scenarios"))
def test_every_shipped_scenario_loads_and_fits_the_schema_of_a_run(name: str) -> None:
    config = load(name).config
    assert config.name == name
    published = schema_of("files/run.json")
    assert mismatches(json.loads(msgspec.json.encode(config)), published, published) == []


@pytest.mark.parametrize("robot", shipped("robots"))
@pytest.mark.parametrize("scene", shipped("scenes"))
def test_every_shipped_robot_and_scene_decodes(robot: str, scene: str) -> None:
    msgspec.convert(read_part(robot, "robots").values, RobotFile)
    msgspec.convert(read_part(scene, "scenes").values, SceneFile)
