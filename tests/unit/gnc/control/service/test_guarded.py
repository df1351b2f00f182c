"""Tests that an invalid command of a controller is an error with the controller, the field and the allowed values."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.service.guarded import GuardedController
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_testing.gnc.stage import make_stage
from snakesim_testing.messages import raises_error

STAGE = make_stage(3)
OBSERVATION = STAGE.make_observation(0, 0.3)
VALID_SETPOINTS = make_position_setpoints(STAGE.robot, OBSERVATION.joints.angle_rad)


class Wave(Controller[Any]):
    """A controller that returns its parameters as its command.

    It raises them instead if they are an error: an instance when it is created, a class when it is updated.
    """

    def __init__(self, robot: RobotDescription, parameters: Any) -> None:
        super().__init__(robot, parameters)
        self.command = parameters
        if isinstance(parameters, Exception):
            raise parameters

    def update(self, observation: Observation) -> Any:
        if isinstance(self.command, type) and issubclass(self.command, BaseException):
            raise self.command("as planned")
        return self.command


def update_guarded(command: Any) -> ControllerCommand:
    """Create and update a guarded controller that returns a command."""
    return GuardedController("./wave.py:Wave", Wave, STAGE.robot, command).update(OBSERVATION)


def change_setpoints(**changes: Any) -> ControllerCommand:
    """Return a valid command with changes of its setpoints."""
    return ControllerCommand(replace(VALID_SETPOINTS, **changes))


def change_telemetry(**telemetry: Any) -> ControllerCommand:
    """Return a valid command with this telemetry."""
    return ControllerCommand(VALID_SETPOINTS, Telemetry(**telemetry))


def make_command(setpoints: Any, telemetry: Any = None) -> ControllerCommand:
    return ControllerCommand(setpoints, telemetry or Telemetry())


def test_guarded_valid_command_passes_unchanged() -> None:
    for command in (
        ControllerCommand(VALID_SETPOINTS),
        change_setpoints(target=[1, 0.5, -2]),
        change_setpoints(mode=list(JointMode)[:3]),
    ):
        assert update_guarded(command) is command


@pytest.mark.parametrize(
    "answer",
    [
        None,
        VALID_SETPOINTS,
        make_command([0.0] * 3),
        make_command(VALID_SETPOINTS, "moving"),
        change_setpoints(target=[0.0] * 2),
        change_setpoints(mode=[JointMode.POSITION] * 4),
        change_setpoints(torque_limit_nm=[]),
        change_setpoints(target=np.zeros(3)),
        change_setpoints(target=[0.0, math.nan, 0.0]),
        change_setpoints(target=[0.0, 0.0, -math.inf]),
        change_setpoints(target=[2e5, 0.0, 0.0]),
        change_setpoints(target=[np.float64(1), 0.0, 0.0]),
        change_setpoints(target=[True, 0.0, 0.0]),
        change_setpoints(target=["1", 0.0, 0.0]),
        change_setpoints(torque_limit_nm=[7.0, -1.0, 7.0]),
        change_setpoints(mode=[1, 1, 1]),
        change_setpoints(mode=[JointMode.POSITION, 7, "x"]),
        change_telemetry(reason=None),
        change_telemetry(usable_push_points="3"),
        change_telemetry(propulsion_joint=3),
        ZeroDivisionError,
        SystemExit,
        ValueError("no such robot"),
    ],
)
def test_guarded_invalid_answer_is_an_error(answer: Any) -> None:
    with raises_error(ControllerError, code="controller/failed"):
        update_guarded(answer)


def test_guarded_keyboard_interrupt_is_no_controller_fault() -> None:
    with pytest.raises(KeyboardInterrupt):
        update_guarded(KeyboardInterrupt)
