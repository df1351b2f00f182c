"""A controller that answers wrongly is named, with the field, the value and what is allowed."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_gnc.control.guarded import GuardedController
from snakesim_hal.base.errors import ControllerError
from snakesim_hal.wire.messages import Description, Mode
from snakesim_testing.messages import raises_error
from tests.unit.gnc.stage import make_stage

STAGE = make_stage(3)
VIEW = STAGE.view(0, 0.3)
GOOD = positions(STAGE.robot, VIEW.joints.angle_rad)
WHO = r"^controller ./wave.py:Wave \(class Wave\): "


class Wave:
    """Answers whatever it is given."""

    class Settings(msgspec.Struct):
        """None."""

    def __init__(self, robot: Description, settings: Any) -> None:
        self.answer = settings
        if isinstance(settings, Exception):
            raise settings

    def update(self, view: View) -> Any:
        if isinstance(self.answer, type) and issubclass(self.answer, BaseException):
            raise self.answer("as planned")
        return self.answer


def update(answer: Any) -> Action:
    plugin: Any = Wave
    return GuardedController("./wave.py:Wave", plugin, STAGE.robot, answer).update(VIEW)


def points(**changes: Any) -> Action:
    return Action(replace(GOOD, **changes))


def reported(**report: Any) -> Action:
    return Action(GOOD, Report(**report))


def made_of(setpoints: Any, report: Any = None) -> Action:
    return Action(setpoints, report or Report())


def test_a_good_answer_passes_as_it_is() -> None:
    for answer in (Action(GOOD), points(target=[1, 0.5, -2]), points(mode=list(Mode)[:3])):
        assert update(answer) is answer


@pytest.mark.parametrize(
    "answer",
    [
        None,
        GOOD,
        made_of([0.0] * 3),
        made_of(GOOD, "moving"),
        points(target=[0.0] * 2),
        points(mode=[Mode.POSITION] * 4),
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
        points(mode=[Mode.POSITION, 7, "x"]),
        reported(why=None),
        reported(usable_push_points="3"),
        reported(propulsion_joint=3),
        ZeroDivisionError,
        SystemExit,
        ValueError("no such robot"),
    ],
)
def test_a_wrong_one_is_named(answer: Any) -> None:
    with raises_error(ControllerError, code="controller/failed"):
        update(answer)


def test_somebody_who_presses_ctrl_c_is_no_fault_of_the_controller() -> None:
    with pytest.raises(KeyboardInterrupt):
        update(KeyboardInterrupt)
