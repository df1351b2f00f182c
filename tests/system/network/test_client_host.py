"""A client and a host, in one process but over real Zenoh: ticks, leases, stops, and strangers on the network."""

import itertools
import threading
import time
from typing import Any

import numpy as np
import pytest
import zenoh

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host
from snakesim_hal.host.inbox import LIMITS, SAMPLES, CommandArrival
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.session import open_session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import ENCODING_PREFIX, MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import (
    Answer,
    AppliedCommand,
    EstopRequest,
    JointCommand,
    JointMode,
    LeaseRequest,
    Pose,
    RobotDescription,
    TickDone,
)
from snakesim_testing.hal.local_network import (
    LagBackend,
    SineFollower,
    connected_sessions,
    running_commanded_host,
    running_follower,
    running_host,
    wait_for_messages,
)
from snakesim_testing.hal.small_robots import (
    make_description,
    make_joint_command,
    make_joint_state,
    make_run_config,
)
from snakesim_testing.harness.wait import wait_until

# A follower that a busy computer delays loses its lease, and does not command again.
pytestmark = [pytest.mark.usefixtures("quick_threads"), pytest.mark.quiet]


def passive(points: SafeSetpoints) -> bool:
    return set(points.mode) == {JointMode.PASSIVE}


# --- lockstep --------------------------------------------------------------------------------------------------


def lockstep_run(amplitude_rad: float, ticks: int) -> tuple[str, dict[str, Any]]:
    with (
        running_host(make_run_config(), max_ticks=ticks) as run,
        running_follower(run.link, SineFollower(amplitude_rad)) as control,
    ):
        run.arm()
        wait_until(run.has_ended, "the end of the run")
        statistics, box = run.host.statistics, run.host.black_box
        assert (
            statistics.ticks,
            statistics.answered_ticks,
            box.row_count,
            run.backend.advanced,
        ) == (ticks,) * 4
        assert control.armed_ticks == list(range(ticks)) or control.armed_ticks == list(
            range(1, ticks)
        )
        assert set(itertools.pairwise(control.ticks_seen)) <= {(0, 0)} | {
            (t, t + 1) for t in range(ticks)
        }
        assert not run.host.authority.faults
        assert not run.host.authority.rejected_counts
        assert run.host.authority.state == "disarmed"
        assert passive(run.backend.enacted[-1])
        return box.command_digest, box.layout.decode_rows(box.read_rows(0)[1])


def test_lockstep_answers_every_tick_and_repeats_itself() -> None:
    first, columns = lockstep_run(0.2, 150)
    again, _ = lockstep_run(0.2, 150)
    other, _ = lockstep_run(0.21, 150)
    assert first == again != other
    assert columns["time_s"] == pytest.approx(0.01 * np.arange(150))
    asked = 0.2 * np.sin(2 * np.pi * columns["time_s"])
    # The answer to a tick counts in that tick.
    assert np.abs(columns["target"][1:, 0] - asked[1:]).max() < 1e-9
    followed = columns["angle_rad"][1:, 0] - columns["angle_rad"][:-1, 0]
    assert followed == pytest.approx(
        0.5 * (columns["target"][:-1, 0] - columns["angle_rad"][:-1, 0])
    )


