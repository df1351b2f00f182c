"""Turns geometry_msgs/Twist on /cmd_vel into intents of the robot.

`linear.x` is the speed along the body, `angular.z` rotates the desired direction of travel; a Twist with a speed of 0
stops the robot. Every Twist becomes one intent that is valid for INTENT_LIFETIME_NS after the Twist was sent. So the
robot stops if the ROS node falls silent, and a Twist that the network held back moves nothing.
"""

import math
import time
from collections.abc import Callable

from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.network.foreign_network import RawReader
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LocomotionIntent
from snakesim_operator.features.ros2.message_age import SenderClocks, explain_stale_message
from snakesim_operator.features.ros2.messages import decode_twist

# Of an intent in robot time; teleop_twist_keyboard and joysticks repeat at 10 Hz and more.
INTENT_LIFETIME_NS = 500_000_000
MAX_SPEED_M_S = 10.0  # the limit that navigation sets for an intent
MAX_TURN_RATE_RAD_S = 10.0
MAX_LEAD_RAD = math.pi / 2  # beyond this, "ahead of the body" becomes ambiguous
REQUESTER = "ros2 /cmd_vel"


class CmdVelInput:
    """Reads the newest Twist of a ROS topic in each cycle and publishes the intent that it stands for."""

    def __init__(self, twists: RawReader, session: Session, print_text: PrintLine) -> None:
        """Prepare to read the topic and to publish intents.

        Args:
            twists: Messages of the ROS topic.
            session: Session on the robot's network, where the intents are published.
            print_text: Reports dropped messages to the user.
        """
        self._twist_reader = twists
        self._intent_publisher = session.declare_publisher(keys.INTENT, LocomotionIntent)
        self._print_text = print_text
        self._steering = CmdVelSteering()
        self._sender_clocks = SenderClocks()
        self._reported_reason = ""  # the last reason for dropping that the user has seen

    def publish_newest_intent(
        self, robot_ns: int | None, find_heading: Callable[[], float | None]
    ) -> None:
        """Publish an intent for the newest Twist, if one has arrived.

        Args:
            robot_ns: Current robot time. None while the robot is silent; then the Twist is dropped, because an intent
                needs a time.
            find_heading: Returns the heading of the body in the world in rad; None if it is unknown.
        """
        twist = self._twist_reader.pop_newest()
        if twist is None or robot_ns is None:
            return
        wall_ns = time.time_ns()
        monotonic_ns = time.monotonic_ns()
        age_ns = self._sender_clocks.estimate_age_ns(twist, wall_ns, monotonic_ns)
        body_heading_w_rad = find_heading()
        intent = self._steering.make_intent(twist.payload, robot_ns, body_heading_w_rad, age_ns)
        if intent is not None:
            self._intent_publisher.put(intent)
        elif self._steering.reason != self._reported_reason:
            self._reported_reason = self._steering.reason
            self._print_text(
                f"a message on cmd_vel {self._reported_reason}; it is dropped, with all that are alike"
            )


class CmdVelSteering:
    """Integrates the turn rates of successive Twists into a desired direction of travel."""

    def __init__(self) -> None:
        self._heading_w_rad: float | None = None  # desired direction of travel
        self._last_twist_ns: int | None = None  # robot time of the last accepted Twist
        self.rejected_count = 0  # Twists that were malformed, not finite, out of bounds or too old
        self.reason = ""  # for the newest rejection

    def make_intent(
        self, payload: bytes, now_ns: int, body_heading_w_rad: float | None, age_ns: int = 0
    ) -> LocomotionIntent | None:
        """Make the intent that a Twist stands for, and update the desired heading.

        Args:
            payload: The Twist in CDR.
            now_ns: Current robot time.
            body_heading_w_rad: Heading of the body in the world; None while it is unknown.
            age_ns: Age of the Twist, since it was sent.

        Returns:
            The intent; None for a Twist that is rejected and counted.
        """
        components = decode_twist(payload)
        reason = _find_twist_problem(components)
        is_stop = components is not None and components[0] == 0.0
        if is_stop:
            age_ns = 0  # a stop is obeyed however late it arrives
        if not reason:
            reason = explain_stale_message(age_ns, "the times of its sender's messages")
        if reason or components is None:
            self.rejected_count += 1
            self.reason = reason
            return None
        speed_m_s = components[0]
        turn_rate_rad_s = components[5]
        self._update_heading(turn_rate_rad_s, now_ns, body_heading_w_rad)
        return LocomotionIntent(
            timestamp_ns=max(now_ns - age_ns, 0),
            requester=REQUESTER,
            speed_m_s=speed_m_s,
            go=speed_m_s != 0.0,
            valid_for_ns=INTENT_LIFETIME_NS,
            heading_w_rad=self._heading_w_rad,
        )

    def _update_heading(
        self, turn_rate_rad_s: float, now_ns: int, body_heading_w_rad: float | None
    ) -> None:
        """Rotate the desired direction for the time since the last Twist; after a silence, start at the body's."""
        elapsed_ns = INTENT_LIFETIME_NS + 1  # before the first Twist: as after a silence
        if self._last_twist_ns is not None:
            elapsed_ns = now_ns - self._last_twist_ns
        self._last_twist_ns = now_ns
        was_silent = not 0 <= elapsed_ns <= INTENT_LIFETIME_NS
        if self._heading_w_rad is None or was_silent:
            self._heading_w_rad = body_heading_w_rad
        elif body_heading_w_rad is not None:
            lead_rad = (
                self._heading_w_rad + turn_rate_rad_s * elapsed_ns * 1e-9 - body_heading_w_rad
            )
            lead_rad = math.remainder(lead_rad, 2 * math.pi)
            self._heading_w_rad = body_heading_w_rad + min(
                max(lead_rad, -MAX_LEAD_RAD), MAX_LEAD_RAD
            )


def _find_twist_problem(components: tuple[float, ...] | None) -> str:
    """Return what is wrong with the components of a Twist; empty if they are acceptable."""
    if components is None:
        return "is no geometry_msgs/Twist"
    if not all(map(math.isfinite, components)):
        return "has numbers that are not finite"
    if abs(components[0]) > MAX_SPEED_M_S or abs(components[5]) > MAX_TURN_RATE_RAD_S:
        return f"asks for more than {MAX_SPEED_M_S:g} m/s or {MAX_TURN_RATE_RAD_S:g} rad/s"
    return ""
