"""Offers the running controller's parameters as parameters of the ROS node: list, get, describe, set.

They are those of `snakesim param`, under the same names. The bridge keeps no copy: every request reads them from the
controller.
"""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import Session
from snakesim_operator.features.ros2 import service_types as types
from snakesim_operator.features.ros2.graph import RosNode
from snakesim_operator.features.ros2.messages import make_message
from snakesim_operator.features.ros2.operating import REQUESTER
from snakesim_operator.features.ros2.server import ServiceServer, run_action
from snakesim_operator.robot_commands.parameters import (
    PREFIX,
    RobotParameter,
    change_parameters,
    format_value,
    parse_parameters,
    read_parameters_in_force,
)

# Types of rcl_interfaces/ParameterType.
NOT_SET = 0
BOOL = 1
INTEGER = 2
DOUBLE = 3
STRING = 4
BOOLS = 6
INTEGERS = 7
DOUBLES = 8
STRINGS = 9

_SCALAR_FIELDS = {
    BOOL: "bool_value",
    INTEGER: "integer_value",
    DOUBLE: "double_value",
    STRING: "string_value",
}
_ARRAY_FIELDS = {
    BOOLS: "bool_array_value",
    INTEGERS: "integer_array_value",
    DOUBLES: "double_array_value",
}
_SCALAR_TYPES = {bool: BOOL, int: INTEGER, float: DOUBLE, str: STRING}

QUEUE_DEPTH = 1000  # of a node's parameter services, as rmw's profile has it
NOT_ALLOWED = "this bridge only watches: start it with --operate to let ROS set parameters"


def make_parameter_servers(
    session: Session, node: RosNode, node_name: str, *, operate: bool
) -> list[ServiceServer]:
    """Declare the six parameter services of a ROS node, and return their servers.

    Args:
        session: Session on the robot's network.
        node: The ROS node.
        node_name: Name of the node with its namespace.
        operate: Whether ROS may set parameters.
    """
    services = ParameterServices(session, operate=operate)
    handlers = (
        ("list_parameters", types.LIST_PARAMETERS, services.list_parameters),
        ("get_parameters", types.GET_PARAMETERS, services.get_parameters),
        ("get_parameter_types", types.GET_PARAMETER_TYPES, services.get_parameter_types),
        ("describe_parameters", types.DESCRIBE_PARAMETERS, services.describe_parameters),
        ("set_parameters", types.SET_PARAMETERS, services.set_parameters),
        (
            "set_parameters_atomically",
            types.SET_PARAMETERS_ATOMICALLY,
            services.set_parameters_atomically,
        ),
    )
    return [
        ServiceServer(node, f"{node_name}/{name}", service, handle_request, QUEUE_DEPTH)
        for name, service, handle_request in handlers
    ]


class ParameterServices:
    """Answers the requests of the six parameter services; each method returns a response in CDR."""

    def __init__(self, session: Session, *, operate: bool) -> None:
        self._session = session
        self._operate = operate

    def list_parameters(self, request: Any) -> bytes:
        """List the names below one of the requested prefixes; without a prefix, list all."""
        names: list[str] = []
        for name in self._read_parameters():
            if not request.prefixes or any(
                _has_prefix(name, prefix) for prefix in request.prefixes
            ):
                names.append(name)
        prefixes: list[str] = []
        if names:
            prefixes.append(PREFIX.rstrip("."))
        result = make_message("rcl_interfaces/msg/ListParametersResult", names, prefixes)
        return types.LIST_PARAMETERS.encode_response(result)

    def get_parameters(self, request: Any) -> bytes:
        """Return the requested values; the value of an unknown parameter is not set."""
        values = [_encode_value(value) for value in self._read_values(request.names)]
        return types.GET_PARAMETERS.encode_response(values)

    def get_parameter_types(self, request: Any) -> bytes:
        """Return the types of the requested values."""
        kinds = [_find_parameter_type(value) for value in self._read_values(request.names)]
        return types.GET_PARAMETER_TYPES.encode_response(np.array(kinds, dtype=np.uint8))

    def describe_parameters(self, request: Any) -> bytes:
        """Return meaning, unit and range of the requested parameters."""
        parameters = self._read_parameters()
        descriptors = [_make_descriptor(name, parameters.get(name)) for name in request.names]
        return types.DESCRIBE_PARAMETERS.encode_response(descriptors)

    def set_parameters(self, request: Any) -> bytes:
        """Set the parameters one after the other; each one succeeds or fails for itself."""
        results = [self._set_and_make_result([parameter]) for parameter in request.parameters]
        return types.SET_PARAMETERS.encode_response(results)

    def set_parameters_atomically(self, request: Any) -> bytes:
        """Set all of the parameters or none of them."""
        return types.SET_PARAMETERS_ATOMICALLY.encode_response(
            self._set_and_make_result(request.parameters)
        )

    def _read_parameters(self) -> dict[str, RobotParameter]:
        """Return the controller's parameters by name; none if no controller publishes any."""
        try:
            in_force = read_parameters_in_force(self._session)
        except NotConnectedError:
            return {}
        return {PREFIX + parameter.name: parameter for parameter in parse_parameters(in_force)}

    def _read_values(self, names: Sequence[str]) -> list[Any]:
        """Return the value of each name; None for an unknown one."""
        parameters = self._read_parameters()
        values: list[Any] = []
        for name in names:
            if name in parameters:
                values.append(parameters[name].value)
            else:
                values.append(None)
        return values

    def _set_and_make_result(self, parameters: Sequence[Any]) -> Any:
        """Set parameters in one request to the controller, and return an rcl_interfaces/SetParametersResult."""
        succeeded = False
        reason = NOT_ALLOWED
        if self._operate:
            succeeded, reason = run_action(lambda: self._change_parameters(parameters))
        return make_message("rcl_interfaces/msg/SetParametersResult", succeeded, reason)

    def _change_parameters(self, parameters: Sequence[Any]) -> str:
        values = {parameter.name: _decode_value(parameter.value) for parameter in parameters}
        change_parameters(self._session, values, REQUESTER)
        return ""