def test_a_slow_participant_is_waited_for() -> None:
    """Guidance owes tick t only at the end of tick t + lag - 1, and no tick passes without it."""
    config = make_run_config(
        services={"control": {}, "guidance": {"decimation": 5, "latency_ticks": 5}}
    )
    with (
        running_host(config, max_ticks=40) as run,
        running_follower(run.link, SineFollower()),
        open_session(run.link) as session,
    ):
        client = HostClient(session, "guidance")
        client.wait_for_description()
        client.announce()
        newest: dict[int, int] = {}
        wait = iter(client.iterate_ticks(silence_timeout_s=0.05))
        client.report_done(next(clock.tick for clock in wait if clock is not None))
        run.arm()
        due = 5
        for clock in wait:
            if clock is not None:
                newest[clock.tick] = clock.newest["guidance"]
                if clock.tick == due + 4:  # at the last moment
                    assert run.host.black_box.row_count <= due + 4
                    client.report_done(due)
                    due += 5
            if run.has_ended():
                break
        assert run.host.black_box.row_count == 40
        assert not run.host.authority.faults
        assert all(counted == max(tick - 5, 0) // 5 * 5 for tick, counted in newest.items())


def test_client_that_stalls_loses_lease_and_joints_are_damped() -> None:
    config = make_run_config(stall_limit_s=0.2)
    with running_commanded_host(config, 20, end_after_fault_s=0.1) as (run, control):
        control.silent.set()
        wait_until(run.has_ended, "the end of the run")
        stalled, expired = run.host.authority.faults
        assert stalled.what == "service_stalled"
        assert "control is" in stalled.cause
        assert expired.what == "lease_expired"
        assert expired.cause.startswith("lease of control expired")
        assert expired.tick - stalled.tick in (4, 5, 6)  # one term of 50 ms in the robot's time
        assert run.host.authority.state == "fault"
        after = run.backend.enacted[-3:]
        assert all(p.mode == [JointMode.VELOCITY] * 3 and p.target == [0.0] * 3 for p in after)


def test_client_that_leaves_is_named_and_robot_arms_again() -> None:
    with running_host(make_run_config()) as run:
        with running_follower(run.link, SineFollower()) as control:
            run.arm()
            wait_until(lambda: len(control.armed_ticks) > 5, "five ticks")
        run.wait_for_lifecycle("fault")
        faults = {fault.what: fault.cause for fault in run.status.faults}
        assert "control is gone" in faults["service_lost"]
        assert "lease of control" in faults["lease_expired"]
        assert not run.request_lifecycle("arm").ok
        assert run.request_lifecycle("reset").ok
        with running_follower(run.link, SineFollower()) as control:
            run.arm()
            wait_until(lambda: len(control.armed_ticks) > 5, "five more ticks")
            assert run.status.lifecycle == "armed"
            assert not run.status.faults


# --- stops and refusals ----------------------------------------------------------------------------------------


def test_client_estop_by_anyone_lasts_until_reset_and_arming() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime")) as (run, _):
        answer = run.request(keys.ESTOP, EstopRequest(requester="passer-by"))
        assert answer.ok
        assert answer.lifecycle == "estop"
        at = len(run.backend.enacted)
        wait_until(lambda: len(run.backend.enacted) > at + 5, "five ticks more")
        assert all(passive(points) for points in run.backend.enacted[at + 1 :])
        assert "passer-by" in run.status.reason
        assert run.status.faults[-1].what == "estop"
        assert "must be disarmed" in run.request_lifecycle("arm").reason
        assert run.request_lifecycle("reset").lifecycle == "disarmed"
        run.arm()
        assert run.request_lifecycle("finish").ok
        wait_until(run.has_ended, "the end of the run")
        assert passive(run.backend.enacted[-1])


def test_client_second_holder_needs_higher_priority() -> None:
    with (
        running_host(make_run_config(clock_mode="realtime")) as run,
        running_follower(run.link, SineFollower()) as control,
    ):
        run.arm()
        request = LeaseRequest(action="acquire", holder="teleop")
        answer = run.request(keys.LEASE, request)
        assert not answer.ok
        assert answer.reason.startswith("held by control (epoch ")
        assert "priority 100" in answer.reason
        held = answer.epoch
        assert answer.lifecycle == "armed"
        assert answer.host == run.host.description.host
        wait_until(lambda: len(control.armed_ticks) > 5, "the robot going on undisturbed")
        answer = run.request(
            keys.LEASE, LeaseRequest(action="acquire", holder="teleop", priority=200)
        )
        assert answer.ok
        assert answer.lifecycle == "disarmed"
        at = len(run.backend.enacted)
        # The old holder has not heard yet.
        late = make_joint_command(run.host.description, 0.2, lease_epoch=held, sequence=10**6)
        run.session.declare_publisher(keys.JOINT_COMMAND, JointCommand, lossless=True).put(late)
        refused = run.host.authority.rejected_counts
        wait_until(
            lambda: refused["wrong_epoch"] + refused["no_lease"] > 0,
            "the old holder's command refused",
        )
        wait_until(lambda: len(run.backend.enacted) > at + 3, "three ticks")
        assert all(passive(points) for points in run.backend.enacted[at + 1 :])


def test_arming_waits_for_all_services_with_time_paused() -> None:
    with running_host(make_run_config()) as run:
        assert run.status.waiting_for == ["control"]
        assert "waiting for control" in run.status.reason
        answer = run.request_lifecycle("arm")
        assert not answer.ok
        assert answer.reason == "waiting for control"
        with running_follower(run.link, SineFollower()) as control:
            wait_until(lambda: len(control.ticks_seen) >= 3, "three showings of tick 0")
            assert set(control.ticks_seen) == {0}
            assert run.backend.advanced == 0
            assert not run.backend.enacted
            assert run.status.tick == 0
            assert run.host.black_box.row_count == 0
            run.arm()
        assert run.status.alive == ["control"] or run.host.authority.faults


# --- strangers -------------------------------------------------------------------------------------------------


def test_host_counts_and_survives_everything_sent_to_it() -> None:
    garbage = [b"", b"\xff" * 50, b"\x91" * 100_000, encode(make_description())]
    foreign = [
        "zenoh/bytes",
        ENCODING_PREFIX + "Gone/1",
        ENCODING_PREFIX + "JointCommand/9",
        ENCODING_PREFIX + "Done/9",
    ]
    own = [
        format_encoding(JointCommand),
        format_encoding(TickDone),
        format_encoding(LeaseRequest),
        format_encoding(EstopRequest),
    ]
    samples = [
        keys.JOINT_COMMAND,
        keys.done_key("control"),
        keys.done_key("stranger"),
        "actuator/*",
        "hal/done/*",
        "**",
    ]
    with (
        running_host(make_run_config()) as run,
        running_follower(run.link, SineFollower()) as control,
    ):
        run.arm()
        # A stranger does not keep to our session.
        put, get = run.session._zenoh.put, run.session._zenoh.get
        for key, payload, encoding in itertools.product(samples, garbage, own + foreign):
            put(key, payload, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK)
        counted = run.host.authority.rejected_counts
        # `**` reaches the host twice, by its two subscriptions.
        wait_until(lambda: sum(counted.values()) >= 7 * 32, "every sample counted")
        assert set(counted) == {"malformed", "unknown_message", "unknown_version"}
        for key in (keys.LEASE, keys.LIFECYCLE, keys.ESTOP):
            for payload, encoding in itertools.product(garbage, own[2:] + foreign[:2]):
                (reply,) = get(key, payload=payload, encoding=encoding, timeout=5.0)
                assert reply.ok is not None
                answer = MessageDecoder(Answer).decode(
                    reply.ok.payload.to_bytes(), str(reply.ok.encoding)
                )
                assert not answer.ok
                assert answer.lifecycle == "armed"
        for pattern in ("hal/*", "**"):  # a tool that looks what is there
            assert all(reply.ok is not None for reply in get(pattern, timeout=1.0))
        seen = len(control.armed_ticks)
        wait_until(lambda: len(control.armed_ticks) > seen + 5, "the robot going on undisturbed")
        assert run.host.authority.state == "armed"
        assert not run.host.authority.faults
        wait_until(
            lambda: run.status.commands_rejected == dict(counted), "the counts in the status"
        )


def test_host_ignores_commands_and_answers_of_a_stranger() -> None:
    """In lockstep a tick ends when the holder has answered; a refused command of somebody else is no answer."""
    with connected_sessions("worm") as (session,):
        host = Host(make_run_config(), GuardedBackend(LagBackend(make_run_config())), session)
        host.authority.observe_joints(make_joint_state(host.description))
        host.authority.handle_lease_request(LeaseRequest(action="acquire", holder="control"), 0)
        own = host.authority.lease.epoch
        for epoch, done_tick in ((0, -1), (own + 6, -1), (own, 0)):
            sent = make_joint_command(host.description, 0.1, lease_epoch=epoch)
            arrival = ReceivedSample(
                keys.JOINT_COMMAND, encode(sent), format_encoding(JointCommand), time.monotonic_ns()
            )
            host._inbox.handle(CommandArrival(arrival, MessageDecoder(JointCommand)))
            assert host.participants["control"].done_tick == done_tick
        assert host.authority.rejected_counts["wrong_epoch"] == 2


def test_a_flood_of_commands_does_not_keep_an_estop_out() -> None:
    limit = LIMITS[SAMPLES] or 0
    config = make_run_config(clock_mode="realtime")
    with connected_sessions("worm", "worm") as (own, stranger):
        host = Host(config, GuardedBackend(LagBackend(config)), own)
        publisher = stranger.declare_publisher(keys.JOINT_COMMAND, JointCommand, lossless=True)
        for sequence in range(limit + 500):
            publisher.put(make_joint_command(host.description, sequence=sequence))
        wait_until(lambda: host._inbox.dropped >= 400, "a full inbox")
        answers: list[Any] = []
        request = EstopRequest(requester="a person")
        asking = threading.Thread(
            target=lambda: answers.append(stranger.send_request(keys.ESTOP, request, 10.0))
        )
        asking.start()
        wait_until(lambda: host._inbox.waiting() > limit, "the estop in the inbox")
        thread = threading.Thread(target=host.run)
        thread.start()
        asking.join(15.0)
        host.request_stop()
        thread.join(15.0)
        assert answers[0].ok
        assert answers[0].lifecycle == "estop"
        assert host.request_log[0].startswith("tick 0: estop by 'a person', done")


# --- realtime and free -----------------------------------------------------------------------------------------


def test_realtime_keeps_its_deadlines_on_average() -> None:
    """As many periods pass as there is time for, and are answered; how many are late is for the computer to say."""
    config = make_run_config(clock_mode="realtime", rate_hz=50.0)
    with running_host(config, max_ticks=50) as run, running_follower(run.link, SineFollower()):
        run.arm()
        wait_until(run.has_ended, "the end of the run")
        assert run.host.armed_wall_time_s == pytest.approx(1.0, rel=0.1)
        assert not run.host.authority.faults
        found = run.host.statistics
        assert found.answered_ticks + found.overruns >= 0.7 * found.ticks
        latency = found.state_to_command
        median_us = latency.percentile_us(50)
        assert latency.count >= found.answered_ticks > 0  # late answers count, too
        assert median_us is not None
        assert 0 < median_us < 20_000


def test_host_names_backend_too_slow_and_a_rate_that_holds() -> None:
    """Also where nothing is armed: arming may be what its old samples prevent."""
    with running_host(make_run_config(clock_mode="realtime", rate_hz=50.0)) as run:
        run.backend.read_s = 0.03
        slow = "backend 'lag' takes 3"
        wait_until(
            lambda: any(slow in warning for warning in run.status.realtime_warnings), "a warning"
        )
        assert "ms to read" in run.status.reason
        assert "of a tick of 20 ms; it would hold 2" in run.status.reason
        run.backend.read_s = 0.0
        wait_until(lambda: not run.status.realtime_warnings, "no warning")


def test_free_waits_for_nobody() -> None:
    with running_host(make_run_config(clock_mode="free")) as run:
        wait_until(lambda: run.backend.advanced > 200, "two hundred ticks without anybody")
        assert run.host.authority.state == "disarmed"
        assert all(passive(points) for points in run.backend.enacted)


# --- what readers see ------------------------------------------------------------------------------------------


def test_client_that_joins_late_receives_description_status_and_setpoints() -> None:
    with running_commanded_host(make_run_config()) as (run, _), open_session(run.link) as late:
        descriptions = late.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        assert wait_for_messages(descriptions, "the description") == [run.host.description]
        applied, poses = (
            late.declare_reader(keys.APPLIED, AppliedCommand),
            late.declare_reader(keys.POSE, Pose),
        )
        commands = wait_for_messages(applied, "applied commands", 4)
        assert all(c.sequence is not None and c.mode == [JointMode.POSITION] * 3 for c in commands)
        assert all(pose.tick % 5 == 0 for pose in wait_for_messages(poses, "a pose"))
