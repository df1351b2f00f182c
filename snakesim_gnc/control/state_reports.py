"""Makes the messages of `control/state`: 20 times a second, and at once when the state changes."""

import msgspec

from snakesim_gnc.control.advance import RecentAdvance
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.states import locomotion_state
from snakesim_hal.controller import Telemetry
from snakesim_hal.wire.messages import Clock, ControlState, Description, LocomotionState, World
from snakesim_hal.wire.outgoing import find_wrong_value

TELEMETRY_S = 0.05  # period of the messages while the state does not change
MAX_REASON = 500  # characters, as the wire allows
MAX_NAME = (
    64  # characters of a controller's name on the wire; the end of a path identifies it better than its beginning
)


class StateReports:
    """Makes a message of control's state when one is due."""

    def __init__(self, controller: str, robot: Description) -> None:
        """Prepare the reports about a controller that control publishes, before the first one is due.

        Args:
            controller: name of the controller as configured.
            robot: description of the robot.
        """
        self.too_slow = ""  # why the controller misses its deadlines; it is in every message from then on
        self._controller = controller[-MAX_NAME:]
        self._joints = [joint.name for joint in robot.joints]

        # What world models measured.
        self._advance = RecentAdvance()
        self._measured_contacts = MeasuredContacts()

        # The last message.
        self._last_summary: tuple[object, ...] = ()
        self._next_ns = 0  # robot time at which the next message is due

        self._decoder = msgspec.msgpack.Decoder(ControlState)

    def add_world(self, world: World) -> None:
        """Add the position of the body and its contact forces from a world model that is fresh."""
        self._measured_contacts.add_world(world)
        if world.center_w is not None:
            self._advance.add(world.timestamp_ns * 1e-9, world.center_w)

    def make_state(
        self,
        clock: Clock,
        telemetry: Telemetry | None = None,
        *,
        silent: str = "",
        paused: str = "",
        armed: bool = False,
        missing: str = "",
        rests: str = "",
    ) -> ControlState | None:
        """Return the message about the state of control at this tick if one is due.

        Args:
            clock: the last clock.
            telemetry: the controller's telemetry; None if the controller was not called.
            silent: why neither clock nor status arrives; else empty.
            paused: why no clock arrives. If `silent` or `paused` is set, the message is always due, because robot
                time does not advance.
            armed: whether the robot is armed.
            missing: inputs that control does not have, such as a fresh pose; else empty.
            rests: why no motion is intended; empty if motion is intended.

        Returns:
            None if nothing has changed and the last message is recent.

        Raises:
            ValueError: the telemetry contains an invalid value.
        """
        if telemetry is None:
            telemetry = Telemetry()
        state, reason = locomotion_state(
            silence=silent,
            armed=armed,
            missing_inputs=missing or paused,
            rest_reason=rests,
            usable_push_points=telemetry.usable_push_points,
            obstruction=telemetry.reason,
            standstill_reason=telemetry.reason_if_stationary,
            advanced_m=self._advance.distance_m,
        )
        # A change of any of these is published at once.
        summary = (
            state,
            bool(missing),
            rests,
            telemetry.propulsion_joint,
            telemetry.jammed,
            clock.lifecycle,
            clock.arm_session,
            bool(self.too_slow),
        )
        time_advances = not (silent or paused)
        if time_advances and summary == self._last_summary and clock.timestamp_ns < self._next_ns:
            return None
        self._last_summary = summary
        self._next_ns = clock.timestamp_ns + round(TELEMETRY_S * 1e9)
        return self._make_message(clock, state, reason, telemetry)

    def make_failure(self, clock: Clock, why: str) -> ControlState:
        """Return the last message of a controller that has failed."""
        message = self._make_message(clock, "NotLocomoting", why, Telemetry())
        return msgspec.structs.replace(message, failed=True)

    def _make_message(self, clock: Clock, state: LocomotionState, reason: str, telemetry: Telemetry) -> ControlState:
        """Return the state of control as a message that every receiver accepts.

        Args:
            clock: the current tick.
            state: whether the robot is moving, idle, or not moving although it should.
            reason: why it is in that state; it is cut to the maximum length of a message.
            telemetry: what the controller reports about its push; a plug-in may have put any value into it.

        Raises:
            ValueError: a value of the telemetry is invalid; the error names the field.
        """
        joint_name = None
        if telemetry.propulsion_joint is not None:
            joint_name = self._joints[telemetry.propulsion_joint]
        obstacles = [point.obstacle for point in telemetry.push_points]
        message = ControlState(
            tick=clock.tick,
            timestamp_ns=clock.timestamp_ns,
            controller=self._controller,
            state=state,
            reason=reason[:MAX_REASON],
            path_s_m=telemetry.path_s_m,
            propulsion_joint=joint_name,
            propulsion_n=telemetry.propulsion_n,
            push_points=telemetry.push_points,  # pyright: ignore[reportArgumentType] - any sequence can be sent
            desired_force_n=telemetry.desired_force_n,  # pyright: ignore[reportArgumentType]
            measured_force_n=self._measured_contacts.mean_sizes_n(obstacles),
            propulsion_torque_nm=telemetry.propulsion_torque_nm,
            bending_torque_nm=telemetry.bending_torque_nm,  # pyright: ignore[reportArgumentType]
            reference_rad=telemetry.reference_rad,  # pyright: ignore[reportArgumentType]
            condition=telemetry.condition,
            torque_headroom_nm=telemetry.torque_headroom_nm,
            saturated=telemetry.saturated,
            jammed=telemetry.jammed,
            custom=dict(telemetry.custom),
            too_slow=self.too_slow,
        )
        try:
            # Encoded and decoded, because a Struct checks its fields only when it is decoded.
            return self._decoder.decode(msgspec.msgpack.encode(message))
        except (TypeError, msgspec.ValidationError) as error:
            raise ValueError(find_wrong_value(message, "Telemetry") or str(error)) from None
