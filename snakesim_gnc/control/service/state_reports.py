"""Makes the messages of `control/state`: 20 times a second, and at once when the state changes."""

import msgspec

from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.service.advance import RecentAdvance
from snakesim_gnc.control.service.states import determine_locomotion_state
from snakesim_hal.controller import Telemetry
from snakesim_hal.wire.messages import (
    Clock,
    ControlState,
    LocomotionState,
    RobotDescription,
    WorldModel,
)
from snakesim_hal.wire.outgoing import describe_invalid_field

TELEMETRY_PERIOD_S = 0.05  # period of the messages while the state does not change
MAX_REASON_LENGTH = 500  # characters, as the wire allows
# Characters of a controller's name on the wire; the end of a path identifies it better than its beginning.
MAX_NAME_LENGTH = 64


class StateReports:
    """Makes a message of control's state when one is due."""

    def __init__(self, controller: str, robot: RobotDescription) -> None:
        """Prepare the reports about a controller that control publishes, before the first one is due.

        Args:
            controller: Name of the controller as configured.
            robot: Description of the robot.
        """
        # Why the controller misses its deadlines; it is in every message from then on.
        self.too_slow_reason = ""
        self._controller = controller[-MAX_NAME_LENGTH:]
        self._joint_names = [joint.name for joint in robot.joints]

        # What world models measured.
        self._recent_advance = RecentAdvance()
        self._measured_contacts = MeasuredContacts()

        # The last message.
        self._last_published_fields: tuple[object, ...] = ()
        self._next_message_due_ns = 0  # robot time at which the next message is due

        self._decoder = msgspec.msgpack.Decoder(ControlState)

    def add_world(self, world: WorldModel) -> None:
        """Add the position of the body and its contact forces from a world model that is fresh."""
        self._measured_contacts.add_world(world)
        if world.center_w is not None:
            self._recent_advance.add_center(world.timestamp_ns * 1e-9, world.center_w)

    def make_state(
        self,
        clock: Clock,
        telemetry: Telemetry | None = None,
        *,
        silence_reason: str = "",
        pause_reason: str = "",
        is_armed: bool = False,
        missing_inputs: str = "",
        rest_reason: str = "",
    ) -> ControlState | None:
        """Return the message about the state of control at this tick if one is due.

        Args:
            clock: The last clock.
            telemetry: The controller's telemetry; None if the controller was not called.
            silence_reason: Why neither clock nor status arrives; empty while one of them arrives.
            pause_reason: Why no clock arrives although the status does; empty while the clock arrives. If
                `silence_reason` or `pause_reason` is set, the message is always due, because robot time does not
                advance.
            is_armed: Whether the robot is armed.
            missing_inputs: Inputs that control does not have, such as a fresh pose; empty if it has all.
            rest_reason: Why no motion is intended; empty if motion is intended.

        Returns:
            The message, or None if nothing important has changed and the last message is more recent than
            TELEMETRY_PERIOD_S.

        Raises:
            ValueError: The telemetry contains an invalid value.
        """
        if telemetry is None:
            telemetry = Telemetry()
        state, reason = determine_locomotion_state(
            silence_reason=silence_reason,
            is_armed=is_armed,
            missing_inputs=missing_inputs or pause_reason,
            rest_reason=rest_reason,
            usable_push_points=telemetry.usable_push_points,
            obstruction_reason=telemetry.reason,
            standstill_reason=telemetry.reason_if_stationary,
            recent_displacement_m=self._recent_advance.distance_m,
        )
        # A change of any of these is published at once.
        published_fields = (
            state,
            bool(missing_inputs),
            rest_reason,
            telemetry.propulsion_joint,
            telemetry.jammed,
            clock.lifecycle,
            clock.arm_session,
            bool(self.too_slow_reason),
        )
        time_advances = not (silence_reason or pause_reason)
        if (
            time_advances
            and published_fields == self._last_published_fields
            and clock.timestamp_ns < self._next_message_due_ns
        ):
            return None
        self._last_published_fields = published_fields
        self._next_message_due_ns = clock.timestamp_ns + round(TELEMETRY_PERIOD_S * 1e9)
        return self._make_control_state(clock, state, reason, telemetry)

    def make_failure_state(self, clock: Clock, failure_reason: str) -> ControlState:
        """Return the state of a controller that has failed, which is its last message."""
        message = self._make_control_state(clock, "NotLocomoting", failure_reason, Telemetry())
        return msgspec.structs.replace(message, failed=True)

    def _make_control_state(
        self, clock: Clock, state: LocomotionState, reason: str, telemetry: Telemetry
    ) -> ControlState:
        """Return the state of control as a message that every receiver accepts.

        Args:
            clock: The current tick.
            state: Whether the robot is moving, idle, or not moving although it should.
            reason: Why the robot is in that state; only the first MAX_REASON_LENGTH characters are sent.
            telemetry: Telemetry of the controller, such as its push-points and forces. A plug-in may have put a value
                of a wrong type into any field.

        Raises:
            ValueError: A value of the telemetry is invalid; the error names the field.
        """
        joint_name = None
        if telemetry.propulsion_joint is not None:
            joint_name = self._joint_names[telemetry.propulsion_joint]
        obstacles = [point.obstacle for point in telemetry.push_points]
        message = ControlState(
            tick=clock.tick,
            timestamp_ns=clock.timestamp_ns,
            controller=self._controller,
            state=state,
            reason=reason[:MAX_REASON_LENGTH],
            path_s_m=telemetry.path_s_m,
            propulsion_joint=joint_name,
            propulsion_n=telemetry.propulsion_n,
            push_points=telemetry.push_points,  # pyright: ignore[reportArgumentType] - any sequence can be sent
            desired_force_n=telemetry.desired_force_n,  # pyright: ignore[reportArgumentType]
            measured_force_n=self._measured_contacts.compute_mean_magnitudes_n(obstacles),
            propulsion_torque_nm=telemetry.propulsion_torque_nm,
            bending_torque_nm=telemetry.bending_torque_nm,  # pyright: ignore[reportArgumentType]
            reference_rad=telemetry.reference_rad,  # pyright: ignore[reportArgumentType]
            condition=telemetry.condition,
            torque_headroom_nm=telemetry.torque_headroom_nm,
            saturated=telemetry.saturated,
            jammed=telemetry.jammed,
            custom=dict(telemetry.custom),
            too_slow=self.too_slow_reason,
        )
        try:
            # Encoded and decoded, because a Struct checks its fields only when it is decoded.
            return self._decoder.decode(msgspec.msgpack.encode(message))
        except (TypeError, msgspec.ValidationError) as error:
            raise ValueError(describe_invalid_field(message, "Telemetry") or str(error)) from None
