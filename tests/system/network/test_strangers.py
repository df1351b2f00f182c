"""No message of an unauthorized client ends a service. Each of these messages ended one in the past."""

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

# The robot of these tests has the links 0 to 3.
VECTOR = (1.0, 0.0, 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
NO_ROTATION = (0.0, 0.0, 0.0, 0.0)


def make_contacts(link: int) -> Contacts:
    return Contacts(tick=0, timestamp_ns=0, contacts=[make_link_contact(link)])


def make_world_model(link: int = 0, orientation_wxyz: Quaternion = UPRIGHT) -> WorldModel:
    example = make_plain_example(WorldModel)
    example["contacts"][0]["link"] = link
    return msgspec.convert({**example, "base_orientation_wxyz": orientation_wxyz}, WorldModel)


def make_imu(link: list[int], rate_count: int) -> Imu:
    return Imu(
        tick=0,
        timestamp_ns=0,
        link=link,
        angular_velocity_rad_s=[VECTOR] * rate_count,
        acceleration_m_s2=[VECTOR] * len(link),
    )


def make_trajectory(*path: tuple[float, float]) -> Trajectory:
    return Trajectory(
        tick=0,
        timestamp_ns=0,
        path_id=1,
        path_w=list(path),
        speed_m_s=0.1,
        push_points=[],
        finished=False,
    )


def make_depth_image(
    depth: bytes, link: int = 3, orientation_wxyz: Quaternion = UPRIGHT
) -> DepthImage:
    """Make an image of 3 by 2 pixels, which needs 12 bytes."""
    values = {
        "link": link,
        "orientation_l_wxyz": orientation_wxyz,
        "width": 3,
        "height": 2,
        "depth": depth,
    }
    return msgspec.convert({**make_plain_example(DepthImage), **values}, DepthImage)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (make_joint_state(ROBOT, 0.1), None),
        (
            msgspec.structs.replace(make_joint_state(ROBOT, 0.1), angle_rad=[0.0] * 13),
            "wrong_length",
        ),
        (msgspec.structs.replace(make_joint_state(ROBOT, 0.1), valid=[]), "wrong_length"),
        (make_power(), None),
        (make_power(joint_count=4), "wrong_length"),
        (make_imu([0, 3], 2), None),
        (make_imu([], 0), None),
        (make_imu([0, 4], 2), "wrong_length"),
        (make_imu([0, 3], 1), "wrong_length"),
        (make_contacts(3), None),
        (make_contacts(4), "wrong_length"),
        (make_world_model(3), None),
        (make_world_model(4), "wrong_length"),
        (make_world_model(0, NO_ROTATION), "no_rotation"),
        (make_pose(orientation_wxyz=(0.6, 0.0, 0.0, 0.8)), None),
        (make_pose(orientation_wxyz=NO_ROTATION), "no_rotation"),
        (make_pose(orientation_wxyz=(1.0, 1.0, 1.0, 1.0)), "no_rotation"),
        (make_depth_image(bytes(12)), None),
        (make_depth_image(bytes(11)), "wrong_length"),
        (make_depth_image(bytes(12), link=4), "wrong_length"),
        (make_depth_image(bytes(12), orientation_wxyz=NO_ROTATION), "no_rotation"),
        (make_trajectory((0.0, 0.0), (1.0, 0.0)), None),
        (make_trajectory((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)), "no_path"),
        (LocomotionIntent(timestamp_ns=0, requester="operator"), None),
    ],
)
def test_find_mismatch_names_why_message_cannot_describe_this_robot(
    message: Message, reason: str | None
) -> None:
    mismatch = find_mismatch(message, ROBOT)
    if reason is None:
        assert mismatch is None
    else:
        assert mismatch is not None
        assert mismatch.reason == reason


def test_find_mismatch_accepts_only_paths_that_make_a_route() -> None:
    smallest_float = 5e-324  # a division by a step of this length overflows
    for path in ([(0.0, 0.0), (smallest_float, 0.0)], [(1e6, 0.0), (-1e6, 0.0)]):
        if find_mismatch(make_trajectory(*path), ROBOT) is None:
            assert Route(path).length_m > 0


