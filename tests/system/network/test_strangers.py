"""What a stranger on the network sends must end no service: each of these once did."""

import time
from typing import Any
from unittest import mock

import msgspec
import pytest
import zenoh

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.network import robot_mismatch
from snakesim_hal.network.client import Commander, HostClient
from snakesim_hal.network.robot_mismatch import find_mismatch
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    Contacts,
    DepthImage,
    Imu,
    JointState,
    LeaseRequest,
    LocomotionIntent,
    Message,
    RobotDescription,
    Trajectory,
    WorldModel,
)
from snakesim_hal.wire.quantities import Quaternion
from snakesim_testing.hal.foreign_samples import CLOCK, ROBOT
from snakesim_testing.hal.local_network import LagBackend, connected_sessions
from snakesim_testing.hal.small_robots import (
    make_joint_state,
    make_link_contact,
    make_pose,
    make_power,
    make_run_config,
)
from snakesim_testing.hal.strategies import make_plain_example
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

X, UPRIGHT = (1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)


def contacts(link: int) -> Contacts:
    return Contacts(tick=0, timestamp_ns=0, contacts=[make_link_contact(link)])


def world(link: int = 0, orientation: tuple[float, float, float, float] = UPRIGHT) -> WorldModel:
    example = make_plain_example(WorldModel)
    example["contacts"][0]["link"] = link
    return msgspec.convert({**example, "base_orientation_wxyz": orientation}, WorldModel)


def imu(link: list[int], rates: int) -> Imu:
    return Imu(
        tick=0,
        timestamp_ns=0,
        link=link,
        angular_velocity_rad_s=[X] * rates,
        acceleration_m_s2=[X] * len(link),
    )


def trajectory(*path: tuple[float, float]) -> Trajectory:
    return Trajectory(
        tick=0,
        timestamp_ns=0,
        path_id=1,
        path_w=list(path),
        speed_m_s=0.1,
        push_points=[],
        finished=False,
    )


def image(depth: bytes, link: int = 3, turned: Quaternion = UPRIGHT) -> DepthImage:
    values = {"link": link, "orientation_l_wxyz": turned, "width": 3, "height": 2, "depth": depth}
    return msgspec.convert({**make_plain_example(DepthImage), **values}, DepthImage)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (make_joint_state(ROBOT, 0.1), None),
        (
            msgspec.structs.replace(make_joint_state(ROBOT, 0.1), angle_rad=[0.0] * 13),
            "wrong_length",
        ),
        (msgspec.structs.replace(make_joint_state(ROBOT, 0.1), valid=[]), "wrong_length"),
        (make_power(), None),
        (make_power(joint_count=4), "wrong_length"),
        (imu([0, 3], 2), None),
        (imu([], 0), None),
        (imu([0, 4], 2), "wrong_length"),
        (imu([0, 3], 1), "wrong_length"),
        (contacts(3), None),
        (contacts(4), "wrong_length"),
        (world(3), None),
        (world(4), "wrong_length"),
        (world(0, (0.0, 0.0, 0.0, 0.0)), "no_rotation"),
        (make_pose(orientation_wxyz=(0.6, 0.0, 0.0, 0.8)), None),
        (make_pose(orientation_wxyz=(0.0, 0.0, 0.0, 0.0)), "no_rotation"),
        (make_pose(orientation_wxyz=(1.0, 1.0, 1.0, 1.0)), "no_rotation"),
        (image(bytes(12)), None),
        (image(bytes(11)), "wrong_length"),
        (image(bytes(12), link=4), "wrong_length"),
        (image(bytes(12), turned=(0.0, 0.0, 0.0, 0.0)), "no_rotation"),
        (trajectory((0.0, 0.0), (1.0, 0.0)), None),
        (trajectory((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)), "no_path"),
        (LocomotionIntent(timestamp_ns=0, requester="operator"), None),
    ],
)
def test_a_message_that_cannot_be_of_this_robot(message: Message, why: str | None) -> None:
    wrong = find_mismatch(message, ROBOT)
    assert (wrong.reason if wrong is not None else None) == why


def test_what_passes_as_a_path_makes_a_route() -> None:
    tiny = 5e-324  # the shortest step there is: its length is no number to divide by
    for path in ([(0.0, 0.0), (tiny, 0.0)], [(1e6, 0.0), (-1e6, 0.0)]):
        if find_mismatch(trajectory(*path), ROBOT) is None:
            assert Route(path).length_m > 0


def test_check_of_a_trajectory_is_not_repeated_for_other_readers_of_the_same_message() -> None:
    path = trajectory((0.0, 0.0), (1.0, 0.0))
    no_path = trajectory((0.0, 0.0), (0.0, 0.0))
    with mock.patch.object(
        robot_mismatch, "is_polyline", wraps=robot_mismatch.is_polyline
    ) as is_polyline:
        errors = [
            find_mismatch(message, ROBOT) for message in (no_path, no_path, path, path, no_path)
        ]
    assert [error is None for error in errors] == [False, False, True, True, False]
    assert is_polyline.call_count == 3  # once for each message that differs from the one before


def served(hal: Session) -> None:
    """A HAL that shows its robot and nothing else."""
    hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)


