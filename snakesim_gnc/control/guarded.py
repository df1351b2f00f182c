"""Wraps a controller, and checks all its outputs, because it may be third-party code: errors name it.

The output must be what the wire accepts: lists of modes, targets and torque limits with one entry a joint,
of `Mode` and plain, finite Python numbers.
"""

import contextlib
import math
import traceback
from collections.abc import Iterator, Sequence
from typing import Any

from snakesim_gnc.control.controller import Action, Controller, Report, View
from snakesim_hal.base.errors import ControllerError, raised
from snakesim_hal.wire.messages import Description, JointDescription, Mode
from snakesim_hal.wire.quantities import MAX_TARGET
from snakesim_hal.wire.setpoints import RequestedSetpoints

NUMBERS = {float, int}  # exactly: a NumPy number or a bool cannot be sent
MODES = ", ".join(f"Mode.{mode.name}" for mode in Mode)


class Guarded:
    """A checked controller, created for one arming. Every call may raise ControllerError."""

    def __init__(self, name: str, plugin: type[Controller], robot: Description, settings: Any) -> None:
        """name: as configured: an entry point, or `./file.py:Class`."""
        self._who = f"controller {name} (class {getattr(plugin, '__name__', plugin)})"
        self._module = plugin.__module__
        self._joints = robot.joints
        with self._named("__init__"):
            self._controller = plugin(robot, settings)

    def update(self, view: View) -> Action:
        """The controller's action, checked."""
        with self._named("update"):
            action = self._controller.update(view)
        try:
            check(action, self._joints)
        except ValueError as error:
            raise self.wrong(str(error)) from None
        return action

    def wrong(self, what: str) -> ControllerError:
        """An error that names the controller. what: the field, its value, and what is allowed."""
        return ControllerError(f"{self._who}: {what}")

    @contextlib.contextmanager
    def _named(self, method: str) -> Iterator[None]:
        """Turn exceptions of a method into errors that name it; the traceback goes to the log."""
        try:
            yield
        except ControllerError as error:  # it says all: an answer that is not allowed
            raise self.wrong(str(error)) from error.__cause__
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            raise self.wrong(f"{method}() {raised(error, self._module)}") from error


def check(action: Action, described: Sequence[JointDescription]) -> None:
    """Raises ValueError with the field, its value and what is allowed. described: the joints, tail to head."""
    if not isinstance(action, Action):
        raise ValueError(f"update() returned {_repr(action)}, must return an Action")
    joints = [joint.name for joint in described]
    points, report = action.setpoints, action.report
    if not isinstance(points, RequestedSetpoints):
        raise ValueError(f"Action.setpoints is {_repr(points)}, must be RequestedSetpoints")
    if not isinstance(report, Report):
        raise ValueError(f"Action.report is {_repr(report)}, must be a Report")
    _check_length("mode", points.mode, joints)
    for i, mode in enumerate(points.mode):
        if type(mode) is not Mode:
            raise ValueError(f"setpoints.mode[{i}] ({joints[i]}) is {_repr(mode)}, must be one of {MODES}")
        if not described[i].has(mode):
            has = ", ".join(f"Mode.{one.name}" for one in described[i].modes)
            raise ValueError(f"setpoints.mode[{i}] is Mode.{mode.name}, which {joints[i]} does not have; it has {has}")
    _check_numbers("target", points.target, joints, least=-MAX_TARGET)
    _check_numbers("torque_limit_nm", points.torque_limit_nm, joints, least=0.0)
    _check_report(report, joints)


def _check_length(field: str, values: Any, joints: Sequence[str]) -> None:
    if type(values) is not list:
        hint = "; use .tolist()" if hasattr(values, "tolist") else ""
        raise ValueError(f"RequestedSetpoints.{field} is {_repr(values)}, must be a list{hint}")
    if len(values) != len(joints):
        wanted = f"{len(joints)}: one a joint, {joints[0]} to {joints[-1]}"
        raise ValueError(f"RequestedSetpoints.{field} has {len(values)} values, must have {wanted}")


def _check_numbers(field: str, values: Any, joints: Sequence[str], *, least: float) -> None:
    _check_length(field, values, joints)
    for i, value in enumerate(values):
        if type(value) in NUMBERS and least <= value <= MAX_TARGET:  # false for NaN
            continue
        where = f"RequestedSetpoints.{field}[{i}] ({joints[i]}) is {_repr(value)}"
        if type(value) not in NUMBERS:
            raise ValueError(f"{where}, must be a plain float: use float(), or .tolist() of an array")
        unit = "N·m" if field == "torque_limit_nm" else "rad, rad/s or N·m"
        raise ValueError(f"{where}, must be a finite number of {unit} from {least:g} to {MAX_TARGET:g}")


def _check_report(report: Report, joints: Sequence[str]) -> None:
    """Checks the fields that decide about the state; the others are checked when published."""
    if not isinstance(report.why, str):
        raise ValueError(f"Report.why is {_repr(report.why)}, must be a str")
    for field, most in (("usable_push_points", math.inf), ("propulsion_joint", len(joints) - 1)):
        value = getattr(report, field)
        if value is not None and not (type(value) is int and 0 <= value <= most):
            allowed = "None or an int from 0" + ("" if most == math.inf else f" to {most}")
            raise ValueError(f"Report.{field} is {_repr(value)}, must be {allowed}")


def _repr(value: Any) -> str:
    """A value for an error message, with its type unless that is plain."""
    text = " ".join(repr(value).split())  # NumPy prints several lines
    text = text if len(text) <= 60 else f"{text[:57]}..."
    return text if value is None or type(value) in (int, float, str) else f"{text} ({type(value).__name__})"
