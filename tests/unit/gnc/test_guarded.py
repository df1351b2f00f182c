"""A controller that answers wrongly is named, with the field, the value and what is allowed."""

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
GOOD = make_position_setpoints(STAGE.robot, OBSERVATION.joints.angle_rad)
WHO = r"^controller ./wave.py:Wave \(class Wave\): "


class Wave(Controller[Any]):
    """Answers whatever it is given."""

    def __init__(self, robot: RobotDescription, parameters: Any) -> None:
        super().__init__(robot, parameters)
        self.answer = parameters
        if isinstance(parameters, Exception):
            raise parameters

    def update(self, observation: Observation) -> Any:
        if isinstance(self.answer, type) and issubclass(self.answer, BaseException):
            raise self.answer("as planned")
        return self.answer


def update(answer: Any) -> ControllerCommand:
    return GuardedController("./wave.py:Wave", Wave, STAGE.robot, answer).update(OBSERVATION)


def points(**changes: Any) -> ControllerCommand:
    return ControllerCommand(replace(GOOD, **changes))


def reported(**telemetry: Any) -> ControllerCommand:
    return ControllerCommand(GOOD, Telemetry(**telemetry))


def made_of(setpoints: Any, telemetry: Any = None) -> ControllerCommand:
    return ControllerCommand(setpoints, telemetry or Telemetry())


def test_guarded_valid_answer_passes_unchanged() -> None:
    for answer in (
        ControllerCommand(GOOD),
        points(target=[1, 0.5, -2]),
        points(mode=list(JointMode)[:3]),
    ):
        assert update(answer) is answer


@pytest.mark.parametrize(
    "answer",
    [
        None,
        GOOD,
        made_of([0.0] * 3),
        made_of(GOOD, "moving"),
        points(target=[0.0] * 2),
        points(mode=[JointMode.POSITION] * 4),
        points(torque_limit_nm=[]),
        points(target=np.zeros(3)),
        points(target=[0.0, math.nan, 0.0]),
        points(target=[0.0, 0.0, -math.inf]),
        points(target=[2e5, 0.0, 0.0]),
        points(target=[np.float64(1), 0.0, 0.0]),
        points(target=[True, 0.0, 0.0]),
        points(target=["1", 0.0, 0.0]),
        points(torque_limit_nm=[7.0, -1.0, 7.0]),
        points(mode=[1, 1, 1]),
        points(mode=[JointMode.POSITION, 7, "x"]),
        reported(reason=None),
        reported(usable_push_points="3"),
        reported(propulsion_joint=3),
        ZeroDivisionError,
        SystemExit,
        ValueError("no such robot"),
    ],
)
def test_guarded_invalid_answer_is_named(answer: Any) -> None:
    with raises_error(ControllerError, code="controller/failed"):
        update(answer)


def test_guarded_keyboard_interrupt_is_no_controller_fault() -> None:
    with pytest.raises(KeyboardInterrupt):
        update(KeyboardInterrupt)
