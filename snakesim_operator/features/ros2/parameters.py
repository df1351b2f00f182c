"""The running controller's parameters as parameters of the ROS node: list, get, describe, set.

They are those of `snakesim param`, under the same names. Nothing is kept here: every request asks the controller.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import Session
from snakesim_operator.features.ros2 import service_types as types
from snakesim_operator.features.ros2.graph import Node
from snakesim_operator.features.ros2.messages import made
from snakesim_operator.features.ros2.operating import WHO
from snakesim_operator.features.ros2.server import Server, told
from snakesim_operator.robot_commands.parameters import PREFIX, Parameter, change, in_force, in_text, parameters_of

NOT_SET, BOOL, INTEGER, DOUBLE, STRING = range(5)  # types of rcl_interfaces/ParameterType
DOUBLES, STRINGS = 8, 9
DEPTH = 1000  # of the queue of a node's parameter services
_FIELDS = {BOOL: "bool_value", INTEGER: "integer_value", DOUBLE: "double_value", STRING: "string_value"}
_ARRAYS = {6: "bool_array_value", 7: "integer_array_value", DOUBLES: "double_array_value"}
NOT_ALLOWED = "this bridge only watches: start it with --operate to let ROS set parameters"


def parameter_servers(session: Session, node: Node, name: str, *, operate: bool) -> list[Server]:
    """The six services of a node. name: of the node, with its namespace."""
    asked = ParameterServices(session, operate=operate)
    return [
        Server(node, f"{name}/{word}", service, answer, DEPTH)
        for word, service, answer in (
            ("list_parameters", types.LIST_PARAMETERS, asked.listed),
            ("get_parameters", types.GET_PARAMETERS, asked.got),
            ("get_parameter_types", types.GET_PARAMETER_TYPES, asked.kinds),
            ("describe_parameters", types.DESCRIBE_PARAMETERS, asked.described),
            ("set_parameters", types.SET_PARAMETERS, asked.set),
            ("set_parameters_atomically", types.SET_PARAMETERS_ATOMICALLY, asked.set_at_once),
        )
    ]


class ParameterServices:
    """Answers of the six services."""

    def __init__(self, session: Session, *, operate: bool) -> None:
        self._session, self._operate = session, operate

    def listed(self, request: Any) -> bytes:
        """Names that begin with one of the prefixes; all without any."""
        wanted: Sequence[str] = request.prefixes
        names = [name for name in self._now() if not wanted or any(_below(name, prefix) for prefix in wanted)]
        result = made("rcl_interfaces/msg/ListParametersResult", names, [PREFIX.rstrip(".")] if names else [])
        return types.LIST_PARAMETERS.response(result)

    def got(self, request: Any) -> bytes:
        """Values; not set where there is no such parameter."""
        return types.GET_PARAMETERS.response(self._of_each(request.names, _value))

    def kinds(self, request: Any) -> bytes:
        """Types of the values."""
        found = self._of_each(request.names, _kind)
        return types.GET_PARAMETER_TYPES.response(np.array(found, dtype=np.uint8))

    def described(self, request: Any) -> bytes:
        """Meaning, unit, range."""
        now = self._now()
        found = [_descriptor(name, now.get(name)) for name in request.names]
        return types.DESCRIBE_PARAMETERS.response(found)

    def set(self, request: Any) -> bytes:
        """One after the other, each for itself."""
        return types.SET_PARAMETERS.response([self._changed([one]) for one in request.parameters])

    def set_at_once(self, request: Any) -> bytes:
        """All or none."""
        return types.SET_PARAMETERS_ATOMICALLY.response(self._changed(request.parameters))

    def _now(self) -> dict[str, Parameter]:
        """By name; none where no controller publishes any."""
        try:
            return {PREFIX + one.name: one for one in parameters_of(in_force(self._session))}
        except NotConnectedError:
            return {}

    def _of_each(self, names: Sequence[str], what: Callable[[Any], Any]) -> list[Any]:
        now = self._now()
        return [what(now[name].value if name in now else None) for name in names]

    def _changed(self, wanted: Sequence[Any]) -> Any:
        done, why = told(lambda: self._change(wanted)) if self._operate else (False, NOT_ALLOWED)
        return made("rcl_interfaces/msg/SetParametersResult", done, why)

    def _change(self, wanted: Sequence[Any]) -> str:
        change(self._session, {one.name: _python(one.value) for one in wanted}, WHO)
        return ""


def _below(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(f"{prefix}.")


def _kind(value: Any) -> int:
    if isinstance(value, list):
        return DOUBLES if all(isinstance(one, int | float) for one in value) else STRINGS
    kinds = {bool: BOOL, int: INTEGER, float: DOUBLE, str: STRING}
    return NOT_SET if value is None else kinds.get(type(value), STRING)


def _value(value: Any) -> Any:
    """As rcl_interfaces/ParameterValue; what ROS has no type for is a text of JSON."""
    kind = _kind(value)
    return made(
        "rcl_interfaces/msg/ParameterValue",
        kind,
        value if kind == BOOL else False,
        value if kind == INTEGER else 0,
        value if kind == DOUBLE else 0.0,
        in_text(value) if kind == STRING else "",
        *(np.array([], dtype=element) for element in (np.uint8, np.bool_, np.int64)),
        np.array(value if kind == DOUBLES else [], dtype=np.float64),
        [in_text(one) for one in value] if kind == STRINGS else [],
    )


def _python(value: Any) -> Any:
    """The value of a ParameterValue; None for a type that no parameter has."""
    if value.type in _ARRAYS:
        return getattr(value, _ARRAYS[value.type]).tolist()
    if value.type == STRINGS:
        return list(value.string_array_value)
    return getattr(value, _FIELDS[value.type]) if value.type in _FIELDS else None


def _descriptor(name: str, of: Parameter | None) -> Any:
    if of is None:
        return made("rcl_interfaces/msg/ParameterDescriptor", name, NOT_SET, "", "", False, False, [], [])
    kind = _kind(of.value)
    low, high = (
        -sys.float_info.max if of.least is None else of.least,
        sys.float_info.max if of.most is None else of.most,
    )
    ranged = kind == DOUBLE and (of.least, of.most) != (None, None)
    ranges = [made("rcl_interfaces/msg/FloatingPointRange", low, high, 0.0)] if ranged else []
    meaning = f"{of.about} [{of.unit}]" if of.unit not in ("", "1") else of.about
    return made("rcl_interfaces/msg/ParameterDescriptor", name, kind, meaning, of.range, False, False, ranges, [])
