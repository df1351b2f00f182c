"""A client and a host in one process, connected by real Zenoh: ticks, leases, stops, and unauthorized clients."""

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


def are_passive(setpoints: SafeSetpoints) -> bool:
    return set(setpoints.mode) == {JointMode.PASSIVE}


# --- lockstep --------------------------------------------------------------------------------------------------


def run_in_lockstep(amplitude_rad: float, ticks: int) -> tuple[str, dict[str, Any]]:
    """Follow a sine in lockstep and check that every tick is answered once and in order.

    Returns:
        The digest of the commands, and the columns of the black box.
    """
    with (
        running_host(make_run_config(), max_ticks=ticks) as run,
        running_follower(run.link, SineFollower(amplitude_rad)) as control,
    ):
        run.arm()
        wait_until(run.has_ended, "the end of the run")
        statistics = run.host.statistics
        box = run.host.black_box
        assert statistics.ticks == ticks
        assert statistics.answered_ticks == ticks
        assert box.row_count == ticks
        assert run.backend.advanced == ticks
        assert control.armed_ticks == list(range(ticks)) or control.armed_ticks == list(
            range(1, ticks)
        )
        assert set(itertools.pairwise(control.ticks_seen)) <= {(0, 0)} | {
            (t, t + 1) for t in range(ticks)
        }
        assert not run.host.authority.faults
        assert not run.host.authority.rejected_counts
        assert run.host.authority.state == "disarmed"
        assert are_passive(run.backend.enacted[-1])
        return box.command_digest, box.layout.decode_rows(box.read_rows(0)[1])


def test_lockstep_run_answers_every_tick_and_is_reproducible() -> None:
    digest, columns = run_in_lockstep(0.2, 150)
    repeated_digest, _ = run_in_lockstep(0.2, 150)
    other_digest, _ = run_in_lockstep(0.21, 150)
    assert repeated_digest == digest
    assert other_digest != digest
    assert columns["time_s"] == pytest.approx(0.01 * np.arange(150))
    requested_rad = 0.2 * np.sin(2 * np.pi * columns["time_s"])
    target_rad = columns["target"][:, 0]
    angle_rad = columns["angle_rad"][:, 0]
    # The host applies the answer to a tick in that tick.
    assert np.abs(target_rad[1:] - requested_rad[1:]).max() < 1e-9
    # The backend moves each joint half of the way to its target.
    assert np.diff(angle_rad) == pytest.approx(0.5 * (target_rad[:-1] - angle_rad[:-1]))


def test_lockstep_host_waits_for_slow_participant() -> None:
    """Guidance must answer tick t by the end of tick t + latency - 1, and the host does not continue without it."""
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
        newest_guidance_tick: dict[int, int] = {}
        clocks = iter(client.iterate_ticks(silence_timeout_s=0.05))
        client.report_done(next(clock.tick for clock in clocks if clock is not None))
        run.arm()
        due_tick = 5
        for clock in clocks:
            if clock is not None:
                newest_guidance_tick[clock.tick] = clock.newest["guidance"]
                if clock.tick == due_tick + 4:  # the last moment for the answer
                    assert run.host.black_box.row_count <= due_tick + 4
                    client.report_done(due_tick)
                    due_tick += 5
            if run.has_ended():
                break
        assert run.host.black_box.row_count == 40
        assert not run.host.authority.faults
        for tick, guidance_tick in newest_guidance_tick.items():
            assert guidance_tick == max(tick - 5, 0) // 5 * 5


def test_client_that_stalls_loses_lease_and_damps_joints() -> None:
    config = make_run_config(stall_limit_s=0.2)
    with running_commanded_host(config, 20, end_after_fault_s=0.1) as (run, control):
        control.silent.set()
        wait_until(run.has_ended, "the end of the run")

        stalled, expired = run.host.authority.faults
        assert stalled.what == "service_stalled"
        assert "control is" in stalled.cause
        assert expired.what == "lease_expired"
        assert expired.cause.startswith("lease of control expired")
        lease_ticks = 5  # one term of 50 ms in the robot's time
        assert abs(expired.tick - stalled.tick - lease_ticks) <= 1
        assert run.host.authority.state == "fault"
        for setpoints in run.backend.enacted[-3:]:
            assert setpoints.mode == [JointMode.VELOCITY] * 3
            assert setpoints.target == [0.0] * 3


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


