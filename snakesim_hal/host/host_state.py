"""What the parts of one host share."""

from dataclasses import dataclass, field

from snakesim_hal.faults.allowed import InjectedFaults
from snakesim_hal.host.ending import RequestedEnding
from snakesim_hal.host.host_clock import HostClock
from snakesim_hal.host.participants import LockstepParticipant, LockstepParticipants
from snakesim_hal.host.run_statistics import RunStatistics
from snakesim_hal.host.timing import BackendTimer
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.wire.messages import Answer, RobotDescription


@dataclass
class HostState:
    """The state of one host. Only the thread that runs the host changes it."""

    # Constant during a run.
    config: RunConfig
    description: RobotDescription

    # The robot.
    authority: CommandAuthority
    clock: HostClock
    backend_time: BackendTimer
    faults: InjectedFaults  # injected ones

    # The services.
    participants: LockstepParticipants
    newest_answered_tick: int = -1  # by an accepted command
    waiting_since_ns: int | None = None  # monotonic; for the services' answers that end this tick

    # The run.
    statistics: RunStatistics = field(default_factory=RunStatistics)
    ending: RequestedEnding = field(default_factory=RequestedEnding)

    def find_lease_holder(self) -> LockstepParticipant | None:
        """Return the service that holds the lease, if it is one of the run."""
        return self.participants.get(self.authority.lease.holder or "")

    def reset_answered_ticks(self) -> None:
        """Commands that were sent before the arming do not answer its tick."""
        holder = self.find_lease_holder()
        if holder is not None:
            holder.done_tick = -1
            self.newest_answered_tick = -1

    def make_answer(self, *, ok: bool, reason: str, refusal: str | None = None) -> Answer:
        """Return an answer to a request."""
        return Answer(
            ok=ok,
            reason=reason[:500],
            refusal=refusal,
            lifecycle=self.authority.state,
            host=self.description.host,
        )
