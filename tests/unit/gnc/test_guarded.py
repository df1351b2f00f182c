"""A controller that answers wrongly is named, with the field, the value and what is allowed."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.guarded import GuardedController
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.wire.messages import Description, Mode
from snakesim_testing.gnc.stage import make_stage

STAGE = make_stage(3)
OBSERVATION = STAGE.observe(0, 0.3)
GOOD = positions(STAGE.robot, OBSERVATION.joints.angle_rad)
WHO = r"^controller ./wave.py:Wave \(class Wave\): "


class Wave(Controller[Any]):
    """Answers whatever it is given."""

    def __init__(self, robot: Description, parameters: Any) -> None:
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


def test_a_good_answer_passes_as_it_is() -> None:
    for answer in (ControllerCommand(GOOD), points(target=[1, 0.5, -2]), points(mode=list(Mode)[:3])):
        assert update(answer) is answer


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, r"update\(\) returned None, must return a ControllerCommand"),
        (
            GOOD,
            r"update\(\) returned RequestedSetpoints\(.*\.\.\. \(RequestedSetpoints\), must return a ControllerCommand",
        ),
        (made_of([0.0] * 3), r"ControllerCommand.setpoints is \[0.0, 0.0, 0.0\] \(list\), must be RequestedSetpoints"),
        (made_of(GOOD, "moving"), r"ControllerCommand.telemetry is 'moving', must be Telemetry"),
        (
            points(target=[0.0] * 2),
            r"RequestedSetpoints.target has 2 values, must have 3: one a joint, joint_1 to joint_3",
        ),
        (points(mode=[Mode.POSITION] * 4), "RequestedSetpoints.mode has 4 values, must have 3"),
        (points(torque_limit_nm=[]), "RequestedSetpoints.torque_limit_nm has 0 values"),
        (
            points(target=np.zeros(3)),
            r"RequestedSetpoints.target is array\(.*\(ndarray\), must be a list; use .tolist\(\)",
        ),
        (
            points(target=[0.0, math.nan, 0.0]),
            r"RequestedSetpoints.target\[1\] \(joint_2\) is nan, must be a finite number",
        ),
        (points(target=[0.0, 0.0, -math.inf]), r"RequestedSetpoints.target\[2\] \(joint_3\) is -inf"),
        (points(target=[2e5, 0.0, 0.0]), r".* is 200000.0, must be .* of rad, rad/s or N·m from -100000 to 100000"),
        (points(target=[np.float64(1), 0.0, 0.0]), r".* is .*1.0.* \(float64\), must be a plain float"),
        (points(target=[True, 0.0, 0.0]), r".* is True \(bool\), must be a plain float"),
        (points(target=["1", 0.0, 0.0]), ".* is '1', must be a plain float"),
        (points(torque_limit_nm=[7.0, -1.0, 7.0]), r".*_limit_nm\[1\] \(joint_2\) is -1.0, must be .* N·m from 0"),
        (
            points(mode=[1, 1, 1]),
            r"RequestedSetpoints.mode\[0\] \(joint_1\) is 1, must be one of Mode.PASSIVE, Mode.POSITION",
        ),
        (points(mode=[Mode.POSITION, 7, "x"]), r"RequestedSetpoints.mode\[1\] \(joint_2\) is 7"),
        (reported(reason=None), "Telemetry.reason is None, must be a str"),
        (reported(usable_push_points="3"), "Telemetry.usable_push_points is '3'"),
        (reported(propulsion_joint=3), "Telemetry.propulsion_joint is 3, must be None or an int from 0 to 2"),
        (ZeroDivisionError, r"update\(\) raised ZeroDivisionError: as planned \(test_guarded.py line \d+\)"),
        (SystemExit, r"update\(\) raised SystemExit: as planned"),
        (ValueError("no such robot"), r"__init__\(\) raised ValueError: no such robot"),
    ],
)
def test_a_wrong_one_is_named(answer: Any, words: str) -> None:
    with pytest.raises(ControllerError, match=WHO + words):
        update(answer)


def test_somebody_who_presses_ctrl_c_is_no_fault_of_the_controller() -> None:
    with pytest.raises(KeyboardInterrupt):
        update(KeyboardInterrupt)
