"""A service that connects to a lockstep host while the host waits for another service."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from snakesim_hal.network.client import HostClient
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_testing.hal.local_network import SineFollower, running_follower, running_host
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until

SERVICES = {"control": {}, "navigation": {}}

pytestmark = pytest.mark.usefixtures("quick_threads")


@contextmanager
def navigation(link: ConnectionSettings) -> Iterator[HostClient]:
    """A navigation service that answers only when the test says so."""
    with open_session(link) as session:
        client = HostClient(session, "navigation")
        client.wait_for_description()
        client.announce()
        yield client


def test_host_does_not_await_an_answer_to_a_tick_that_a_service_has_not_received() -> None:
    config = make_run_config(clock_mode="lockstep", services=SERVICES, stall_limit_s=60.0)
    with running_host(config) as run, navigation(run.link) as slow:
        with running_follower(run.link, SineFollower()):
            wait_until(lambda: run.status.waiting_for == ["navigation"], "control")
            slow.report_done(0)
            run.arm()
            # An armed robot that loses its controller goes to fault.
            assert run.request_lifecycle("disarm").ok
            wait_until(
                lambda: slow.newest_clock is not None and slow.newest_clock.tick == 1, "tick 1"
            )
        wait_until(lambda: not run.host.participants["control"].is_connected, "control has left")
        late = SineFollower()
        with running_follower(run.link, late):
            wait_until(lambda: run.host.participants["control"].is_connected, "control is back")
            assert late.ticks_seen == [], "the host waits for navigation, and publishes nothing"
            slow.report_done(1)
            wait_until(lambda: late.ticks_seen == [2], "the next tick", 20.0)
