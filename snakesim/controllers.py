"""Converts what a program gives as a controller: a shipped name, `./file.py:Class`, a class, or a function."""

import inspect
import os
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.base.errors import ConfigError, ControllerError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description, JointState

JointFunction = Callable[[float, JointState], Sequence[float]]
"""Maps the time since arming in s and the state of the joints to an angle in rad for each joint, tail to head."""
ControllerArgument = str | os.PathLike[str] | type[Any] | JointFunction
TAKES = "a shipped name, a path './file.py:Class', a class, or a function f(time_s, joints) -> angles_rad"


def name_controller(controller: ControllerArgument) -> tuple[str, Any | None]:
    """Return the name of a controller in a configuration, and its class.

    Args:
        controller: A shipped name, a path "./file.py:Class", a class with a method `update`, or a function.

    Returns:
        The name, and the class that must be offered under this name; None if the name alone is enough.

    Raises:
        ConfigError: It is none of these.
    """
    if isinstance(controller, str | os.PathLike):
        return os.fspath(controller), None
    name = re.sub(r"\W+", "", getattr(controller, "__name__", type(controller).__name__)) or "function"
    if isinstance(controller, type):
        if not callable(getattr(controller, "update", None)):
            raise ConfigError(
                f"controller={name}: a controller class needs a method update(view); see docs/python.md",
                code="python/invalid-argument",
            )
        return f"program:{name}", controller
    if callable(getattr(controller, "update", None)):
        raise ConfigError(
            f"controller={controller!r:.60}: give its class; every arming makes an object of it",
            code="python/invalid-argument",
        )
    if not callable(controller):
        raise ConfigError(f"controller={controller!r:.60}: give {TAKES}", code="python/invalid-argument")
    try:
        inspect.signature(controller).bind(0.0, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"controller={name}: is called as f(time_s, joints), which does not fit: {error}",
            code="python/invalid-argument",
        ) from None
    return f"program:{name}", _wrap_function(controller, name)


def _wrap_function(function: JointFunction, name: str) -> Any:
    """Return a controller class that calls a function in every tick."""

    class FunctionController:
        NEEDS = "joints"

        class Settings(FileStruct, frozen=True):
            """A function has none."""

        def __init__(self, robot: Description, settings: Settings) -> None:
            self._robot = robot

        def update(self, view: View) -> Action:
            returned = function(view.time_s, view.joints)
            angles_rad = _check_angles(returned, len(self._robot.joints), name)
            report = Report(why=f"{name} moves the joints", reference_rad=angles_rad)
            return Action(positions(self._robot, angles_rad), report)

    FunctionController.__name__ = name
    FunctionController.__module__ = getattr(function, "__module__", None) or FunctionController.__module__
    return FunctionController


def _check_angles(returned: Any, count: int, name: str) -> list[float]:
    """Return what a function returned as `count` angles in rad. Raises ControllerError."""
    shown = " ".join(repr(returned).split())  # NumPy prints several lines
    message = f"{name}() returned {shown:.60}, must return {count} angles in rad, tail to head"
    try:
        angles_rad = np.asarray(returned, dtype=float)
    except (TypeError, ValueError) as error:
        raise ControllerError(f"{message}: {error}") from error
    if angles_rad.shape == (count,):
        return angles_rad.tolist()
    actual = f"{len(angles_rad)}" if angles_rad.ndim == 1 else f"an array of shape {angles_rad.shape}"
    raise ControllerError(f"{message}; got {actual}")
