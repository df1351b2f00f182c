"""Notices what is wrong with the network of a host."""

from snakesim_hal.host.host_state import HostState
from snakesim_hal.host.outbox import HostOutbox
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault


class NetworkWatch:
    """Notes a second host of the same robot, and a network that accepts no message."""

    def __init__(self, state: HostState, session: Session, outbox: HostOutbox) -> None:
        self._state = state
        self._outbox = outbox
        self._own_host = state.description.host
        # In lockstep a lease counts in simulated time, so a slow computer is not a blocked network.
        self._can_be_blocked = state.config.clock_mode != "lockstep"
        self._other_hosts: set[str] = set()
        self._reported_causes: set[str] = set()
        session.on_token_change(self._on_host_presence, keys.HOST_ALL)

    def report_new_problems(self) -> None:
        """Record each problem once, when it begins."""
        is_held_up = (
            self._can_be_blocked
            and self._outbox.blocked_duration_s() * 1e9 > self._state.config.lease_ns
        )
        if not (is_held_up or self._other_hosts or self._reported_causes):
            return
        problems = {
            f"another HAL host has this robot's name: {host}": "second_host"
            for host in set(self._other_hosts)
        }
        if is_held_up:
            problems["the network accepts no message: it is congested, or under attack"] = (
                "network_held_up"
            )
        for cause in problems.keys() - self._reported_causes:
            self._state.authority.log_fault(
                Fault(tick=self._state.clock.tick, what=problems[cause], cause=cause)
            )
        self._reported_causes = set(problems)

    def _on_host_presence(self, key: str, present: bool) -> None:
        """Runs in a Zenoh thread: a host process of this robot's name has appeared or vanished."""
        host = keys.parse_service(key)
        if host == self._own_host:
            return
        if present:
            self._other_hosts.add(host)
        else:
            self._other_hosts.discard(host)