def test_stranger_invalid_intent_is_counted_and_ignored() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        served(hal)
        client = HostClient(session, "navigation")
        intents, joints = (
            client.subscribe(keys.INTENT, LocomotionIntent),
            client.subscribe(keys.JOINTS, JointState),
        )
        # Asked again, it is remembered.
        assert client.wait_for_description() == client.wait_for_description() == ROBOT
        clocks = hal.declare_publisher(keys.CLOCK, Clock)
        asked, felt = (
            hal.declare_publisher(keys.INTENT, LocomotionIntent),
            hal.declare_publisher(keys.JOINTS, JointState),
        )
        wait_until(
            lambda: clocks.has_subscriber() and asked.has_subscriber() and felt.has_subscriber(),
            "everybody heard",
        )
        for speed in (0.1, 0.2):
            asked.put(LocomotionIntent(timestamp_ns=5, requester="operator", speed_m_s=speed))
        felt.put(make_joint_state(ROBOT, 0.1, tick=3))
        felt.put(
            msgspec.structs.replace(make_joint_state(ROBOT, 0.1, tick=4), angle_rad=[0.0] * 13)
        )
        ticks = client.iterate_ticks()

        def all_there() -> bool:
            clocks.put(CLOCK)
            next(ticks)
            return session.rejected == {"wrong_length": 1} and intents.newest() is not None

        wait_until(all_there, "the wrong state counted, and an intent")
        intent, newest = intents.newest(), joints.newest()
        assert intent is not None
        assert intent.speed_m_s == 0.2
        assert newest is not None
        assert newest.tick == 3


def test_an_answer_that_cannot_be_read_is_no_answer() -> None:
    with connected_sessions("worm", "worm") as (rogue, session):
        served(rogue)
        network: Any = rogue._zenoh  # pyright: ignore[reportPrivateUsage] - a rogue does not keep to our session
        stranger = network.declare_queryable(
            keys.LEASE, lambda query: query.reply(keys.LEASE, b"\xc1", encoding="zenoh/bytes")
        )
        with raises_error(NotConnectedError, code="network/no-answer"):
            session.send_request(keys.LEASE, LeaseRequest(action="acquire", holder="control"))
        commander = Commander(HostClient(session, "control"), ROBOT)
        time.sleep(0.3)  # it asks at most so often
        assert not commander.ensure_lease(CLOCK)
        assert commander.lease_refusal is not None
        assert "cannot be decoded" in commander.lease_refusal
        assert session.rejected == {"unknown_message": 2}
        stranger.undeclare()


def test_stranger_oversized_message_never_arrives_and_link_survives() -> None:
    with connected_sessions("worm", "worm", "worm") as (hal, session, stranger):
        heard: list[int] = []
        for listener in (hal, session):
            listener.on_arrival(keys.JOINTS, lambda arrival: heard.append(len(arrival.payload)))
        publisher = stranger.declare_publisher(keys.JOINTS, JointState, lossless=True)
        wait_until(publisher.has_subscriber, "somebody listening")
        put: Any = stranger._zenoh.put  # pyright: ignore[reportPrivateUsage] - a stranger does not keep to our session
        for length in (MAX_PAYLOAD_BYTES, 10 * MAX_PAYLOAD_BYTES, 1):
            put(keys.JOINTS, bytes(length), congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: heard.count(1) >= 2, "the last one everywhere")
        assert sorted(heard) == [1, 1, MAX_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES]


def test_large_images_arrive_where_they_are_expected() -> None:
    """A robot's own processes know its cameras; to everybody else more than a MiB is too long."""
    endpoint, largest = find_free_endpoint(), 2 * 1280 * 960
    with (
        open_session(ConnectionSettings(endpoint, "worm", listen=True, max_bytes=largest)) as hal,
        open_session(ConnectionSettings(endpoint, "worm", max_bytes=largest)) as session,
        open_session(ConnectionSettings(endpoint, "worm")) as small,
    ):
        readers = [
            each.declare_reader(keys.depth_key("head"), DepthImage) for each in (session, small)
        ]
        publisher = hal.declare_publisher(keys.depth_key("head"), DepthImage, lossless=True)
        wait_until(publisher.has_subscriber, "somebody listening")
        sent = msgspec.structs.replace(image(bytes(largest)), width=1280, height=960)
        publisher.put(sent)
        wait_until(lambda: readers[0].drain() == [sent], "the image")
        assert readers[1].drain() == []


def test_expired_lease_is_a_fault_despite_simultaneous_request() -> None:
    config, answers = make_run_config(clock_mode="realtime", services={}), list[Answer]()
    with connected_sessions("worm") as (session,):
        host = Host(config, GuardedBackend(LagBackend(config)), session)  # between two ticks
        host.on_request(LeaseRequest(action="acquire", holder="control"), answers.append)
        host.authority.observe_joints(make_joint_state(ROBOT))
        host.authority.state = "armed"
        time.sleep(1.5e-9 * host.description.lease_ns)
        host.on_request(LeaseRequest(action="acquire", holder="stranger"), answers.append)
    assert [answer.ok for answer in answers] == [True, True]
    assert host.authority.state == "fault"
    assert host.authority.faults[-1].what == "lease_expired"


def test_stranger_flood_is_dropped_except_newest_wanted_sample() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        reader, asked = session.declare_reader(keys.JOINTS, JointState), list[int]()
        joints, after = (
            hal.declare_publisher(keys.JOINTS, JointState, lossless=True),
            session.declare_reader(keys.CLOCK, Clock),
        )
        clocks = hal.declare_publisher(keys.CLOCK, Clock, lossless=True)
        wait_until(lambda: joints.has_subscriber() and clocks.has_subscriber(), "both readers")
        for tick in range(101):
            joints.put(make_joint_state(ROBOT, tick=tick))
        clocks.put(CLOCK)
        wait_until(after.drain, "what was sent last")

        def wanted(message: JointState) -> bool:
            asked.append(message.tick)
            return message.tick < 100

        newest = reader.pop_newest(wanted)
        assert newest is not None
        assert newest.tick == 99
        assert asked == [100, 99]
        assert reader.pop_newest(wanted) is None
        assert reader.drain() == []
