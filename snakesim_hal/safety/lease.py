"""The lease: the right to command. One holder at a time; every accepted command renews it. Pure; time is passed in."""

from dataclasses import dataclass, replace

from snakesim_hal.wire.messages import LeaseRequest


@dataclass(frozen=True)
class Lease:
    """The right to command, and until when. `epoch` grows with every new holder, so old commands are void."""

    holder: str | None = None
    epoch: int = 0
    priority: int = 0
    expires_ns: int = 0

    def live(self, now_ns: int) -> bool:
        """Whether it is held at this time."""
        return self.holder is not None and now_ns <= self.expires_ns


@dataclass(frozen=True)
class LeaseDecision:
    """The result of a request: the lease after it, and why it was refused (None: granted)."""

    lease: Lease
    refusal: str | None = None
    changed_hands: bool = False
    word: str | None = None  # the refusal as one word


def rule(lease: Lease, request: LeaseRequest, now_ns: int, term_ns: int) -> LeaseDecision:
    """Decide a request. A live lease is granted only to its holder, or to a higher priority."""
    mine = lease.live(now_ns) and lease.holder == request.holder and lease.epoch == request.epoch
    match request.action:
        case "acquire":
            if lease.live(now_ns) and request.priority <= lease.priority:
                left_ms = (lease.expires_ns - now_ns) / 1e6
                return LeaseDecision(
                    lease,
                    f"held by {lease.holder} (epoch {lease.epoch}, priority {lease.priority}) for another "
                    f"{left_ms:.0f} ms; stop it, or ask with a priority above {lease.priority}",
                    word="lease_held",
                )
            taken = Lease(request.holder, lease.epoch + 1, request.priority, now_ns + term_ns)
            return LeaseDecision(taken, changed_hands=True)
        case "renew":
            if not mine:
                return _not_holder(lease, request, "acquire the lease first")
            return LeaseDecision(renewed(lease, now_ns, term_ns))
        case _:  # release
            if not mine:
                return _not_holder(lease, request, "nothing to release")
            return LeaseDecision(freed(lease), changed_hands=True)


def _not_holder(lease: Lease, request: LeaseRequest, then: str) -> LeaseDecision:
    return LeaseDecision(lease, f"{request.holder} does not hold epoch {request.epoch}; {then}", word="not_holder")


def renewed(lease: Lease, now_ns: int, term_ns: int) -> Lease:
    """The lease, extended by a term."""
    return replace(lease, expires_ns=now_ns + term_ns)


def freed(lease: Lease) -> Lease:
    """The free lease; the epoch stays, so that later commands of the last holder are rejected."""
    return Lease(epoch=lease.epoch)
