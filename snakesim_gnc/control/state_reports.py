"""Control's state: `control/state` a few times a second, and at once when it changes."""

import msgspec

from snakesim_gnc.control.advance import Advance
from snakesim_gnc.control.contact_forces import MeasuredContacts
from snakesim_gnc.control.controller import Report
from snakesim_gnc.control.states import locomotion_state
from snakesim_hal.wire.messages import Clock, ControlState, Description, LocomotionState, World
from snakesim_hal.wire.outgoing import what_is_wrong

TELEMETRY_S = 0.05
LONGEST = 500  # characters of a reason


class StateReports:
    """Makes the state's message when it is due."""

    def __init__(self, controller: str, robot: Description) -> None:
        self.too_slow = ""  # what shows that the controller misses its deadlines, in every message from then on
        self._controller = controller[-64:]
        self._joints = [joint.name for joint in robot.joints]
        self._advance = Advance()
        self._felt = MeasuredContacts()
        self._decoder = msgspec.msgpack.Decoder(ControlState)
        self._last: tuple[object, ...] = ()
        self._next_ns = 0

    def follow(self, world: World) -> None:
        """Take where the body is, and what it feels, from a world model that is fresh."""
        self._felt.add_world(world)
        if world.center_w is not None:
            self._advance.put(world.timestamp_ns * 1e-9, world.center_w)

    def state(
        self,
        clock: Clock,
        report: Report | None = None,
        *,
        silent: str = "",
        stands: str = "",
        armed: bool = False,
        missing: str = "",
        rests: str = "",
    ) -> ControlState | None:
        """The message, or None when nothing has changed and the last one is recent. See `locomotion_state`.

        silent, stands: why no clock comes; then the message is always due, for its stamp does not age.

        Raises ValueError when the report contains an invalid value.
        """
        report = report or Report()
        state, reason = locomotion_state(
            silent=silent,
            armed=armed,
            missing=missing or stands,
            rests=rests,
            usable_push_points=report.usable_push_points,
            obstacle=report.why,
            still=report.why_if_still,
            advanced_m=self._advance.metres,
        )
        mark = (
            state,
            bool(missing),
            rests,
            report.propulsion_joint,
            report.jammed,
            clock.lifecycle,
            clock.arm_session,
            bool(self.too_slow),
        )
        if not (silent or stands) and mark == self._last and clock.timestamp_ns < self._next_ns:
            return None
        self._last, self._next_ns = mark, clock.timestamp_ns + round(TELEMETRY_S * 1e9)
        return self._message(clock, state, reason, report)

    def failure(self, clock: Clock, why: str) -> ControlState:
        """The last message of a controller that cannot go on."""
        return msgspec.structs.replace(self._message(clock, "NotLocomoting", why, Report()), failed=True)

    def _message(self, clock: Clock, state: LocomotionState, reason: str, report: Report) -> ControlState:
        joint = report.propulsion_joint
        message = ControlState(
            tick=clock.tick,
            timestamp_ns=clock.timestamp_ns,
            controller=self._controller,
            state=state,
            reason=reason[:LONGEST],
            path_s_m=report.path_s_m,
            propulsion_joint=None if joint is None else self._joints[joint],
            propulsion_n=report.propulsion_n,
            push_points=report.push_points,  # pyright: ignore[reportArgumentType] - any sequence can be sent
            desired_force_n=report.desired_force_n,  # pyright: ignore[reportArgumentType]
            measured_force_n=self._felt.mean_sizes_n([point.obstacle for point in report.push_points]),
            propulsion_torque_nm=report.propulsion_torque_nm,
            bending_torque_nm=report.bending_torque_nm,  # pyright: ignore[reportArgumentType]
            reference_rad=report.reference_rad,  # pyright: ignore[reportArgumentType]
            condition=report.condition,
            torque_headroom_nm=report.torque_headroom_nm,
            saturated=report.saturated,
            jammed=report.jammed,
            too_slow=self.too_slow,
        )
        try:
            return self._decoder.decode(msgspec.msgpack.encode(message))
        except (TypeError, msgspec.ValidationError) as error:
            raise ValueError(what_is_wrong(message, "Report") or str(error)) from None
