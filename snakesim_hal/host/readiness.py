"""Which services a host waits for before it can be armed."""

from snakesim_hal.host.participants import LockstepParticipants
from snakesim_hal.host.status_messages import describe_wait
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.process_entries import (
    HOST,
    ProcessEntries,
    make_own_entry,
    publish_process_entry,
)
from snakesim_hal.network.session import Session


class ServiceReadiness:
    """Compares the services that are connected with those that the run needs."""

    def __init__(
        self, config: RunConfig, participants: LockstepParticipants, session: Session
    ) -> None:
        self._participants = participants
        # Tick 0, without which lockstep cannot begin.
        self._requires_answers = config.clock_mode == "lockstep"
        self._own_entry = make_own_entry(HOST, config)
        publish_process_entry(session, self._own_entry)
        self._processes = ProcessEntries(session)

    def find_missing_services(self) -> list[str]:
        """Return the services that are not connected, or in lockstep have not answered tick 0 yet."""
        return self._participants.find_missing_services(must_have_answered=self._requires_answers)

    def find_undescribed_processes(self) -> list[str]:
        """Return the processes of awaited services whose description has not arrived yet."""
        return self._processes.unpublished(self._participants)

    def describe_differing_processes(self) -> list[str]:
        """Return how the processes of awaited services differ from this host, or lack a description."""
        return self._processes.find_problems(self._own_entry, self._participants)

    def describe_missing(self, services: list[str]) -> list[str]:
        """Return one text per missing service, with the messages that it has not received."""
        missing_keys = self._processes.waits()
        return [describe_wait(service, missing_keys.get(service, ())) for service in services]
