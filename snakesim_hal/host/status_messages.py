"""Builds the host's status messages. Pure."""

from collections.abc import Mapping, Sequence

from snakesim_hal.host.participants import Participants
from snakesim_hal.host.simulated_time import SimulatedTime
from snakesim_hal.safety.authority import Authority, Decision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, Description, Pace, Status, Timing

WITHOUT = {keys.POSE: "mission.localisation=dead_reckoning does without, and so does a robot without [sensors.pose]"}
"""How a run can do without a message."""


def applied_message(description: Description, tick: int, decision: Decision) -> AppliedCommand:
    """The applied set-points of a tick."""
    points = decision.set_points
    return AppliedCommand(
        tick=tick,
        stamp_ns=tick * description.period_ns,
        sequence=decision.sequence,
        mode=points.mode,
        target=points.target,
        torque_limit_nm=points.torque_limit_nm,
        limited={description.joints[i].name: word for i, word in decision.limited.items()},
    )


def _waiting(service: str, lacks: Sequence[str]) -> str:
    if not lacks:
        return f"waiting for {service}"
    ways_out = "".join(f" ({WITHOUT[key]})" for key in lacks if key in WITHOUT)
    return f"waiting for {service}, which has no {', '.join(lacks)} yet{ways_out}"


def status_message(
    authority: Authority,
    participants: Participants,
    *,
    tick: int,
    pace: Pace,
    time: SimulatedTime,
    missing: list[str],
    waits: Mapping[str, Sequence[str]],
    differing: list[str],
    overruns: int,
    tick_times: dict[str, Timing],
    realtime_warnings: list[str],
    slow_backend: list[str],
    injected: list[str],
    held_up: str,
) -> Status:
    """The status of the robot.

    missing: the services that arming waits for; waits: for which keys they wait; differing: how others are set up;
    slow_backend: that it takes too much of a tick.
    """
    description = authority.description
    against = authority.against_arming(time.safety_ns(tick))
    why = authority.why
    if authority.state == "disarmed" and (against or missing or differing):
        why = "; ".join(
            [why, *slow_backend, *differing, *(_waiting(name, waits.get(name, ())) for name in missing), *against]
        )[:500]
    return Status(
        tick=tick,
        stamp_ns=tick * description.period_ns,
        robot=description.robot,
        backend=description.backend,
        pace=pace,
        rate_hz=1e9 / description.period_ns,
        lifecycle=authority.state,
        why=why,
        lease_holder=authority.lease.holder,
        lease_epoch=authority.lease.epoch,
        commands_accepted=authority.accepted,
        commands_standby=authority.standby,
        commands_rejected=dict(authority.rejected),
        commands_limited=dict(authority.limited),
        faults=authority.faults,
        faults_left_out=authority.since_clear.left_out,
        alive=participants.present(),
        waiting_for=missing,
        overruns=overruns,
        tick_times=tick_times,
        realtime_warnings=[*realtime_warnings, *slow_backend, *time.slow()],
        injected=injected,
        ready_to_arm=not against and not missing and not differing,
        derated=authority.derated,
        isolated=authority.isolated,
        host=description.host,
        paused_by=time.paused_by if time.stands else None,
        speed=time.speed,
        real_time_factor=time.factor,
        held_up=held_up[:500],
        unchecked=authority.unchecked[:500],
    )
