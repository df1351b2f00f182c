"""What a service sees of the clock."""

from collections.abc import Iterator

import msgspec

from snakesim_hal.network.client import HostClient
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Pose, TickDone
from snakesim_testing.hal.local_network import wait_for_messages
from snakesim_testing.hal.small_robots import make_clock, make_pose
from snakesim_testing.harness.wait import wait_until


def shown(sessions: tuple[Session, Session], clocks: list[Clock]) -> Iterator[Clock | None]:
    """The ticks of a service that was busy while all these clocks came."""
    host, service = sessions
    client = HostClient(service, "control")
    publisher = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
    wait_until(publisher.has_subscriber, "the service listens", 5.0)
    for each in clocks:
        publisher.put(each)
    wait_until(lambda: client._due_clocks.qsize() == len(clocks), "all clocks there", 5.0)
    return client.iterate_ticks(0.05)


def test_client_in_lockstep_answers_repeated_tick_once(
    sessions: tuple[Session, Session],
) -> None:
    ticks = shown(
        sessions,
        [make_clock(0)] * 50
        + [
            make_clock(0, arm_session=1),
            make_clock(1, arm_session=1),
            make_clock(2, arm_session=1),
        ],
    )
    assert [
        (c.tick, c.arm_session) if c is not None else None for c in (next(ticks) for _ in range(4))
    ] == [
        *((0, 1), (1, 1), (2, 1)),
        None,
    ]


def test_client_in_lockstep_ignores_sample_of_a_later_tick(
    sessions: tuple[Session, Session],
) -> None:
    """A delayed sensor has nothing at the first ticks, and a host that is ahead has already sent what comes then."""
    host, service = sessions
    client = HostClient(service, "guidance")
    feed, ticks = client.subscribe(keys.POSE, Pose), client.iterate_ticks(5.0)
    poses, clocks = (
        host.declare_publisher(key, kind, lossless=True)
        for key, kind in ((keys.POSE, Pose), (keys.CLOCK, Clock))
    )
    wait_until(
        lambda: poses.has_subscriber() and clocks.has_subscriber(), "the service listens", 5.0
    )
    poses.put(make_pose(3))
    seen: list[int | None] = []
    for at in (
        make_clock(2, arm_session=1),
        msgspec.structs.replace(make_clock(3, arm_session=1), newest={keys.POSE: 3}),
    ):
        clocks.put(at)
        assert next(ticks) is not None
        found = client.read(feed)
        seen.append(None if found is None else found.tick)
    assert seen == [None, 3]


def test_in_real_time_only_the_newest_counts(sessions: tuple[Session, Session]) -> None:
    ticks = shown(sessions, [make_clock(tick, clock_mode="realtime") for tick in range(5)])
    newest, nothing = next(ticks), next(ticks)
    assert newest is not None
    assert newest.tick == 4
    assert nothing is None


def test_client_reports_done_for_a_tick_shown_again(
    sessions: tuple[Session, Session],
) -> None:
    host, service = sessions
    client = HostClient(service, "control")
    reports = host.declare_reader(keys.done_key("control"), TickDone)
    publisher = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
    wait_until(publisher.has_subscriber, "the service listens", 5.0)
    ticks = client.iterate_ticks(5.0)
    for arm_session in (0, 1):
        publisher.put(make_clock(0, arm_session=arm_session))
        assert next(ticks) is not None
        if arm_session == 0:
            client.commanded_tick = 0
        client.report_done(0)
    assert wait_for_messages(reports, "the tick reported done") == [TickDone(tick=0)]
