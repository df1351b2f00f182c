"""A service's client yields the ticks of the host's clock, each once, and reads samples that belong to them."""

from collections.abc import Iterator

import msgspec

from snakesim_hal.network.client import HostClient
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Pose, TickDone
from snakesim_testing.hal.local_network import wait_for_messages
from snakesim_testing.hal.small_robots import make_clock, make_pose
from snakesim_testing.harness.wait import wait_until

SILENCE_TIMEOUT_S = 0.05  # the client yields None after this time without a clock
CONNECT_TIMEOUT_S = 5.0


def iterate_ticks_after(
    sessions: tuple[Session, Session], clocks: list[Clock]
) -> Iterator[Clock | None]:
    """Return the ticks that a service yields if all these clocks arrived before it looked at the first."""
    host, service = sessions
    client = HostClient(service, "control")
    publisher = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
    wait_until(publisher.has_subscriber, "the service subscribes", CONNECT_TIMEOUT_S)
    for clock in clocks:
        publisher.put(clock)
    wait_until(
        lambda: client._due_clocks.qsize() == len(clocks), "all clocks arrived", CONNECT_TIMEOUT_S
    )
    return client.iterate_ticks(SILENCE_TIMEOUT_S)


def test_client_in_lockstep_yields_repeated_tick_once(
    sessions: tuple[Session, Session],
) -> None:
    """The host repeats the clock of tick 0 until it is armed. The client yields the newest clock of each tick."""
    disarmed, armed = 0, 1  # arm sessions
    repeated_before_arming = [make_clock(tick=0, arm_session=disarmed)] * 50
    after_arming = [make_clock(tick=tick, arm_session=armed) for tick in (0, 1, 2)]

    ticks = iterate_ticks_after(sessions, repeated_before_arming + after_arming)

    yielded_clocks = [next(ticks) for _ in after_arming]
    assert yielded_clocks == after_arming
    assert next(ticks) is None, "a further tick"


def test_client_in_lockstep_ignores_sample_of_later_tick(
    sessions: tuple[Session, Session],
) -> None:
    """A delayed sensor has no sample at the first ticks; a host that is ahead may already have sent a later one."""
    host, service = sessions
    client = HostClient(service, "guidance")
    feed = client.subscribe(keys.POSE, Pose)
    ticks = client.iterate_ticks(5.0)
    poses = host.declare_publisher(keys.POSE, Pose, lossless=True)
    clocks = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
    wait_until(
        lambda: poses.has_subscriber() and clocks.has_subscriber(),
        "the service subscribes",
        CONNECT_TIMEOUT_S,
    )
    poses.put(make_pose(3))
    clock_without_pose = make_clock(2, arm_session=1)
    clock_with_pose = msgspec.structs.replace(make_clock(3, arm_session=1), newest={keys.POSE: 3})

    clocks.put(clock_without_pose)
    assert next(ticks) is not None
    assert client.read(feed) is None

    clocks.put(clock_with_pose)
    assert next(ticks) is not None
    pose = client.read(feed)
    assert pose is not None
    assert pose.tick == 3


def test_client_in_realtime_yields_only_newest_tick(sessions: tuple[Session, Session]) -> None:
    clocks = [make_clock(tick, clock_mode="realtime") for tick in range(5)]
    ticks = iterate_ticks_after(sessions, clocks)
    newest = next(ticks)
    assert newest is not None
    assert newest.tick == 4
    assert next(ticks) is None


def test_client_reports_done_for_repeated_tick(
    sessions: tuple[Session, Session],
) -> None:
    host, service = sessions
    client = HostClient(service, "control")
    reports = host.declare_reader(keys.done_key("control"), TickDone)
    publisher = host.declare_publisher(keys.CLOCK, Clock, lossless=True)
    wait_until(publisher.has_subscriber, "the service subscribes", CONNECT_TIMEOUT_S)
    ticks = client.iterate_ticks(5.0)

    publisher.put(make_clock(0, arm_session=0))
    assert next(ticks) is not None
    client.commanded_tick = 0  # the command itself answers the tick
    client.report_done(0)

    publisher.put(make_clock(0, arm_session=1))
    assert next(ticks) is not None
    client.report_done(0)
    assert wait_for_messages(reports, "the tick reported done") == [TickDone(tick=0)]
