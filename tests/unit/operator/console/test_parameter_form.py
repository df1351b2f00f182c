"""The form for the parameters of a controller, made from the schema that the control service publishes."""

import pytest

from snakesim_hal.wire.messages import ControlParameters
from snakesim_operator.features.console.page.parameter_form import InputField, list_input_fields

SCHEMA = """{"$ref": "#/$defs/S", "$defs": {"S": {"properties": {
    "push_n": {"type": "number", "unit": "N", "description": "a bound", "exclusiveMinimum": 0, "maximum": 10000},
    "share": {"type": "number", "minimum": 0, "maximum": 1},
    "bend_rad": {"type": "number"},
    "mode": {"enum": ["a", "b"]},
    "on": {"type": "boolean"},
    "names": {"type": "array"}}}}}"""
VALUES = '{"push_n": 10.0, "share": 0.5, "bend_rad": -0.2, "mode": "b", "on": true, "names": ["x"]}'


def make_parameters(values: str, schema: str) -> ControlParameters:
    """Make the message with the present parameters of a controller and their schema."""
    return ControlParameters(
        tick=0, timestamp_ns=0, controller="any", parameters=values, schema=schema
    )


def test_parameter_form_has_input_within_bounds_of_each_parameter():
    push, share, bend, mode, is_on = list_input_fields(make_parameters(VALUES, SCHEMA))
    assert push == InputField(
        "push_n", 10.0, "N", low=0.1, high=40.0, step=0.1, hint="a bound; > 0, <= 10000 N"
    )
    assert share.low == 0.0
    assert share.high == 1.0
    assert bend.low == -0.8
    assert bend.high == 0.8
    assert mode.choices == ("a", "b")
    assert is_on.value is True


@pytest.mark.parametrize(
    "schema", ["", "[]", "{}", "null", '{"properties": 1}', '{"$ref": "#/$defs/x"}', "{" * 9000]
)
def test_parameter_form_of_unreadable_schema_is_empty(schema: str):
    assert list_input_fields(make_parameters(VALUES, schema)) == []
