"""Samples that the console draws."""

from typing import Any

from snakesim_hal.wire.messages import (
    ControlState,
    JointState,
    KnownObstacle,
    WorldContact,
    WorldModel,
)
from snakesim_testing.hal.small_robots import make_description, make_joint_state

ROBOT = make_description()


COUNT = len(ROBOT.joints)


def joints(*angles_rad: float) -> JointState:
    return make_joint_state(ROBOT, [*angles_rad, *[0.0] * (COUNT - len(angles_rad))])


def contact(
    force_w: tuple[float, float, float],
    obstacle: str = "peg",
    *,
    x_m: float = 0.1,
    body_s_m: float = 0.1,
) -> WorldContact:
    return WorldContact(
        link=0, obstacle=obstacle, body_s_m=body_s_m, position_w=(x_m, 0.0, 0.0), normal_w=(0.0, 1.0, 0.0),
        tangent_w=(1.0, 0.0, 0.0), force_w=force_w,
    )  # fmt: skip


def pushing(points: list[WorldContact], desired_force_n: list[float], **more: Any) -> ControlState:
    return ControlState(
        tick=1, timestamp_ns=1, controller="any", state="Locomoting", reason="", push_points=points,
        desired_force_n=desired_force_n, **more,
    )  # fmt: skip


def world(contacts: list[WorldContact], obstacles: list[KnownObstacle]) -> WorldModel:
    return WorldModel(
        tick=1, timestamp_ns=1, base_position_w=(0.0, 0.0, 0.0), base_orientation_wxyz=(1.0, 0.0, 0.0, 0.0),
        base_confidence=1.0, contacts=contacts, obstacles=obstacles,
    )  # fmt: skip
