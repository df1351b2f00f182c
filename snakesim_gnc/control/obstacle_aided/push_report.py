"""Reports the forces that `obstacle_aided` wants on obstacles, and why the body does not move."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.contact_forces import NetContactForce, explain_standstill
from snakesim_gnc.control.obstacle_aided.push import BodyContacts, NormalizedPush
from snakesim_gnc.control.obstacle_aided.push_control import PushControl
from snakesim_gnc.control.progress import BodyLocation
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation, Telemetry
from snakesim_hal.wire.messages import WorldContact, WorldModel

MAX_REPORTED_PUSH_POINTS = 64  # push-points in a message
# A body that was slower than this for MIN_STANDSTILL_DURATION_S is reported as stationary.
MAX_STANDSTILL_SPEED_M_S = 0.01
MIN_STANDSTILL_DURATION_S = 0.5


class PushReporter:
    """Reports the push along the path at each tick, and why the body is stationary if it is."""

    def __init__(self, body: PlanarBody, max_torque_nm: float) -> None:
        """Start with a body that has just moved.

        Args:
            body: The robot as a planar chain.
            max_torque_nm: Maximum torque of a joint for pushing, from which the headroom is computed.
        """
        self._body = body
        self._max_torque_nm = max_torque_nm
        # When the body was last faster than MAX_STANDSTILL_SPEED_M_S.
        self._last_motion_time_s = 0.0

    def start_rest(self, time_s: float) -> None:
        """Restart the time for which the body has been stationary, because no motion is desired.

        Args:
            time_s: Time of this tick.
        """
        self._last_motion_time_s = time_s

    def make_telemetry(
        self,
        observation: Observation,
        location: BodyLocation,
        push_control: PushControl,
        look_ahead_n: float,
        reference: Floats,
    ) -> Telemetry:
        """Report the push along the path, and why the body is stationary if it is.

        Args:
            observation: The inputs of this tick.
            location: Position and speed of the body on the path.
            push_control: The push that is commanded.
            look_ahead_n: Force along the path that the look-ahead causes.
            reference: (n_joints,) reference angles, rad.

        Returns:
            The telemetry of this tick, with desired contact forces in N and joint torques in N·m.
        """
        if abs(location.speed_m_s) > MAX_STANDSTILL_SPEED_M_S:
            self._last_motion_time_s = observation.time_s
        is_stationary = (
            observation.time_s - self._last_motion_time_s > MIN_STANDSTILL_DURATION_S
            and push_control.snapshot is not None
        )
        points = self._make_push_points(push_control)
        is_jammed, reason = _explain_standstill(location, push_control, points)
        return Telemetry(
            reason=reason if is_stationary else "",
            reason_if_stationary=reason if observation.time_s > MIN_STANDSTILL_DURATION_S else "",
            path_s_m=location.tail_s_m,
            propulsion_n=look_ahead_n + push_control.force_n,
            push_points=points,
            desired_force_n=[float(np.hypot(*contact.force_w[:2])) for contact in points],
            bending_torque_nm=push_control.torques_nm.tolist(),
            reference_rad=reference.tolist(),
            torque_headroom_nm=self._max_torque_nm - float(np.abs(push_control.torques_nm).max()),
            saturated=0.0 < push_control.max_force_n <= push_control.force_n,
            jammed=is_stationary and is_jammed,
        )

    def _make_push_points(self, push_control: PushControl) -> list[WorldContact]:
        """Return the contacts that push, as messages; none while no contacts are known."""
        snapshot = push_control.snapshot
        if snapshot is None:
            return []
        return make_push_point_messages(
            self._body, snapshot.world, snapshot.contacts, snapshot.push, push_control.force_n
        )


def _explain_standstill(
    location: BodyLocation, push_control: PushControl, points: list[WorldContact]
) -> tuple[bool, str]:
    """Explain why the body would be stationary if it does not move.

    Args:
        location: Position of the body on the path.
        push_control: The push that is commanded.
        points: Push-points with their desired forces.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    snapshot = push_control.snapshot
    if snapshot is None:
        return False, "standing still: backing out along its own path"
    names = [point.obstacle for point in points if point.obstacle is not None]
    towards_head_w = (location.body_points_w[:, -1] - location.body_points_w[:, 0]).tolist()
    return explain_push_standstill(
        snapshot.contacts,
        snapshot.push,
        push_control.force_n,
        push_control.max_force_n,
        push_control.measured_contacts.resolve_along(towards_head_w),
        names,
    )


