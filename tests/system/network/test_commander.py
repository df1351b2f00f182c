"""The parts of a client: the feed that finds samples by their tick, and the commander that holds the lease."""

import threading

import pytest

from snakesim_hal.base.errors import StalledError
from snakesim_hal.network.client import Commander, HostClient, SampleFeed
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.network.session import open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, JointState, LeaseRequest
from snakesim_testing.hal.local_network import connected_sessions, running_host
from snakesim_testing.hal.small_robots import (
    make_clock,
    make_description,
    make_joint_state,
    make_run_config,
)
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error


def test_feed_returns_samples_by_tick_and_drops_old_ones() -> None:
    robot = make_description()
    network = LocalNetwork()
    feed = SampleFeed(network.create_session().declare_reader(keys.JOINTS, JointState), keys.JOINTS)
    joints = network.create_session().declare_publisher(keys.JOINTS, JointState)
    assert feed.newest() is None
    assert feed.get_at_tick(0) is None
    for tick in range(100):
        joints.put(make_joint_state(robot, 0.1 * tick, tick=tick))
        feed.store_arrived_samples()
    newest = feed.newest()
    assert newest is not None
    assert newest.tick == 99
    assert feed.get_at_tick(99) is newest
    assert feed.get_at_tick(50) is None
    assert feed.get_at_tick(90) is not None
    joints.put(
        make_joint_state(robot, 0.0, tick=90)
    )  # published again, so that it is the last one to arrive
    feed.store_arrived_samples()
    newest = feed.newest()
    assert newest is not None
    assert newest.tick == 90
    feed.clear()
    assert feed.newest() is None


def make_clock_for_joints(tick: int, joints_tick: int, arm_session: int = 1) -> Clock:
    """Make a clock message which says that the joint state of this tick refers to `joints_tick`."""
    return make_clock(tick, arm_session=arm_session, newest={keys.JOINTS: joints_tick})


def test_client_waits_for_samples_named_by_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = make_description()
    with connected_sessions("worm", "worm") as (hal, session):
        client = HostClient(session, "control")
        feed = client.subscribe(keys.JOINTS, JointState)
        clocks = hal.declare_publisher(keys.CLOCK, Clock, lossless=True)
        joints = hal.declare_publisher(keys.JOINTS, JointState, lossless=True)
        wait_until(
            lambda: clocks.has_subscriber() and joints.has_subscriber(),
            "the client's subscriptions",
        )
        ticks = iter(client.iterate_ticks(silence_timeout_s=5.0))
        for tick in (3, 4):
            joints.put(make_joint_state(robot, tick=tick))
        clocks.put(make_clock_for_joints(5, 3))
        assert client.read(feed) is None  # no clock yet
        assert next(ticks) == make_clock_for_joints(5, 3)
        joint_state = client.read(feed)
        assert joint_state is not None
        assert joint_state.tick == 3  # the sample that the clock names, not the newest one
        clocks.put(make_clock_for_joints(6, 6))
        next(ticks)
        late_sample = threading.Timer(0.03, lambda: joints.put(make_joint_state(robot, tick=6)))
        late_sample.start()
        joint_state = client.read(feed)
        assert joint_state is not None
        assert joint_state.tick == 6
        clocks.put(make_clock_for_joints(7, 7))
        next(ticks)
        # Only now: a busy computer may deliver the late sample above after a shorter time.
        monkeypatch.setattr("snakesim_hal.network.client.MISSING_SAMPLE_TIMEOUT_S", 0.1)
        with raises_error(StalledError, code="network/no-ticks"):
            client.read(feed)
        hal._zenoh.put(keys.CLOCK, b"garbage", encoding="zenoh/bytes")
        clocks.put(
            make_clock_for_joints(0, 0, arm_session=0)
        )  # as from a HAL host that started again
        first_clock = next(ticks)
        assert first_clock is not None
        assert first_clock.tick == 0
        assert client.read(feed) is None
        wait_until(
            lambda: session.rejected == {"unknown_message": 1}, "the client counts the garbage"
        )


def test_commander_acquires_free_lease_and_notices_its_loss() -> None:
    """In lockstep, time stands until the robot is armed, so no lease expires between two steps of the test."""
    with running_host(make_run_config()) as run, open_session(run.link) as session:
        client = HostClient(session, "pilot")
        commander = Commander(client, client.wait_for_description())
        ticks = (clock for clock in client.iterate_ticks() if clock is not None)
        acquire = LeaseRequest(action="acquire", holder="teleop", priority=200)

        answer = run.request(keys.LEASE, acquire)
        assert answer.ok
        assert not commander.ensure_lease(next(ticks))
        assert commander.lease_refusal is not None
        assert "held by teleop" in commander.lease_refusal

        release = LeaseRequest(action="release", holder="teleop", epoch=answer.epoch)
        assert run.request(keys.LEASE, release).ok
        wait_until(lambda: commander.ensure_lease(next(ticks)), "the lease of the commander")
        assert commander.lease_refusal is None
        assert run.host.authority.lease.holder == "pilot"

        assert run.request(keys.LEASE, acquire).ok
        wait_until(
            lambda: not commander.ensure_lease(next(ticks)), "the commander sees that it lost"
        )
