"""Documentation of the fields of a Struct comes from their docstrings and their types."""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from msgspec import Meta

from snakesim_hal.model.fields.field_docs import (
    FieldDoc,
    collect_field_descriptions,
    document_fields,
)
from snakesim_hal.model.fields.field_words import find_unit, format_value
from snakesim_hal.model.fields.json_schema import list_structs, make_schema
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.plugins import CONTROLLERS, load_plugin
from snakesim_hal.model.robot_file.joints import JointExceptions, MotionLimits
from snakesim_hal.wire.quantities import above, describe


class Wheel(FileStruct, frozen=True, kw_only=True):
    """A wheel."""

    radius_m: Annotated[float, above(2, "m")]
    """Radius of the wheel,
    without its tire.
    """

    spokes: Annotated[int, Meta(ge=0, lt=100)] = 36  # no description
    slip_m_s: Annotated[float | None, describe("speed at the ground")] = None


class Kart(FileStruct, frozen=True, kw_only=True, tag="kart", tag_field="kind"):
    """A kart."""

    wheels: list[Wheel] = []
    """Its wheels."""

    drive: Literal["front", "rear"] = "rear"
    gains: dict[str, float] = msgspec.field(default_factory=lambda: {"left": 1.0})
    size_m: tuple[float, float] | None = None
    """Length and width; none: unknown."""

    name: Annotated[str, Meta(min_length=1, max_length=8)]


class SpareWheel(Wheel, frozen=True, kw_only=True):
    """A wheel with another description of its spokes, which inherits the other ones."""

    spokes: int = 0
    """Number of spokes."""


def document_by_name(struct: type[msgspec.Struct]) -> dict[str, FieldDoc]:
    """Return the documentation of all fields by name."""
    return {doc.name: doc for doc in document_fields(struct)}


def test_field_description_is_its_literal_on_one_line() -> None:
    assert collect_field_descriptions(Wheel)["radius_m"] == "Radius of the wheel, without its tire."
    assert "spokes" not in collect_field_descriptions(Wheel)


def test_field_without_literal_uses_description_of_its_type() -> None:
    assert collect_field_descriptions(Wheel)["slip_m_s"] == "speed at the ground"


def test_field_description_is_inherited_and_overridden() -> None:
    assert collect_field_descriptions(SpareWheel)["spokes"] == "Number of spokes."
    assert (
        collect_field_descriptions(SpareWheel)["radius_m"]
        == collect_field_descriptions(Wheel)["radius_m"]
    )


def test_joint_exception_fields_use_descriptions_of_their_section() -> None:
    assert collect_field_descriptions(MotionLimits)["torque_nm"] == "Maximum torque of the joint."
    exceptions: Any = JointExceptions
    descriptions = collect_field_descriptions(exceptions)
    assert (
        descriptions["torque_nm"] == "Maximum torque of the joint. None: as in the section for all."
    )
    assert descriptions["rated_nm"].count("None:") == 1


def test_fields_of_class_without_source_have_no_descriptions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    struct: Any = msgspec.defstruct("Made", [("x", int)], module="gone")
    assert collect_field_descriptions(struct) == {}
    monkeypatch.setattr(sys.modules[__name__], "__file__", str(Path("gone.pyc").absolute()))

    class Local(FileStruct, frozen=True):
        x: int
        """Never read."""

    assert collect_field_descriptions(Local) == {}


def test_fields_of_plugin_file_have_descriptions(tmp_path: Path) -> None:
    code = '''
from snakesim_hal.model.files import FileStruct

class Wave:
    class Settings(FileStruct):
        """The wave."""

        lag_rad: float = 0.5
        """Phase from joint to joint."""
'''
    (tmp_path / "wave.py").write_text(code)
    settings = load_plugin(CONTROLLERS, f"{tmp_path}/wave.py:Wave").Settings
    (doc,) = document_fields(settings)
    assert doc.description == "Phase from joint to joint."
    assert doc.unit == "rad"
    assert doc.default == "0.5"


@pytest.mark.parametrize(
    ("struct", "field", "type_words", "unit", "range_words", "default"),
    [
        (Wheel, "radius_m", "number", "m", "> 0, <= 2", None),
        (Wheel, "spokes", "whole number", "", ">= 0, < 100", "36"),
        (Wheel, "slip_m_s", "number", "m/s", "", "none"),
        (Kart, "kind", "text", "", '"kart"', None),
        (Kart, "wheels", "list of tables", "", "", "[]"),
        (Kart, "drive", "text", "", '"front", "rear"', '"rear"'),
        (Kart, "gains", "numbers by name", "", "", "{left = 1.0}"),
        (Kart, "size_m", "2 numbers", "m", "", "none"),
        (Kart, "name", "text", "", "1 to 8 characters", None),
    ],
)
def test_field_type_unit_range_and_default_are_documented(
    struct: type[msgspec.Struct],
    field: str,
    type_words: str,
    unit: str,
    range_words: str,
    default: str | None,
) -> None:
    doc = document_by_name(struct)[field]
    assert doc.type_words == type_words
    assert doc.unit == unit
    assert doc.range_words == range_words
    assert doc.default == default


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("reach_m", "m"),
        ("speed_rad_s", "rad/s"),
        ("gain_nm_s_per_rad", "N·m·s/rad"),
        ("growth_per_s", ""),  # a unit that is not in the table, and not seconds
        ("count", ""),
    ],
)
def test_field_number_without_unit_has_that_of_its_name(name: str, unit: str) -> None:
    assert find_unit(name, msgspec.inspect.type_info(float)) == unit
    assert find_unit(name, msgspec.inspect.type_info(str)) == ""


def test_field_default_is_formatted_as_in_a_file() -> None:
    value = {"on": True, "to": [1, 2.5], "name": "α"}
    assert format_value(value) == '{on = true, to = [1, 2.5], name = "α"}'


def test_schema_of_struct_has_descriptions_defaults_and_units() -> None:
    schema = make_schema(Kart)
    properties = schema["$defs"]["Kart"]["properties"]
    assert properties["wheels"]["description"] == "Its wheels."
    assert properties["gains"]["default"] == {"left": 1.0}
    assert properties["size_m"]["unit"] == "m"
    assert schema["$defs"]["Wheel"]["properties"]["radius_m"]["unit"] == "m"
    assert list_structs(Kart) == [Kart, Wheel]


def test_schema_of_two_classes_with_one_name_describes_both() -> None:
    class Other:
        class Wheel(FileStruct, frozen=True):
            """A toothed wheel."""

            teeth: int = 0
            """Number of teeth."""

    both: Any = msgspec.defstruct("Both", [("front", Wheel), ("rear", Other.Wheel)])
    descriptions: list[str] = []
    for definition in make_schema(both)["$defs"].values():
        descriptions += [
            field["description"]
            for field in definition["properties"].values()
            if "description" in field
        ]
    assert "Radius of the wheel, without its tire." in descriptions
    assert "Number of teeth." in descriptions
