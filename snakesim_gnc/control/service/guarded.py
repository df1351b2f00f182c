"""Wraps a controller, which may be third-party code, and checks everything that it returns. Errors name the controller.

The wire accepts only lists of modes, targets and torque limits with one entry per joint, which are of `JointMode` and
of plain, finite Python numbers.
"""

import contextlib
import traceback
from collections.abc import Iterator, Sequence
from typing import Any

from snakesim_hal.base.errors import ControllerError, describe_exception
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry
from snakesim_hal.wire.messages import JointDescription, JointMode, RobotDescription
from snakesim_hal.wire.quantities import MAX_TARGET
from snakesim_hal.wire.setpoints import RequestedSetpoints

PLAIN_NUMBER_TYPES = {float, int}  # exactly these types: a NumPy number or a bool cannot be sent
MODE_NAMES = ", ".join(f"Mode.{mode.name}" for mode in JointMode)
MAX_VALUE_LENGTH = 60  # characters of a value in an error message


class GuardedController:
    """A checked controller, constructed for one arm session. Every call may raise ControllerError."""

    def __init__(
        self,
        name: str,
        controller_class: type[Controller[Any]],
        robot: RobotDescription,
        parameters: Any,
    ) -> None:
        """Construct a controller, and convert exceptions of its constructor into a ControllerError.

        Args:
            name: The controller as configured: an entry point, or `./file.py:Class`.
            controller_class: Its class.
            robot: Description of the robot.
            parameters: The controller's parameters.
        """
        self._label = f"controller {name} (class {controller_class.__name__})"
        self._controller_module = controller_class.__module__
        self._joint_descriptions = robot.joints
        with self._raise_with_controller_name("__init__"):
            self._controller = controller_class(robot, parameters)

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the command of the controller after it was validated. Raises ControllerError."""
        with self._raise_with_controller_name("update"):
            command = self._controller.update(observation)
        try:
            validate_command(command, self._joint_descriptions)
        except ValueError as error:
            raise self.make_error(str(error)) from None
        return command

    def make_error(self, problem: str) -> ControllerError:
        """Return an error that names the controller. `problem` names the field, its value, and what is allowed."""
        return ControllerError(f"{self._label}: {problem}")

    @contextlib.contextmanager
    def _raise_with_controller_name(self, method: str) -> Iterator[None]:
        """Convert all exceptions of a method into ControllerErrors that name the controller.

        The traceback of an unexpected exception is printed to the log.
        """
        try:
            yield
        except ControllerError as error:
            # Its text already names which returned value is not allowed, so that no traceback is needed.
            raise self.make_error(str(error)) from error.__cause__
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            raise self.make_error(
                f"{method}() {describe_exception(error, self._controller_module)}"
            ) from error


def validate_command(
    command: ControllerCommand, joint_descriptions: Sequence[JointDescription]
) -> None:
    """Check that a command of a controller, which may be a plug-in, has valid types, modes and numbers.

    Args:
        command: What the controller returned; it may be of any type.
        joint_descriptions: Descriptions of the joints, tail to head.

    Raises:
        ValueError: The command cannot be sent; the error names the field, its value and what is allowed.
    """
    if not isinstance(command, ControllerCommand):
        raise ValueError(
            f"update() returned {_format_value(command)}, must return a ControllerCommand"
        )
    setpoints = command.setpoints
    telemetry = command.telemetry
    if not isinstance(setpoints, RequestedSetpoints):
        raise ValueError(
            f"ControllerCommand.setpoints is {_format_value(setpoints)}, must be RequestedSetpoints"
        )
    if not isinstance(telemetry, Telemetry):
        raise ValueError(
            f"ControllerCommand.telemetry is {_format_value(telemetry)}, must be Telemetry"
        )
    joint_names = [joint.name for joint in joint_descriptions]
    _check_modes(setpoints.mode, joint_descriptions, joint_names)
    _check_numbers("target", setpoints.target, joint_names, minimum=-MAX_TARGET)
    _check_numbers("torque_limit_nm", setpoints.torque_limit_nm, joint_names, minimum=0.0)
    _check_telemetry(telemetry, joint_names)


def _check_modes(
    modes: Any, joint_descriptions: Sequence[JointDescription], joint_names: Sequence[str]
) -> None:
    """Check that the modes of a command are a list of one Mode per joint that the joint supports. Raises ValueError."""
    _check_length("mode", modes, joint_names)
    for i, mode in enumerate(modes):
        if type(mode) is not JointMode:
            raise ValueError(
                f"RequestedSetpoints.mode[{i}] ({joint_names[i]}) is {_format_value(mode)}, must be one of {MODE_NAMES}"
            )
        if not joint_descriptions[i].supports_mode(mode):
            available = ", ".join(f"Mode.{known.name}" for known in joint_descriptions[i].modes)
            found = f"RequestedSetpoints.mode[{i}] is Mode.{mode.name}"
            raise ValueError(f"{found}, which {joint_names[i]} does not have; it has {available}")


def _check_length(field: str, values: Any, joint_names: Sequence[str]) -> None:
    """Check that a field of a command is a list with one value per joint. Raises ValueError."""
    if type(values) is not list:
        hint = "; use .tolist()" if hasattr(values, "tolist") else ""
        raise ValueError(
            f"RequestedSetpoints.{field} is {_format_value(values)}, must be a list{hint}"
        )
    if len(values) != len(joint_names):
        expected_count = f"{len(joint_names)}: one a joint, {joint_names[0]} to {joint_names[-1]}"
        raise ValueError(
            f"RequestedSetpoints.{field} has {len(values)} values, must have {expected_count}"
        )


def _check_numbers(field: str, values: Any, joint_names: Sequence[str], *, minimum: float) -> None:
    """Check that a field has one plain number per joint, from `minimum` to MAX_TARGET. Raises ValueError."""
    _check_length(field, values, joint_names)
    for i, value in enumerate(values):
        # The comparison is false for NaN.
        if type(value) in PLAIN_NUMBER_TYPES and minimum <= value <= MAX_TARGET:
            continue
        found = f"RequestedSetpoints.{field}[{i}] ({joint_names[i]}) is {_format_value(value)}"
        if type(value) not in PLAIN_NUMBER_TYPES:
            raise ValueError(
                f"{found}, must be a plain float: use float(), or .tolist() of an array"
            )
        unit = "N·m" if field == "torque_limit_nm" else "rad, rad/s or N·m"
        raise ValueError(
            f"{found}, must be a finite number of {unit} from {minimum:g} to {MAX_TARGET:g}"
        )


def _check_telemetry(telemetry: Telemetry, joint_names: Sequence[str]) -> None:
    """Check the fields that decide about the state; all others are checked when the state is published."""
    if not isinstance(telemetry.reason, str):
        raise ValueError(f"Telemetry.reason is {_format_value(telemetry.reason)}, must be a str")
    _check_index("usable_push_points", telemetry.usable_push_points)
    _check_index("propulsion_joint", telemetry.propulsion_joint, len(joint_names) - 1)


def _check_index(field: str, value: Any, maximum: int | None = None) -> None:
    """Check that a field of the telemetry is None, or an int from 0 to `maximum`. Raises ValueError.

    A maximum of None means that there is no upper bound.
    """
    if value is None:
        return
    if type(value) is int and value >= 0 and (maximum is None or value <= maximum):
        return
    allowed = "None or an int from 0"
    if maximum is not None:
        allowed += f" to {maximum}"
    raise ValueError(f"Telemetry.{field} is {_format_value(value)}, must be {allowed}")


def _format_value(value: Any) -> str:
    """Format a value for an error message: shortened, and with its type unless that is int, float, str or None."""
    text = " ".join(repr(value).split())  # NumPy prints arrays on several lines
    if len(text) > MAX_VALUE_LENGTH:
        text = f"{text[: MAX_VALUE_LENGTH - 3]}..."
    if value is None or type(value) in (int, float, str):
        return text
    return f"{text} ({type(value).__name__})"
