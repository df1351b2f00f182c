"""The status that a host publishes."""

import time
from collections.abc import Sequence
from typing import NamedTuple

from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.outbox import HostOutbox
from snakesim_hal.host.readiness import ServiceReadiness
from snakesim_hal.network.private_channel import HostEnd, HostMessage
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LifecycleState, RobotStatus

STATUS_PERIOD_NS = 200_000_000
MIN_STATUS_PERIOD_NS = 10_000_000  # for frequent changes, such as a contested lease
LONG_WAIT_NS = 500_000_000  # a tick that waits longer for answers is shown as held up


class _StatusTrigger(NamedTuple):
    """Values whose change makes the host publish its status before the next one is due."""

    lifecycle: LifecycleState
    lease_epoch: int
    fault_count: int
    is_paused: bool
    speed: float


class StatusReporter:
    """Builds the status, and publishes it a few times a second, or at once when the lifecycle changes."""

    def __init__(
        self,
        state: HostState,
        readiness: ServiceReadiness,
        outbox: HostOutbox,
        starter: HostEnd,
        realtime_warnings: Sequence[str],
    ) -> None:
        """Prepare to publish; the first status is published by the first call of `publish`.

        Args:
            state: State of the host.
            readiness: Finds the services that the host waits for.
            outbox: Output that sends the status over the network.
            starter: Channel that sends the status to the process that started this host.
            realtime_warnings: Real-time measures that the operating system refused.
        """
        self._state = state
        self._readiness = readiness
        self._outbox = outbox
        self._starter = starter
        self._realtime_warnings = list(realtime_warnings)
        self._published_trigger: _StatusTrigger | None = None
        self._due_ns = 0  # monotonic

    def publish_if_due(self, *, force: bool = False) -> None:
        """Publish the status if it is due.

        Args:
            force: Whether to publish the status in any case.
        """
        now_ns = time.monotonic_ns()
        trigger = self._make_trigger()
        if not force and not self._is_due(trigger, now_ns):
            return
        self._published_trigger = trigger
        self._due_ns = now_ns + STATUS_PERIOD_NS
        status = self.build_status()
        self._outbox.publish((keys.STATUS, status, None))
        self._starter.send(HostMessage(status=status))

    def build_status(self) -> RobotStatus:
        """Return the present status of the robot."""
        state = self._state
        authority = state.authority
        robot = state.description
        clock = state.clock
        simulated = clock.simulated
        missing = self._readiness.find_missing_services()
        differing = self._readiness.describe_differing_processes()
        refusals = authority.list_unmet_conditions(clock.safety_ns())
        slow_backend = (
            state.backend_time.describe_slowness() if clock.clock_mode == "realtime" else []
        )

        reason = authority.reason
        if authority.state == "disarmed" and (refusals or missing or differing):
            waits = self._readiness.describe_missing(missing)
            reason = "; ".join([reason, *slow_backend, *differing, *waits, *refusals])[:500]

        return RobotStatus(
            # The robot and its time.
            tick=clock.tick,
            timestamp_ns=clock.tick * robot.period_ns,
            robot=robot.robot,
            backend=robot.backend,
            host=robot.host,
            clock_mode=clock.clock_mode,
            rate_hz=1e9 / robot.period_ns,
            paused_by=simulated.paused_by if simulated.is_paused else None,
            speed=simulated.speed,
            real_time_factor=simulated.real_time_factor,
            # The lifecycle.
            lifecycle=authority.state,
            reason=reason,
            ready_to_arm=not refusals and not missing and not differing,
            unchecked=authority.unchecked_reason[:500],
            derated=authority.derated_joints,
            isolated=authority.isolated_joints,
            # Faults.
            faults=authority.faults,
            faults_left_out=authority.faults_since_reset.dropped_count,
            injected=list(state.faults.active),
            # Commands.
            lease_holder=authority.lease.holder,
            lease_epoch=authority.lease.epoch,
            commands_accepted=authority.accepted_count,
            commands_standby=authority.standby_count,
            commands_rejected=dict(authority.rejected_counts),
            commands_limited=dict(authority.limited_counts),
            # Services.
            alive=state.participants.present(),
            waiting_for=missing,
            held_up=self._describe_long_wait()[:500],
            # Timing.
            overruns=state.statistics.overruns,
            tick_times=state.statistics.times.timings(),
            realtime_warnings=[
                *self._realtime_warnings,
                *slow_backend,
                *simulated.describe_slowness(),
            ],
        )

    def _make_trigger(self) -> _StatusTrigger:
        state = self._state
        return _StatusTrigger(
            lifecycle=state.authority.state,
            lease_epoch=state.authority.lease.epoch,
            fault_count=len(state.authority.faults),
            is_paused=state.clock.simulated.is_paused,
            speed=state.clock.simulated.speed,
        )

    def _is_due(self, trigger: _StatusTrigger, now_ns: int) -> bool:
        published = self._published_trigger
        if published is None or trigger.lifecycle != published.lifecycle:
            return True
        if trigger != published:
            return now_ns >= self._due_ns - STATUS_PERIOD_NS + MIN_STATUS_PERIOD_NS
        return now_ns >= self._due_ns

    def _describe_long_wait(self) -> str:
        """Return a text about the services that lockstep has been waiting for, if for long; otherwise an empty text."""
        state = self._state
        if state.waiting_since_ns is None:
            return ""
        waited_ns = time.monotonic_ns() - state.waiting_since_ns
        if waited_ns < LONG_WAIT_NS:
            return ""
        tick = state.clock.tick
        return f"tick {tick} waits for {state.participants.describe_awaited(tick)}, for {waited_ns * 1e-9:.1f} s"
