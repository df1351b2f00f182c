"""Which services a host waits for before it can be armed."""

from snakesim_hal.host.participants import Participants
from snakesim_hal.host.status_messages import describe_wait
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.process_entries import HOST, ProcessEntries, own_entry, show_process
from snakesim_hal.network.session import Session


class Readiness:
    """Compares the services that are connected with those that the run needs."""

    def __init__(self, config: RunConfig, participants: Participants, session: Session) -> None:
        self._participants = participants
        self._must_have_answered = config.clock_mode == "lockstep"  # tick 0, without which lockstep cannot begin
        self._own_entry = own_entry(HOST, config)
        show_process(session, self._own_entry)
        self._processes = ProcessEntries(session)

    def missing_services(self) -> list[str]:
        """Return the services that are not connected, or in lockstep have not answered tick 0 yet."""
        return self._participants.missing(must_have_answered=self._must_have_answered)

    def unpublished_processes(self) -> list[str]:
        """Return the processes of awaited services whose description has not arrived yet."""
        return self._processes.unpublished(self._participants)

    def differing_processes(self) -> list[str]:
        """Return how the processes of awaited services differ from this host, or lack a description."""
        return self._processes.find_problems(self._own_entry, self._participants)

    def describe_missing(self, services: list[str]) -> list[str]:
        """Return one text per missing service, with the messages that it has not received."""
        missing_keys = self._processes.waits()
        return [describe_wait(service, missing_keys.get(service, ())) for service in services]