def test_estop_by_any_client_lasts_until_reset_and_arming() -> None:
    with running_commanded_host(make_run_config(clock_mode="realtime")) as (run, _):
        answer = run.request(keys.ESTOP, EstopRequest(requester="passer-by"))
        assert answer.ok
        assert answer.lifecycle == "estop"

        ticks_before = len(run.backend.enacted)
        wait_until(lambda: len(run.backend.enacted) > ticks_before + 5, "five ticks more")
        assert all(are_passive(setpoints) for setpoints in run.backend.enacted[ticks_before + 1 :])
        assert "passer-by" in run.status.reason
        assert run.status.faults[-1].what == "estop"

        assert "must be disarmed" in run.request_lifecycle("arm").reason
        assert run.request_lifecycle("reset").lifecycle == "disarmed"
        run.arm()

        assert run.request_lifecycle("finish").ok
        wait_until(run.has_ended, "the end of the run")
        assert are_passive(run.backend.enacted[-1])


def test_lease_second_holder_needs_higher_priority() -> None:
    with (
        running_host(make_run_config(clock_mode="realtime")) as run,
        running_follower(run.link, SineFollower()) as control,
    ):
        run.arm()

        # A client with the priority of the holder is refused, and the robot follows the holder.
        request = LeaseRequest(action="acquire", holder="teleop")
        answer = run.request(keys.LEASE, request)
        assert not answer.ok
        assert answer.reason.startswith("held by control (epoch ")
        assert "priority 100" in answer.reason
        epoch_of_control = answer.epoch
        assert answer.lifecycle == "armed"
        assert answer.host == run.host.description.host
        wait_until(lambda: len(control.armed_ticks) > 5, "the robot continues to follow control")

        # A client with a higher priority gets the lease, which disarms the robot.
        request = LeaseRequest(action="acquire", holder="teleop", priority=200)
        answer = run.request(keys.LEASE, request)
        assert answer.ok
        assert answer.lifecycle == "disarmed"

        # The old holder does not know yet that it has lost the lease. Its commands move nothing.
        ticks_before = len(run.backend.enacted)
        late_command = make_joint_command(
            run.host.description, 0.2, lease_epoch=epoch_of_control, sequence=10**6
        )
        publisher = run.session.declare_publisher(keys.JOINT_COMMAND, JointCommand, lossless=True)
        publisher.put(late_command)
        rejected = run.host.authority.rejected_counts
        wait_until(
            lambda: rejected["wrong_epoch"] + rejected["no_lease"] > 0,
            "the host rejects the old holder's command",
        )
        wait_until(lambda: len(run.backend.enacted) > ticks_before + 3, "three ticks")
        assert all(are_passive(setpoints) for setpoints in run.backend.enacted[ticks_before + 1 :])


def test_host_without_its_control_service_refuses_to_arm() -> None:
    config = make_run_config(services={"control": {}})  # the services that must be connected
    with running_host(config) as run:
        assert run.status.waiting_for == ["control"]
        assert "waiting for control" in run.status.reason
        answer = run.request_lifecycle("arm")
        assert not answer.ok
        assert answer.reason == "waiting for control"


def test_lockstep_host_repeats_tick_0_until_it_is_armed() -> None:
    config = make_run_config(clock_mode="lockstep")
    with running_host(config) as run, running_follower(run.link, SineFollower()) as control:
        wait_until(lambda: len(control.ticks_seen) >= 3, "tick 0 published three times")
        assert set(control.ticks_seen) == {0}
        assert run.status.tick == 0
        assert run.backend.advanced == 0, "the backend has moved the robot"
        assert not run.backend.enacted, "the backend has received setpoints"
        assert run.host.black_box.row_count == 0, "the host has recorded a tick"
        run.arm()


