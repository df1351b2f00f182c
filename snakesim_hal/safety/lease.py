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

    def is_live(self, now_ns: int) -> bool:
        """Return whether the lease is held at this time."""
        return self.holder is not None and now_ns <= self.expires_ns


@dataclass(frozen=True)
class LeaseDecision:
    """The decision about a request."""

    lease: Lease  # after the request
    refusal: str | None = None  # why it was refused; None: it was granted
    changed_hands: bool = False
    refusal_word: str | None = None  # the refusal as one word


def decide_lease_request(lease: Lease, request: LeaseRequest, now_ns: int, term_ns: int) -> LeaseDecision:
    """Decide a request. While a lease is live, it is granted only to its holder, or to a higher priority.

    Args:
        lease: the lease before the request.
        request: acquire, renew or release.
        now_ns: safety time.
        term_ns: how long a lease lasts without a renewal.
    """
    is_holder = lease.is_live(now_ns) and lease.holder == request.holder and lease.epoch == request.epoch
    match request.action:
        case "acquire":
            if lease.is_live(now_ns) and request.priority <= lease.priority:
                left_ms = (lease.expires_ns - now_ns) / 1e6
                return LeaseDecision(
                    lease,
                    f"held by {lease.holder} (epoch {lease.epoch}, priority {lease.priority}) for another "
                    f"{left_ms:.0f} ms; stop it, or ask with a priority above {lease.priority}",
                    refusal_word="lease_held",
                )
            acquired = Lease(request.holder, lease.epoch + 1, request.priority, now_ns + term_ns)
            return LeaseDecision(acquired, changed_hands=True)
        case "renew":
            if not is_holder:
                return _refuse_other_holder(lease, request, "acquire the lease first")
            return LeaseDecision(renew_lease(lease, now_ns, term_ns))
        case "release":
            if not is_holder:
                return _refuse_other_holder(lease, request, "nothing to release")
            return LeaseDecision(free_lease(lease), changed_hands=True)


def _refuse_other_holder(lease: Lease, request: LeaseRequest, advice: str) -> LeaseDecision:
    """Refuse a request of a client that does not hold the lease."""
    return LeaseDecision(
        lease, f"{request.holder} does not hold epoch {request.epoch}; {advice}", refusal_word="not_holder"
    )


def renew_lease(lease: Lease, now_ns: int, term_ns: int) -> Lease:
    """Return the lease, extended by a term from now on."""
    return replace(lease, expires_ns=now_ns + term_ns)


def free_lease(lease: Lease) -> Lease:
    """Return the free lease. The epoch stays, so that later commands of the last holder are rejected."""
    return Lease(epoch=lease.epoch)