def test_find_mismatch_checks_repeated_trajectory_once() -> None:
    valid = make_trajectory((0.0, 0.0), (1.0, 0.0))
    invalid = make_trajectory((0.0, 0.0), (0.0, 0.0))
    with mock.patch.object(
        robot_mismatch, "is_polyline", wraps=robot_mismatch.is_polyline
    ) as is_polyline:
        mismatches = [
            find_mismatch(message, ROBOT) for message in (invalid, invalid, valid, valid, invalid)
        ]
    are_valid = [mismatch is None for mismatch in mismatches]
    assert are_valid == [False, False, True, True, False]
    assert is_polyline.call_count == 3  # once for each message that differs from the one before


def publish_description(hal: Session) -> None:
    """Publish the robot's description, as a HAL host does."""
    hal.declare_latched_publisher(keys.DESCRIPTION, RobotDescription).put(ROBOT)


def test_client_counts_and_ignores_state_of_wrong_length() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        publish_description(hal)
        client = HostClient(session, "navigation")
        intents = client.subscribe(keys.INTENT, LocomotionIntent)
        joints = client.subscribe(keys.JOINTS, JointState)
        assert client.wait_for_description() == ROBOT
        assert client.wait_for_description() == ROBOT  # the client stores it
        clocks = hal.declare_publisher(keys.CLOCK, Clock)
        intent_publisher = hal.declare_publisher(keys.INTENT, LocomotionIntent)
        joint_publisher = hal.declare_publisher(keys.JOINTS, JointState)
        publishers = (clocks, intent_publisher, joint_publisher)
        wait_until(
            lambda: all(publisher.has_subscriber() for publisher in publishers),
            "every publisher has a subscriber",
        )
        for speed_m_s in (0.1, 0.2):
            intent_publisher.put(
                LocomotionIntent(timestamp_ns=5, requester="operator", speed_m_s=speed_m_s)
            )
        valid_state = make_joint_state(ROBOT, 0.1, tick=3)
        invalid_state = msgspec.structs.replace(valid_state, tick=4, angle_rad=[0.0] * 13)
        joint_publisher.put(valid_state)
        joint_publisher.put(invalid_state)
        ticks = client.iterate_ticks()

        def have_samples_arrived() -> bool:
            clocks.put(CLOCK)
            next(ticks)
            return session.rejected == {"wrong_length": 1} and intents.newest() is not None

        wait_until(have_samples_arrived, "the invalid state is counted, and an intent arrived")
        newest_intent = intents.newest()
        assert newest_intent is not None
        assert newest_intent.speed_m_s == 0.2
        newest_state = joints.newest()
        assert newest_state is not None
        assert newest_state.tick == 3


def test_client_undecodable_answer_counts_as_no_answer() -> None:
    with connected_sessions("worm", "worm") as (rogue, session):
        publish_description(rogue)
        network: Any = rogue._zenoh  # pyright: ignore[reportPrivateUsage] - SnakeSIM's session would check the answer
        queryable = network.declare_queryable(
            keys.LEASE, lambda query: query.reply(keys.LEASE, b"\xc1", encoding="zenoh/bytes")
        )
        with raises_error(NotConnectedError, code="network/no-answer"):
            session.send_request(keys.LEASE, LeaseRequest(action="acquire", holder="control"))
        commander = Commander(HostClient(session, "control"), ROBOT)
        time.sleep(0.3)  # the commander requests a lease at most this often
        assert not commander.ensure_lease(CLOCK)
        assert commander.lease_refusal is not None
        assert "cannot be decoded" in commander.lease_refusal
        assert session.rejected == {"unknown_message": 2}
        queryable.undeclare()


