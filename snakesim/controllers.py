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
    make_position_setpoints,
)
from snakesim_hal.model.plugins import require_base_class
from snakesim_hal.wire.messages import JointState

JointFunction = Callable[[float, JointState], Sequence[float]]
"""Maps the time since arming in s and the state of the joints to an angle in rad for each joint, tail to head."""
ControllerArgument = str | os.PathLike[str] | type[Any] | JointFunction
ALLOWED_CONTROLLERS = "a shipped name, a path './file.py:Class', a class, or a function f(time_s, joints) -> angles_rad"


def resolve_controller(controller: ControllerArgument) -> tuple[str, type[Controller[Any]] | None]:
    """Convert the argument `controller` of a run to the name of a controller plugin, and the class of this plugin.

    Args:
        controller: A shipped name, a path "./file.py:Class", a class derived from `Controller`, or a function
            f(time_s, joints) -> angles_rad.

    Returns:
        The name, and the class that must be registered as a plugin under this name. The class is None for a shipped
        name or a path, which every process can load by itself.

    Raises:
        ConfigError: The argument is none of these, or cannot be called as f(time_s, joints).
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
        raise ConfigError(
            f"controller={controller!r:.60}: give {ALLOWED_CONTROLLERS}",
            code="python/invalid-argument",
        )
    name = _make_valid_name(controller)
    try:
        inspect.signature(controller).bind(0.0, None)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"controller={name}: is called as f(time_s, joints), which does not fit: {error}",
            code="python/invalid-argument",
        ) from None
    return f"program:{name}", _make_function_controller(controller, name)


def _make_valid_name(function: Any) -> str:
    """Return the name of a function without characters that a name must not have, such as those of `<lambda>`."""
    name = getattr(function, "__name__", type(function).__name__)
    return re.sub(r"\W+", "", name) or "function"


def _make_function_controller(function: JointFunction, name: str) -> type[Controller[Any]]:
    """Return a controller class that calls a function in every tick."""

    class FunctionController(Controller[NoParameters]):
        needs_world = False

        def update(self, observation: Observation) -> ControllerCommand:
            returned = function(observation.time_s, observation.joints)
            angles_rad = _validate_angles(returned, len(self.robot.joints), name)
            telemetry = Telemetry(reason=f"{name} moves the joints", reference_rad=angles_rad)
            return ControllerCommand(make_position_setpoints(self.robot, angles_rad), telemetry)

    FunctionController.__name__ = name
    FunctionController.__module__ = (
        getattr(function, "__module__", None) or FunctionController.__module__
    )
    return FunctionController


def _validate_angles(returned: Any, joint_count: int, name: str) -> list[float]:
    """Convert the result of a controller function to a list of angles. Raises ControllerError if it is not valid."""
    shown = " ".join(repr(returned).split())  # NumPy prints several lines
    message = (
        f"{name}() returned {shown:.60}, must return {joint_count} angles in rad, tail to head"
    )
    try:
        angles_rad = np.asarray(returned, dtype=float)
    except (TypeError, ValueError) as error:
        raise ControllerError(f"{message}: {error}") from error
    if angles_rad.shape == (joint_count,):
        return angles_rad.tolist()
    actual = (
        f"{len(angles_rad)}" if angles_rad.ndim == 1 else f"an array of shape {angles_rad.shape}"
    )
    raise ControllerError(f"{message}; got {actual}")
