"""Tests the controller of an environment whose actions correct the targets of another controller."""

import pytest

from snakesim_gnc.control.hold import HoldPose
from snakesim_gnc.control.obstacle_triplet import ObstacleTriplet
from snakesim_gnc.control.policy import PolicyController
from snakesim_hal.controller import Controller, NoParameters
from snakesim_hal.model.plugins import require_base_class
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import make_stage

pytest.importorskip("gymnasium")
from snakesim.environments.assisted import _make_correcting_class

MEMBERS = [name for name in vars(Controller) if not name.startswith("_") and name != "update"]


@pytest.mark.parametrize("controller", [HoldPose, ObstacleTriplet, PolicyController])
def test_correcting_class_has_declarations_of_corrected_controller(
    controller: type[Controller],
) -> None:
    corrected = require_base_class(
        _make_correcting_class(controller, []), Controller, "controller 'corrected'"
    )
    for name in MEMBERS:
        corrected_member, member = (getattr(cls, name) for cls in (corrected, controller))
        # Class methods are bound to their class, so that their functions are compared.
        assert getattr(corrected_member, "__func__", corrected_member) is getattr(
            member, "__func__", member
        ), name


def test_correcting_controller_adds_corrections_to_position_targets() -> None:
    stage = make_stage(3)
    residual_rad = [0.0, 0.1, -0.2]
    observation = stage.make_observation(0, 0.3)
    corrected = _make_correcting_class(HoldPose, residual_rad)(stage.robot, NoParameters())
    command = corrected.update(observation)
    assert command.setpoints.mode == [JointMode.POSITION] * 3
    added_rad = [
        target - angle
        for target, angle in zip(
            command.setpoints.target, observation.joints.angle_rad, strict=True
        )
    ]
    assert added_rad == pytest.approx(residual_rad)
    assert command.telemetry.reason == "holding"
