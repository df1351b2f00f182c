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
def connected_navigation_service(connection: ConnectionSettings) -> Iterator[HostClient]:
    """Connect a navigation service that answers only if the test calls `report_done`."""
    with open_session(connection) as session:
        client = HostClient(session, "navigation")
        client.wait_for_description()
        client.announce()
        yield client


def test_host_with_restarted_service_awaits_only_answers_to_received_ticks() -> None:
    config = make_run_config(clock_mode="lockstep", services=SERVICES, stall_limit_s=60.0)
    with running_host(config) as run, connected_navigation_service(run.link) as navigation:
        with running_follower(run.link, SineFollower()):
            wait_until(lambda: run.status.waiting_for == ["navigation"], "control")
            navigation.report_done(0)
            run.arm()
            # An armed robot that loses its controller goes to fault.
            assert run.request_lifecycle("disarm").ok
            wait_until(
                lambda: navigation.newest_clock is not None and navigation.newest_clock.tick == 1,
                "tick 1",
            )
        wait_until(lambda: not run.host.participants["control"].is_connected, "control has left")
        restarted_control = SineFollower()
        with running_follower(run.link, restarted_control):
            wait_until(lambda: run.host.participants["control"].is_connected, "control is back")
            assert restarted_control.ticks_seen == [], (
                "the host published a tick without navigation"
            )
            navigation.report_done(1)
            wait_until(lambda: restarted_control.ticks_seen == [2], "the next tick", 20.0)
