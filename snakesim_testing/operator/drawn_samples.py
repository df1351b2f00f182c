"""Builds the messages that the console draws: joint angles, contacts, control states and world models."""

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
JOINT_COUNT = len(ROBOT.joints)


def make_joints(*angles_rad: float) -> JointState:
    """Return a joint state with the given angles of the first joints. All other joints are at 0 rad."""
    remaining_joint_count = JOINT_COUNT - len(angles_rad)
    return make_joint_state(ROBOT, [*angles_rad, *[0.0] * remaining_joint_count])


def make_contact(
    force_w: tuple[float, float, float],
    obstacle: str = "peg",
    *,
    x_m: float = 0.1,
    body_s_m: float = 0.1,
) -> WorldContact:
    """Return a contact of the first link with an obstacle whose normal points along y.

    Args:
        force_w: Contact force in N.
        obstacle: Name of the obstacle.
        x_m: Position of the contact on the x axis.
        body_s_m: Position of the contact along the body.
    """
    return WorldContact(
        link=0,
        obstacle=obstacle,
        body_s_m=body_s_m,
        position_w=(x_m, 0.0, 0.0),
        normal_w=(0.0, 1.0, 0.0),
        tangent_w=(1.0, 0.0, 0.0),
        force_w=force_w,
    )


def make_control_state(
    push_points: list[WorldContact], desired_force_n: list[float], **fields: Any
) -> ControlState:
    """Return the state of a controller that pushes against these points with these forces."""
    return ControlState(
        tick=1,
        timestamp_ns=1,
        controller="any",
        state="Locomoting",
        reason="",
        push_points=push_points,
        desired_force_n=desired_force_n,
        **fields,
    )


def make_world_model(contacts: list[WorldContact], obstacles: list[KnownObstacle]) -> WorldModel:
    """Return a world model with a base at the origin and with these contacts and obstacles."""
    return WorldModel(
        tick=1,
        timestamp_ns=1,
        base_position_w=(0.0, 0.0, 0.0),
        base_orientation_wxyz=(1.0, 0.0, 0.0, 0.0),
        base_confidence=1.0,
        contacts=contacts,
        obstacles=obstacles,
    )
