"""The controller of an environment with corrections: everything but the targets is that of the other controller."""

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
def test_it_has_every_declaration_of_the_other_controller(controller: type[Controller]) -> None:
    corrected = require_base_class(
        _make_correcting_class(controller, []), Controller, "controller 'corrected'"
    )
    for name in MEMBERS:
        own, other = (getattr(cls, name) for cls in (corrected, controller))
        assert getattr(own, "__func__", own) is getattr(other, "__func__", other), name


def test_it_adds_corrections_to_targets_in_position_mode_alone() -> None:
    stage, residual_rad = make_stage(3), [0.0, 0.1, -0.2]
    observation = stage.make_observation(0, 0.3)
    corrected = _make_correcting_class(HoldPose, residual_rad)(stage.robot, NoParameters())
    command = corrected.update(observation)
    assert command.setpoints.mode == [JointMode.POSITION] * 3
    added = [
        target - angle
        for target, angle in zip(
            command.setpoints.target, observation.joints.angle_rad, strict=True
        )
    ]
    assert added == pytest.approx(residual_rad)
    assert command.telemetry.reason == "holding"