def test_host_reports_fault_when_control_leaves_armed_robot() -> None:
    config = make_run_config(services={"control": {}})
    with running_host(config) as run:
        with running_follower(run.link, SineFollower()):
            wait_until(lambda: run.status.alive == ["control"], "control is connected")
            run.arm()
        # The follower has closed its session, which the host notices a little later.
        faults = run.host.authority.faults
        wait_until(lambda: "service_lost" in {fault.what for fault in faults}, "control is lost")


# --- unauthorized clients -------------------------------------------------------------------------------------


def test_host_counts_invalid_messages_and_continues() -> None:
    invalid_payloads = [b"", b"\xff" * 50, b"\x91" * 100_000, encode(make_description())]
    unknown_encodings = [
        "zenoh/bytes",
        ENCODING_PREFIX + "Gone/1",
        ENCODING_PREFIX + "JointCommand/9",
        ENCODING_PREFIX + "Done/9",
    ]
    known_encodings = [
        format_encoding(JointCommand),
        format_encoding(TickDone),
        format_encoding(LeaseRequest),
        format_encoding(EstopRequest),
    ]
    sample_keys = [
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
        # An unauthorized client does not use SnakeSIM's session, which would check what it sends.
        put = run.session._zenoh.put
        get = run.session._zenoh.get
        for key, payload, encoding in itertools.product(
            sample_keys, invalid_payloads, known_encodings + unknown_encodings
        ):
            put(key, payload, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK)
        rejected = run.host.authority.rejected_counts
        samples_by_key = len(invalid_payloads) * len(known_encodings + unknown_encodings)
        # `**` reaches the host twice, by its two subscriptions.
        sample_count = (len(sample_keys) + 1) * samples_by_key
        assert sample_count == 7 * 32
        wait_until(lambda: sum(rejected.values()) >= sample_count, "the host counts every sample")
        assert set(rejected) == {"malformed", "unknown_message", "unknown_version"}
        query_encodings = known_encodings[2:] + unknown_encodings[:2]
        for key in (keys.LEASE, keys.LIFECYCLE, keys.ESTOP):
            for payload, encoding in itertools.product(invalid_payloads, query_encodings):
                (reply,) = get(key, payload=payload, encoding=encoding, timeout=5.0)
                assert reply.ok is not None
                answer = MessageDecoder(Answer).decode(
                    reply.ok.payload.to_bytes(), str(reply.ok.encoding)
                )
                assert not answer.ok
                assert answer.lifecycle == "armed"
        for pattern in ("hal/*", "**"):  # as a tool queries that lists what is on the network
            assert all(reply.ok is not None for reply in get(pattern, timeout=1.0))
        ticks_before = len(control.armed_ticks)
        wait_until(
            lambda: len(control.armed_ticks) > ticks_before + 5,
            "the robot continues to follow control",
        )
        assert run.host.authority.state == "armed"
        assert not run.host.authority.faults
        wait_until(
            lambda: run.status.commands_rejected == dict(rejected), "the counts in the status"
        )


NO_TICK = -1  # tick that a service has answered before its first answer


def deliver_command(host: Host, lease_epoch: int) -> None:
    """Deliver an encoded command for tick 0 to a host, as its inbox does."""
    command = make_joint_command(host.description, 0.1, lease_epoch=lease_epoch)
    arrival = ReceivedSample(
        keys.JOINT_COMMAND, encode(command), format_encoding(JointCommand), time.monotonic_ns()
    )
    CommandArrival(arrival, MessageDecoder(JointCommand)).deliver(host)


def test_host_ignores_commands_with_wrong_lease_epoch() -> None:
    """In lockstep a tick ends when the holder has answered; a rejected command of another client is no answer."""
    with connected_sessions("worm") as (session,):
        host = Host(make_run_config(), GuardedBackend(LagBackend(make_run_config())), session)
        control = host.participants["control"]
        joints = make_joint_state(host.description)
        host.authority.observe_joints(joints, joints.timestamp_ns)
        host.authority.handle_lease_request(LeaseRequest(action="acquire", holder="control"), 0)
        holder_epoch = host.authority.lease.epoch

        epoch_without_lease = 0
        deliver_command(host, epoch_without_lease)
        assert control.done_tick == NO_TICK, "a client without a lease has ended the tick"

        later_epoch = holder_epoch + 6
        deliver_command(host, later_epoch)
        assert control.done_tick == NO_TICK, "a client with a wrong epoch has ended the tick"
        assert host.authority.rejected_counts["wrong_epoch"] == 2

        deliver_command(host, holder_epoch)
        assert control.done_tick == 0, "the holder has answered tick 0"
        assert host.authority.rejected_counts["wrong_epoch"] == 2, "the holder was rejected"


def test_host_flooded_with_commands_obeys_estop() -> None:
    max_waiting_samples = LIMITS[SAMPLES] or 0
    config = make_run_config(clock_mode="realtime")
    with connected_sessions("worm", "worm") as (host_session, client_session):
        host = Host(config, GuardedBackend(LagBackend(config)), host_session)
        publisher = client_session.declare_publisher(
            keys.JOINT_COMMAND, JointCommand, lossless=True
        )

        # 500 commands more than fit into the inbox. A few may still be under way when it is full.
        for sequence in range(max_waiting_samples + 500):
            publisher.put(make_joint_command(host.description, sequence=sequence))
        wait_until(lambda: host._inbox.dropped >= 400, "a full inbox")

        answers: list[Any] = []
        request = EstopRequest(requester="a person")
        estop_thread = threading.Thread(
            target=lambda: answers.append(client_session.send_request(keys.ESTOP, request, 10.0))
        )
        estop_thread.start()
        wait_until(lambda: host._inbox.waiting() > max_waiting_samples, "the estop in the inbox")

        # The host starts with the full inbox, and must not handle the commands first.
        host_thread = threading.Thread(target=host.run)
        host_thread.start()
        estop_thread.join(15.0)
        host.request_stop()
        host_thread.join(15.0)

        assert answers[0].ok
        assert answers[0].lifecycle == "estop"
        assert host.request_log[0].startswith("tick 0: estop by 'a person', done")


# --- realtime and free -----------------------------------------------------------------------------------------


def test_realtime_host_keeps_its_rate_on_average() -> None:
    """The host runs and answers the periods that fit into the time. How many are late depends on the computer."""
    config = make_run_config(clock_mode="realtime", rate_hz=50.0)
    with running_host(config, max_ticks=50) as run, running_follower(run.link, SineFollower()):
        run.arm()
        wait_until(run.has_ended, "the end of the run")
        assert run.host.armed_wall_time_s == pytest.approx(1.0, rel=0.1)
        assert not run.host.authority.faults
        statistics = run.host.statistics
        assert statistics.answered_ticks + statistics.overruns >= 0.7 * statistics.ticks
        latency = statistics.state_to_command
        median_us = latency.percentile_us(50)
        assert latency.count >= statistics.answered_ticks  # late answers count, too
        assert statistics.answered_ticks > 0
        assert median_us is not None
        assert 0 < median_us < 20_000


def test_host_with_slow_backend_names_it_and_a_possible_rate() -> None:
    """The warning also appears while the robot is disarmed: old samples may be what prevents arming."""
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


def test_host_in_free_mode_runs_without_services() -> None:
    with running_host(make_run_config(clock_mode="free")) as run:
        wait_until(lambda: run.backend.advanced > 200, "two hundred ticks without a service")
        assert run.host.authority.state == "disarmed"
        assert all(are_passive(setpoints) for setpoints in run.backend.enacted)


# --- late readers ------------------------------------------------------------------------------------------


def test_client_that_joins_late_receives_description_commands_and_poses() -> None:
    with running_commanded_host(make_run_config()) as (run, _), open_session(run.link) as late:
        descriptions = late.declare_latched_reader(keys.DESCRIPTION, RobotDescription)
        assert wait_for_messages(descriptions, "the description") == [run.host.description]
        applied = late.declare_reader(keys.APPLIED, AppliedCommand)
        poses = late.declare_reader(keys.POSE, Pose)
        for command in wait_for_messages(applied, "applied commands", 4):
            assert command.sequence is not None
            assert command.mode == [JointMode.POSITION] * 3
        for pose in wait_for_messages(poses, "a pose"):
            assert pose.tick % 5 == 0
