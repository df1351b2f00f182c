"""The parameters of a running controller, one by one: `snakesim param`, and the same for programs and the console.

Control publishes what is in force with a JSON Schema: range, unit and description of each. That comes from the network:
it decides what is shown, and nothing else; control checks every value again.
"""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import msgspec

from snakesim_hal.base.errors import (
    ConfigError,
    ControllerError,
    NotConnectedError,
    RefusedError,
    shorten,
    suggest_word,
)
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.scenario import parse_set_option
from snakesim_hal.network.session import Session, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlParameters, ControlState, ParametersRequest
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import CONNECT_TIMEOUT_S, find_single_robot
from snakesim_operator.robot_commands.command import ANSWER_TIMEOUT_S, STATUS_TIMEOUT_S

PREFIX = "control."
MAX_PARAMETERS = 100
MAX_NAME_CHARACTERS = 40
MAX_DESCRIPTION_CHARACTERS = 200
PUBLICATION_TIMEOUT_S = 3.0  # a controller publishes its parameters within this time
MAX_SILENCE_S = 1.0  # no parameters for so long after a change mean that the controller has ended
# Real time until the next report of a controller that continues; robot time may be paused.
REPORT_TIMEOUT_S = 0.3
POLL_PERIOD_S = 0.01


@dataclass(frozen=True)
class RobotParameter:
    """One parameter, with its unit and range from the JSON Schema."""

    name: str  # without "control."
    value: Any  # the value in force
    unit: str = ""  # empty: it has none
    description: str = ""  # the meaning
    choices: tuple[str, ...] = ()  # the values that are allowed (empty: any within the range)
    minimum: float | None = None  # None: there is none
    maximum: float | None = None  # None: there is none
    excludes_minimum: bool = False  # True: `minimum` itself is not allowed

    @property
    def range_text(self) -> str:
        """The values that are allowed, in words."""
        if self.choices:
            return " or ".join(self.choices)
        if isinstance(self.value, bool):
            return "true or false"
        if isinstance(self.value, str):
            return "a text"
        limits: list[str] = []
        if self.minimum is not None:
            sign = ">" if self.excludes_minimum else ">="
            limits.append(f"{sign} {self.minimum:g}")
        if self.maximum is not None:
            limits.append(f"<= {self.maximum:g}")
        return ", ".join(limits)

    @property
    def value_with_unit(self) -> str:
        """The value as TOML has it, with its unit."""
        if self.unit == "1":
            return format_value(self.value)
        return f"{format_value(self.value)} {self.unit}".strip()


