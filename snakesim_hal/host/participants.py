"""Tracks the services of a run in the host: which are connected, and which a lockstep run still waits for.

Pure. The host's thread makes every call.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.model.scenario import ServiceSchedule

NOT_ANSWERED = -1


@dataclass
class LockstepParticipant:
    """A service that a lockstep run waits for."""

    service: ServiceSchedule
    done_tick: int = NOT_ANSWERED  # the newest tick for which it has published all output
    # That it receives: it cannot answer ticks that were published before it was connected.
    first_tick: int = 0
    is_connected: bool = False
    is_abandoned: bool = False

    def behind(self, tick: int) -> bool:
        """Return whether the end of `tick` has to wait for this service."""
        if not self.is_connected or self.is_abandoned:
            return False
        awaited_tick = self.service.used_output_tick(tick + 1)
        return awaited_tick >= self.first_tick and awaited_tick > self.done_tick


class LockstepParticipants(dict[str, LockstepParticipant]):
    """All services of the scenario, by name."""

    def __init__(self, services: Mapping[str, ServiceSchedule]) -> None:
        """Start with services that are not connected yet."""
        super().__init__({name: LockstepParticipant(service) for name, service in services.items()})

    def find_services_behind(self, tick: int) -> list[str]:
        """Return the services for which the end of `tick` has to wait."""
        return [name for name, participant in self.items() if participant.behind(tick)]

    def describe_awaited(self, tick: int) -> str:
        """Return, as text, which service's answer to which tick the end of `tick` has to wait for."""
        answers: list[str] = []
        for name in self.find_services_behind(tick):
            awaited_tick = self[name].service.used_output_tick(tick + 1)
            answers.append(f"{name}'s answer to tick {awaited_tick}")
        return ", ".join(answers)

    def find_missing_services(self, *, must_have_answered: bool) -> list[str]:
        """Return the services that are not connected.

        Args:
            must_have_answered: Also return connected services that have not answered any tick yet.
        """
        names: list[str] = []
        for name, participant in self.items():
            is_silent = must_have_answered and participant.done_tick < 0
            if is_silent or not participant.is_connected:
                names.append(name)
        return names

    def present(self) -> list[str]:
        """Return the connected services, sorted by name."""
        return sorted(name for name, participant in self.items() if participant.is_connected)

    def mark_done(self, service: str | None, tick: int) -> None:
        """Note that a service has published all its output for a tick."""
        participant = self.get(service or "")
        if participant is not None:
            participant.done_tick = max(participant.done_tick, tick)

    def mark_present(self, service: str, next_tick: int) -> None:
        """Note that a service's liveliness token has appeared.

        Args:
            service: Name of the service, which has subscribed to its input already.
            next_tick: The tick that is published next, also if it has been published before.
        """
        participant = self.get(service)
        if participant is None:
            return
        if not participant.is_connected:
            participant.first_tick = next_tick
        participant.is_connected = True
        participant.is_abandoned = False

    def mark_absent(self, service: str) -> bool:
        """Note that a service's token has vanished. Returns whether it is a service of the run."""
        participant = self.get(service)
        if participant is None:
            return False
        participant.is_connected = False
        participant.done_tick = NOT_ANSWERED
        return True