def _has_prefix(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(f"{prefix}.")


def _find_parameter_type(value: Any) -> int:
    """Return the rcl_interfaces/ParameterType of a value."""
    if value is None:
        return NOT_SET
    if isinstance(value, list):
        is_numeric = all(isinstance(element, int | float) for element in value)
        if is_numeric:
            return DOUBLES
        return STRINGS
    return _SCALAR_TYPES.get(type(value), STRING)


def _encode_value(value: Any) -> Any:
    """Encode the value of a controller parameter as an rcl_interfaces/ParameterValue.

    The message has one field for each type, and the number of the type whose field is valid. A value whose type ROS
    does not have becomes a text of JSON.
    """
    type_number = _find_parameter_type(value)
    value_by_type: dict[int, Any] = {
        BOOL: False,
        INTEGER: 0,
        DOUBLE: 0.0,
        STRING: "",
        DOUBLES: [],
        STRINGS: [],
    }
    if type_number == STRING:
        value_by_type[STRING] = format_value(value)
    elif type_number == STRINGS:
        value_by_type[STRINGS] = [format_value(element) for element in value]
    elif type_number != NOT_SET:
        value_by_type[type_number] = value
    no_bytes = np.array([], dtype=np.uint8)
    no_booleans = np.array([], dtype=np.bool_)
    no_integers = np.array([], dtype=np.int64)
    return make_message(
        "rcl_interfaces/msg/ParameterValue",
        type_number,
        value_by_type[BOOL],
        value_by_type[INTEGER],
        value_by_type[DOUBLE],
        value_by_type[STRING],
        no_bytes,
        no_booleans,
        no_integers,
        np.array(value_by_type[DOUBLES], dtype=np.float64),
        value_by_type[STRINGS],
    )


def _decode_value(value: Any) -> Any:
    """Return the value of an rcl_interfaces/ParameterValue; None for a type that no parameter has."""
    if value.type in _ARRAY_FIELDS:
        return getattr(value, _ARRAY_FIELDS[value.type]).tolist()
    if value.type == STRINGS:
        return list(value.string_array_value)
    if value.type in _SCALAR_FIELDS:
        return getattr(value, _SCALAR_FIELDS[value.type])
    return None


def _make_descriptor(name: str, parameter: RobotParameter | None) -> Any:
    """Make an rcl_interfaces/ParameterDescriptor of a parameter; it is empty for an unknown parameter.

    Args:
        name: Name that the client requested.
        parameter: The parameter of the controller; None if the controller has none of this name.
    """
    if parameter is None:
        return make_message(
            "rcl_interfaces/msg/ParameterDescriptor", name, NOT_SET, "", "", False, False, [], []
        )
    type_number = _find_parameter_type(parameter.value)
    description = parameter.description
    if parameter.unit not in ("", "1"):
        description = f"{parameter.description} [{parameter.unit}]"
    floating_point_ranges: list[Any] = []
    has_limits = parameter.minimum is not None or parameter.maximum is not None
    if type_number == DOUBLE and has_limits:
        floating_point_ranges.append(_make_range(parameter))
    return make_message(
        "rcl_interfaces/msg/ParameterDescriptor",
        name,
        type_number,
        description,
        parameter.range_text,  # additional_constraints
        False,  # read_only
        False,  # dynamic_typing
        floating_point_ranges,
        [],  # integer_range
    )


def _make_range(parameter: RobotParameter) -> Any:
    """Return an rcl_interfaces/FloatingPointRange. It needs both limits, so a missing one becomes the largest float."""
    lower = -sys.float_info.max
    if parameter.minimum is not None:
        lower = parameter.minimum
    upper = sys.float_info.max
    if parameter.maximum is not None:
        upper = parameter.maximum
    any_step = 0.0
    return make_message("rcl_interfaces/msg/FloatingPointRange", lower, upper, any_step)