def test_session_oversized_message_never_arrives_and_link_survives() -> None:
    with connected_sessions("worm", "worm", "worm") as (hal, service, client):
        received_bytes: list[int] = []
        for receiver in (hal, service):
            receiver.on_arrival(
                keys.JOINTS, lambda arrival: received_bytes.append(len(arrival.payload))
            )
        publisher = client.declare_publisher(keys.JOINTS, JointState, lossless=True)
        wait_until(publisher.has_subscriber, "a subscriber")
        put: Any = client._zenoh.put  # pyright: ignore[reportPrivateUsage] - SnakeSIM's session would check the size
        for length in (MAX_PAYLOAD_BYTES, 10 * MAX_PAYLOAD_BYTES, 1):
            put(keys.JOINTS, bytes(length), congestion_control=zenoh.CongestionControl.BLOCK)
        wait_until(lambda: received_bytes.count(1) >= 2, "the last message in both sessions")
        assert sorted(received_bytes) == [1, 1, MAX_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES]


def test_session_receives_large_images_only_if_configured() -> None:
    """A robot's own processes know the size of its cameras; other sessions refuse more than a MiB."""
    endpoint = find_free_endpoint()
    image_bytes = 2 * 1280 * 960
    key = keys.depth_key("head")
    with (
        open_session(
            ConnectionSettings(endpoint, "worm", listen=True, max_bytes=image_bytes)
        ) as hal,
        open_session(ConnectionSettings(endpoint, "worm", max_bytes=image_bytes)) as own_session,
        open_session(ConnectionSettings(endpoint, "worm")) as other_session,
    ):
        own_reader = own_session.declare_reader(key, DepthImage)
        other_reader = other_session.declare_reader(key, DepthImage)
        publisher = hal.declare_publisher(key, DepthImage, lossless=True)
        wait_until(publisher.has_subscriber, "a subscriber")
        sent = msgspec.structs.replace(make_depth_image(bytes(image_bytes)), width=1280, height=960)
        publisher.put(sent)
        wait_until(lambda: own_reader.drain() == [sent], "the image")
        assert other_reader.drain() == []


def test_host_expired_lease_is_a_fault_despite_new_request() -> None:
    config = make_run_config(clock_mode="realtime", services={})
    answers: list[Answer] = []
    with connected_sessions("worm") as (session,):
        host = Host(config, GuardedBackend(LagBackend(config)), session)
        host.on_request(LeaseRequest(action="acquire", holder="control"), answers.append)
        joints = make_joint_state(ROBOT)
        host.authority.observe_joints(joints, joints.timestamp_ns)
        host.authority.state = "armed"
        # The lease expires, and another client requests it before the next tick of the host.
        time.sleep(1.5e-9 * host.description.lease_ns)
        host.on_request(LeaseRequest(action="acquire", holder="stranger"), answers.append)
    assert [answer.ok for answer in answers] == [True, True]
    assert host.authority.state == "fault"
    assert host.authority.faults[-1].what == "lease_expired"


def test_session_reader_of_flood_returns_newest_wanted_sample() -> None:
    with connected_sessions("worm", "worm") as (hal, session):
        joint_reader = session.declare_reader(keys.JOINTS, JointState)
        clock_reader = session.declare_reader(keys.CLOCK, Clock)
        joint_publisher = hal.declare_publisher(keys.JOINTS, JointState, lossless=True)
        clock_publisher = hal.declare_publisher(keys.CLOCK, Clock, lossless=True)
        wait_until(
            lambda: joint_publisher.has_subscriber() and clock_publisher.has_subscriber(),
            "both readers",
        )
        for tick in range(101):
            joint_publisher.put(make_joint_state(ROBOT, tick=tick))
        clock_publisher.put(CLOCK)
        wait_until(clock_reader.drain, "the clock, which was sent last")
        checked_ticks: list[int] = []

        def is_wanted(message: JointState) -> bool:
            checked_ticks.append(message.tick)
            return message.tick < 100

        newest = joint_reader.pop_newest(is_wanted)
        assert newest is not None
        assert newest.tick == 99
        assert checked_ticks == [100, 99]
        assert joint_reader.pop_newest(is_wanted) is None
        assert joint_reader.drain() == []
