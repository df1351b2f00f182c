"""Converts what a program gives as a controller: a shipped name, `./file.py:Class`, a class, or a function."""

import inspect
import os
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from snakesim_hal.base.errors import ConfigError, ControllerError
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    NoParameters,
    Observation,
    Telemetry,
    positions,
)
from snakesim_hal.model.plugins import require_base_class
from snakesim_hal.wire.messages import JointState

JointFunction = Callable[[float, JointState], Sequence[float]]
"""Maps the time since arming in s and the state of the joints to an angle in rad for each joint, tail to head."""
ControllerArgument = str | os.PathLike[str] | type[Any] | JointFunction
TAKES = "a shipped name, a path './file.py:Class', a class, or a function f(time_s, joints) -> angles_rad"


def name_controller(controller: ControllerArgument) -> tuple[str, type[Controller[Any]] | None]:
    """Return the name of a controller in a configuration, and its class.

    Args:
        controller: A shipped name, a path "./file.py:Class", a class derived from `Controller`, or a function.

    Returns:
        The name, and the class that must be offered under this name; None if the name alone is enough.

    Raises:
        ConfigError: It is none of these.
    """
    if isinstance(controller, str | os.PathLike):
        return os.fspath(controller), None
    if isinstance(controller, type):
        name = f"program:{controller.__name__}"
        return name, require_base_class(controller, Controller, f"controller {name!r}")
    if isinstance(controller, Controller):
        raise ConfigError(
            f"controller={controller!r:.60}: give its class; every arming makes an object of it",
            code="python/invalid-argument",
        )
    if not callable(controller):
        raise ConfigError(f"controller={controller!r:.60}: give {TAKES}", code="python/invalid-argument")
    name = _name_function(controller)
    try:
        inspect.signature(controller).bind(0.0, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"controller={name}: is called as f(time_s, joints), which does not fit: {error}",
            code="python/invalid-argument",
        ) from None
    return f"program:{name}", _wrap_function(controller, name)


def _name_function(function: Any) -> str:
    """Return the name of a function without characters that a name must not have, such as those of `<lambda>`."""
    name = getattr(function, "__name__", type(function).__name__)
    return re.sub(r"\W+", "", name) or "function"


def _wrap_function(function: JointFunction, name: str) -> type[Controller[Any]]:
    """Return a controller class that calls a function in every tick."""

    class FunctionController(Controller[NoParameters]):
        needs_world = False

        def update(self, observation: Observation) -> ControllerCommand:
            returned = function(observation.time_s, observation.joints)
            angles_rad = _check_angles(returned, len(self.robot.joints), name)
            telemetry = Telemetry(reason=f"{name} moves the joints", reference_rad=angles_rad)
            return ControllerCommand(positions(self.robot, angles_rad), telemetry)

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