def format_value(value: Any) -> str:
    """Format a value as `param set` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def parse_parameters(in_force: ControlParameters) -> list[RobotParameter]:
    """Parse the published parameters of a controller.

    Args:
        in_force: The message with values and JSON Schema of the parameters in force.

    Returns:
        At most MAX_PARAMETERS parameters; empty if values or schema cannot be read.
    """
    try:
        schema = json.loads(in_force.schema)
        values = msgspec.json.decode(in_force.parameters, type=dict[str, Any])
        properties = _resolve_reference(schema, schema)["properties"]
        parameters: list[RobotParameter] = []
        for name, value in values.items():
            description = _resolve_reference(schema, properties.get(name, {}))
            if len(parameters) < MAX_PARAMETERS:
                parameters.append(_parse_parameter(name, description, value))
        return parameters
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, msgspec.DecodeError):
        return []


def _resolve_reference(schema: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """Return the definition that a part of the schema refers to, or the part itself."""
    reference = part.get("$ref")
    if reference is None:
        return part
    return schema["$defs"][reference.rpartition("/")[2]]


def _parse_parameter(name: str, schema: dict[str, Any], value: Any) -> RobotParameter:
    """Return one parameter with its unit and range.

    Name, unit and description are shortened, because they come from the network. Choices are complete, because a
    shortened choice would not be accepted.

    Args:
        name: Name of the parameter.
        schema: JSON Schema of the parameter.
        value: Value in force.
    """
    choices = schema.get("enum")
    return RobotParameter(
        name=name[:MAX_NAME_CHARACTERS],
        value=value,
        unit=str(schema.get("unit", ""))[:MAX_NAME_CHARACTERS],
        description=str(schema.get("description", ""))[:MAX_DESCRIPTION_CHARACTERS],
        choices=tuple(str(choice) for choice in choices) if isinstance(choices, list) else (),
        minimum=_find_finite_number(schema, "minimum", "exclusiveMinimum"),
        maximum=_find_finite_number(schema, "maximum", "exclusiveMaximum"),
        excludes_minimum="exclusiveMinimum" in schema,
    )


def _find_finite_number(schema: dict[str, Any], *names: str) -> float | None:
    """Return the first of the named entries of a schema that is a finite number; None if none is."""
    for name in names:
        entry = schema.get(name)
        if isinstance(entry, int | float) and math.isfinite(float(entry)):
            return float(entry)
    return None


def find_changed_parameters(
    before: ControlParameters, after: ControlParameters
) -> list[tuple[RobotParameter, RobotParameter]]:
    """Return the parameters whose values differ, each as it was before and as it is now."""
    old_parameters = {parameter.name: parameter for parameter in parse_parameters(before)}
    pairs: list[tuple[RobotParameter, RobotParameter]] = []
    for new in parse_parameters(after):
        old = old_parameters.get(new.name)
        if old is not None and old.value != new.value:
            pairs.append((old, new))
    return pairs


def read_parameters_in_force(session: Session) -> ControlParameters:
    """Return the parameters of the running controller. Raises NotConnectedError when no controller publishes any."""
    in_force = session.wait_for_latched(
        keys.PARAMETERS_IN_FORCE, ControlParameters, PUBLICATION_TIMEOUT_S
    )
    if in_force is None:
        raise NotConnectedError(
            f"no controller publishes its parameters within {PUBLICATION_TIMEOUT_S:g} s: control does not run here, "
            "or is a client of another kind"
        )
    return in_force


def change_parameters(
    session: Session, changes: Mapping[str, Any], requester: str
) -> tuple[ControlParameters, ControlParameters]:
    """Change parameters of the running controller, all of them or none.

    Args:
        session: Session on the robot's network.
        changes: New values by name, such as `control.speed_kp_s`.
        requester: Name of the user who requests the change.

    Returns:
        The parameters in force before and after the change.

    Raises:
        ConfigError: There is no parameter with one of the names.
        RefusedError: Control refuses a value, or does not publish the new values in time.
        ControllerError: The controller cannot continue with the new values, so control has ended.
        NotConnectedError: No controller publishes its parameters.
    """
    before = read_parameters_in_force(session)
    values = msgspec.json.decode(before.parameters, type=dict[str, Any])
    for name, value in changes.items():
        values[find_field_name(name, before)] = value
    parameters = msgspec.json.encode(values).decode()
    request = ParametersRequest(
        requester=requester, controller=before.controller, parameters=parameters
    )
    state_reader = session.declare_reader(keys.CONTROL_STATE, ControlState)
    try:
        response = session.send_request(keys.PARAMETERS, request, ANSWER_TIMEOUT_S)
        if not response.ok:
            raise RefusedError(response.reason)
        after = _wait_for_change(session, before)
        _wait_until_controller_continues(state_reader, after, changes)
    finally:
        session.close_reader(state_reader)
    if after is None:
        raise RefusedError(
            f"NOT CONFIRMED: {response.reason}; but no controller publishes them",
            code="robot/not-confirmed",
        )
    return before, after


def _wait_for_change(session: Session, before: ControlParameters) -> ControlParameters | None:
    """Wait for the parameters in force after a change.

    Args:
        session: Session on the robot's network.
        before: The parameters in force before the change.

    Returns:
        The changed parameters; None if they are not published within STATUS_TIMEOUT_S.
    """
    deadline_s = time.monotonic() + STATUS_TIMEOUT_S
    while time.monotonic() < deadline_s:
        in_force = session.wait_for_latched(
            keys.PARAMETERS_IN_FORCE, ControlParameters, MAX_SILENCE_S
        )
        if in_force is None or in_force.changes > before.changes:
            return in_force
    return None


def _wait_until_controller_continues(
    state_reader: SampleReader[ControlState],
    after: ControlParameters | None,
    changes: Mapping[str, Any],
) -> None:
    """Wait until the controller has run with changed parameters, but at most REPORT_TIMEOUT_S.

    While the robot is armed, control reports its state 20 times a second. While it is not armed, control reports
    nothing, and whether the controller can continue is not known before the robot is armed.

    Args:
        state_reader: Reads the reports of control since the changes were requested.
        after: The parameters in force after the change. None if control publishes none any more.
        changes: The changed values by name.

    Raises:
        ControllerError: The controller cannot continue with these values, so control has ended.
    """
    deadline_s = time.monotonic() + REPORT_TIMEOUT_S
    while time.monotonic() < deadline_s:
        reports = state_reader.drain()
        for report in reports:
            if report.failed:
                values_text = ", ".join(
                    f"{name}={format_value(value)}" for name, value in changes.items()
                )
                raise ControllerError(
                    f"{values_text}: set, and then control has ended: {report.reason}. The robot stops. Start control "
                    "again with another value"
                )
        if after is not None and any(report.tick > after.tick for report in reports):
            return
        time.sleep(POLL_PERIOD_S)


def find_field_name(name: str, in_force: ControlParameters) -> str:
    """Return the name of a parameter without the prefix `control.`.

    Args:
        name: Name of the parameter with the prefix.
        in_force: The parameters in force.

    Raises:
        ConfigError: The controller has no parameter with this name.
    """
    known_names = [PREFIX + parameter.name for parameter in parse_parameters(in_force)]
    if name not in known_names:
        raise ConfigError(
            f"controller {in_force.controller} has no parameter {shorten(name)!r}; "
            f"{suggest_word(name, known_names)}it has {', '.join(known_names) or 'none'}",
            code="controller/unknown-parameter",
        )
    return name.removeprefix(PREFIX)


def print_parameters(selection: RobotSelection, *, as_json: bool) -> int:
    """Print all parameters of the running controller, for `snakesim param list`.

    Args:
        selection: Selects the robot.
        as_json: Whether to print one JSON object instead of a table.

    Returns:
        0, the exit code of the command.

    Raises:
        NotConnectedError: No controller publishes its parameters.
    """
    with open_session(find_single_robot(selection, "param list"), CONNECT_TIMEOUT_S) as session:
        in_force = read_parameters_in_force(session)
    parameters = parse_parameters(in_force)
    if as_json:
        content = [
            {**asdict(parameter), "name": PREFIX + parameter.name} for parameter in parameters
        ]
        print_json(
            {"controller": in_force.controller, "set_by": in_force.requester, "parameters": content}
        )
        return 0
    if in_force.requester is None:
        origin = "from its configuration"
    else:
        origin = f"set by {in_force.requester} at {in_force.timestamp_ns * 1e-9:g} s"
    print_line(f"controller {in_force.controller}, {len(parameters)} parameters, {origin}")
    # Three aligned columns, then the description.
    rows = [
        (PREFIX + parameter.name, parameter.value_with_unit, parameter.range_text)
        for parameter in parameters
    ]
    column_widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    for row, parameter in zip(rows, parameters, strict=True):
        cells = [cell.ljust(width) for cell, width in zip(row, column_widths, strict=True)]
        line = "  ".join([*cells, parameter.description])
        print_line("  " + line.rstrip())
    return 0


def print_parameter(name: str, selection: RobotSelection, *, as_json: bool) -> int:
    """Print the value of one parameter, for `snakesim param get`.

    Args:
        name: Name of the parameter, such as `control.speed_kp_s`.
        selection: Selects the robot.
        as_json: Whether to print one JSON object instead of the value alone.

    Returns:
        0, the exit code of the command.

    Raises:
        ConfigError: There is no such parameter.
        NotConnectedError: No controller publishes its parameters.
    """
    with open_session(find_single_robot(selection, "param get"), CONNECT_TIMEOUT_S) as session:
        in_force = read_parameters_in_force(session)
    field = find_field_name(name, in_force)
    value = next(
        parameter.value for parameter in parse_parameters(in_force) if parameter.name == field
    )
    if as_json:
        print_json({name: value})
    else:
        print_line(format_value(value))
    return 0


def set_parameters(assignments: list[str], selection: RobotSelection) -> int:
    """Change parameters for `snakesim param set`, and print what has changed.

    Args:
        assignments: Assignments of new values, such as `control.speed_kp_s=0.3`.
        selection: Selects the robot.

    Returns:
        0, the exit code of the command.

    Raises:
        ConfigError: An assignment cannot be parsed, or there is no parameter with its name.
        RefusedError: Control refuses a value.
        ControllerError: The controller has ended because of the change.
        NotConnectedError: No controller publishes its parameters.
    """
    overrides = [parse_set_option(text) for text in assignments]
    changes = {override.key: override.value for override in overrides}
    with open_session(find_single_robot(selection, "param set"), CONNECT_TIMEOUT_S) as session:
        before, after = change_parameters(session, changes, get_user_name())
    changed_parameters = find_changed_parameters(before, after)
    for old, new in changed_parameters:
        change = f"{format_value(old.value)} -> {new.value_with_unit}"
        print_line(f"{PREFIX}{new.name}: {change}, by {after.requester}, tick {after.tick}")
    if not changed_parameters:
        print_line(f"controller {after.controller} has these values already")
    return 0