def make_push_point_messages(
    body: PlanarBody,
    world: WorldModel,
    contacts: BodyContacts,
    push: NormalizedPush,
    force_n: float,
) -> list[WorldContact]:
    """Return the contacts that push, as messages with their desired forces.

    Args:
        body: Lengths and indices of the robot's body.
        world: The world model in which the contacts were found.
        contacts: Contacts of the body.
        push: Contact forces and joint torques for 1 N along the body.
        force_n: Desired force along the body.

    Returns:
        Messages of the contacts with a force above zero, tail to head, at most MAX_REPORTED_PUSH_POINTS.
    """
    points: list[WorldContact] = []
    for k in np.argsort(contacts.body_s_m, kind="stable").tolist():
        if push.contact_forces[k] > 0.0:
            points.append(
                _describe_push_point(
                    body, world, contacts, k, force_n * float(push.contact_forces[k])
                )
            )
    return points[:MAX_REPORTED_PUSH_POINTS]


def _describe_push_point(
    body: PlanarBody,
    world: WorldModel,
    contacts: BodyContacts,
    contact_index: int,
    push_magnitude_n: float,
) -> WorldContact:
    """Return the message that reports one contact and the force with which the body pushes there.

    Args:
        body: Lengths and indices of the robot's body.
        world: The world model.
        contacts: All contacts of the body.
        contact_index: Index of the contact in `contacts`.
        push_magnitude_n: Magnitude of the push, as a multiple of the contact's direction d_c, which may be longer
            than 1.
    """
    x, y = contacts.positions_w[contact_index].tolist()
    direction_x, direction_y = contacts.directions_w[contact_index].tolist()
    length = float(np.hypot(direction_x, direction_y))
    # The force is parallel to the reported normal, which so includes friction.
    normal_x = direction_x / length
    normal_y = direction_y / length
    force_n = push_magnitude_n * length
    # Of the two tangents, report the one towards the head.
    sign = 1.0 if contacts.tangents_w[contact_index] @ (direction_y, -direction_x) > 0.0 else -1.0
    body_s_m = float(contacts.body_s_m[contact_index])
    return WorldContact(
        link=body.find_link_at(body_s_m),
        obstacle=world.obstacles[int(contacts.obstacle_index[contact_index])].name,
        body_s_m=body_s_m,
        position_w=(x, y, world.base_position_w[2]),
        normal_w=(normal_x, normal_y, 0.0),
        tangent_w=(sign * normal_y, -sign * normal_x, 0.0),
        force_w=(force_n * normal_x, force_n * normal_y, 0.0),
    )


def explain_push_standstill(
    contacts: BodyContacts,
    push: NormalizedPush,
    force_n: float,
    max_force_n: float,
    net_force: NetContactForce | None,
    push_points: Sequence[str],
) -> tuple[bool, str]:
    """Explain why a body that is pushed forward does not move.

    Args:
        contacts: Contacts of the body.
        push: Contact forces and joint torques for 1 N along the body.
        force_n: Desired force along the body.
        max_force_n: Maximum force along the body within the limits of joint torques and contact forces.
        net_force: Measured contact forces along the body; None without a contact sensor.
        push_points: Names of the obstacles that the body should push off.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    if not len(contacts):
        return False, "standing still: no obstacle is near enough to push off"
    if not push.is_balanced:
        obstacles = "the obstacle"
        if len(contacts) > 1:
            obstacles = f"the {len(contacts)} obstacles"
        return (
            False,
            f"standing still: contacts lost, {obstacles} beside the body cannot push it forward",
        )
    if force_n >= max_force_n:
        return (
            False,
            f"standing still: torques and contacts allow no more than {max_force_n:.1f} N along the body",
        )
    return explain_standstill(force_n, net_force, push_points)
