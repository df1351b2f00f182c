"""SnakeSIM for Python programs and notebooks: run scenarios, read their results, and command running robots.

    import snakesim

    result = snakesim.run("triplet", duration=8, set={"control.propulsion_n": 35})
    result["angle_rad"], result.metrics["path_distance_m"], result.plot("torque_nm")

`run`, `load` and `Result` are for whole runs, `Robot` is a connection to a robot that is already running.
`Controller` is the base class of controllers; `Observation`, `ControllerCommand`, `Telemetry`, `Parameters` and
`make_position_setpoints` go with it, and `compute_body_points_w` computes where joints, head and tail are.
`docs/how-to/python.md` is the reference. Nothing of SnakeSIM imports this package.

Names are loaded when they are first used, and importing this package changes nothing in the process. A run gives the
digest of `snakesim run`, because it is computed in a child process where this process would round otherwise. Only a run
with a controller that is an object of this program stays in the process: call `use_common_arithmetic` before NumPy is
imported, so that this process rounds as `snakesim run` does.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from snakesim_hal.base.arithmetic import is_pinned, pin_common_arithmetic
from snakesim_hal.base.errors import (
    ConfigError,
    ControllerError,
    NotConnectedError,
    RefusedError,
    SnakesimError,
    StalledError,
)

if TYPE_CHECKING:
    from snakesim.result import Result
    from snakesim.robot import Robot
    from snakesim.runs import load, run
    from snakesim_hal.controller import (
        Controller,
        ControllerCommand,
        Observation,
        Telemetry,
        make_position_setpoints,
    )
    from snakesim_hal.model.files import FileStruct as Parameters
    from snakesim_hal.model.geometry.kinematics import compute_body_points_w

__all__ = [
    "ConfigError",
    "Controller",
    "ControllerCommand",
    "ControllerError",
    "NotConnectedError",
    "Observation",
    "Parameters",
    "RefusedError",
    "Result",
    "Robot",
    "SnakesimError",
    "StalledError",
    "Telemetry",
    "compute_body_points_w",
    "load",
    "make_position_setpoints",
    "run",
    "use_common_arithmetic",
]
CONTROLLER = "snakesim_hal.controller"
LAZY = {
    "Controller": (CONTROLLER, "Controller"),
    "ControllerCommand": (CONTROLLER, "ControllerCommand"),
    "Observation": (CONTROLLER, "Observation"),
    "Parameters": ("snakesim_hal.model.files", "FileStruct"),
    "Result": ("snakesim.result", "Result"),
    "Robot": ("snakesim.robot", "Robot"),
    "Telemetry": (CONTROLLER, "Telemetry"),
    "compute_body_points_w": ("snakesim_hal.model.geometry.kinematics", "compute_body_points_w"),
    "load": ("snakesim.runs", "load"),
    "make_position_setpoints": (CONTROLLER, "make_position_setpoints"),
    "run": ("snakesim.runs", "run"),
}


def use_common_arithmetic() -> None:
    """Let this process and its children round as `snakesim run` does, so that one seed gives one digest.

    NumPy chooses its code by the processor when it is imported, and another choice rounds otherwise. This function sets
    environment variables that select the code for processors with AVX2. Call it before NumPy is imported, by this
    program or by another package. On a processor that cannot run this code it has no effect.

    Raises:
        ConfigError: NumPy is imported already, and rounds otherwise.
    """
    pin_common_arithmetic()
    if "numpy" in sys.modules and not is_pinned():
        raise ConfigError(
            "use_common_arithmetic(): NumPy is imported already, and rounds otherwise than `snakesim run`; call this "
            "function at the beginning of the program, before NumPy is imported"
        )


def __getattr__(name: str) -> Any:
    if name not in LAZY:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}"
        )
    module, attribute = LAZY[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return __all__
