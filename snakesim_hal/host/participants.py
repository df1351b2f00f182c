"""The services of a run in the host: which are connected, and in lockstep which are still due. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.model.scenario import Service


@dataclass
class Participant:
    """A service that a lockstep run waits for."""

    service: Service
    done_tick: int = -1
    present: bool = False
    given_up: bool = False

    def behind(self, tick: int) -> bool:
        """Whether the end of `tick` has to wait for this service."""
        return self.present and not self.given_up and self.done_tick < self.service.used_output_tick(tick + 1)


class Participants(dict[str, Participant]):
    """All services of the scenario, by name."""

    def __init__(self, services: Mapping[str, Service]) -> None:
        super().__init__({name: Participant(service) for name, service in services.items()})

    def behind(self, tick: int) -> list[str]:
        """Services for which the end of `tick` has to wait."""
        return [name for name, participant in self.items() if participant.behind(tick)]

    def awaited(self, tick: int) -> str:
        """Whose answer to which tick the end of `tick` has to wait for, as text."""
        return ", ".join(
            f"{name}'s answer to tick {self[name].service.used_output_tick(tick + 1)}" for name in self.behind(tick)
        )

    def missing(self, *, must_have_answered: bool) -> list[str]:
        """Services that are not connected, or on request those that have not answered any tick yet."""
        return [n for n, p in self.items() if not p.present or (must_have_answered and p.done_tick < 0)]

    def present(self) -> list[str]:
        """Connected services."""
        return sorted(name for name, participant in self.items() if participant.present)

    def delivered(self, service: str | None, tick: int) -> None:
        """A service has published all its output for a tick."""
        participant = self.get(service or "")
        if participant is not None:
            participant.done_tick = max(participant.done_tick, tick)

    def came(self, service: str) -> None:
        """A service's liveliness token has appeared."""
        if service in self:
            self[service].present, self[service].given_up = True, False

    def went(self, service: str) -> bool:
        """A service's token has vanished. Returns whether it is a service of the run."""
        if service not in self:
            return False
        self[service].present, self[service].done_tick = False, -1
        return True
