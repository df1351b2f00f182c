"""The lease: the right to command. One holder at a time; every accepted command renews it. Pure; time is passed in."""

from dataclasses import dataclass

from snakesim_hal.wire.messages import LeaseRequest


@dataclass(frozen=True)
class CommandLease:
    """The right to command, and until when. `epoch` grows with every new holder, so old commands are void."""

    holder: str | None = None
    epoch: int = 0
    priority: int = 0
    expires_ns: int = 0

    def is_held(self, now_ns: int) -> bool:
        """Return whether the lease is held at this time."""
        return self.holder is not None and now_ns <= self.expires_ns


@dataclass(frozen=True)
class LeaseDecision:
    """The decision about a lease request."""

    lease: CommandLease  # after the request
    refusal: str | None = None  # text why the request is refused; None if it is granted
    has_holder_changed: bool = False
    refusal_code: str | None = None  # the reason of the refusal as one word


def decide_lease_request(
    lease: CommandLease, request: LeaseRequest, now_ns: int, lease_duration_ns: int
) -> LeaseDecision:
    """Grant or refuse a request to acquire, renew or release a lease.

    While the lease is held, only its holder may renew or release it, and only a client with a higher priority may
    acquire it.

    Args:
        lease: Lease before the request.
        request: Request of a client.
        now_ns: Safety time in ns.
        lease_duration_ns: Duration of a lease without a renewal, in ns.
    """
    is_holder = (
        lease.is_held(now_ns) and lease.holder == request.holder and lease.epoch == request.epoch
    )
    match request.action:
        case "acquire":
            if lease.is_held(now_ns) and request.priority <= lease.priority:
                remaining_ms = (lease.expires_ns - now_ns) / 1e6
                return LeaseDecision(
                    lease,
                    f"held by {lease.holder} (epoch {lease.epoch}, priority {lease.priority}) for another "
                    f"{remaining_ms:.0f} ms; stop it, or ask with a priority above {lease.priority}",
                    refusal_code="lease_held",
                )
            acquired = CommandLease(
                request.holder, lease.epoch + 1, request.priority, now_ns + lease_duration_ns
            )
            return LeaseDecision(acquired, has_holder_changed=True)
        case "renew":
            if not is_holder:
                return _make_not_holder_refusal(lease, request, "acquire the lease first")
            return LeaseDecision(renew_lease(lease, now_ns, lease_duration_ns))
        case "release":
            if not is_holder:
                return _make_not_holder_refusal(lease, request, "nothing to release")
            return LeaseDecision(free_lease(lease), has_holder_changed=True)


def _make_not_holder_refusal(
    lease: CommandLease, request: LeaseRequest, advice: str
) -> LeaseDecision:
    """Return the refusal of a request of a client that does not hold the lease."""
    return LeaseDecision(
        lease,
        f"{request.holder} does not hold epoch {request.epoch}; {advice}",
        refusal_code="not_holder",
    )


def renew_lease(lease: CommandLease, now_ns: int, lease_duration_ns: int) -> CommandLease:
    """Return the lease with an expiry time one lease duration from now."""
    return CommandLease(lease.holder, lease.epoch, lease.priority, now_ns + lease_duration_ns)


def free_lease(lease: CommandLease) -> CommandLease:
    """Return a lease without a holder. Its epoch stays, so that later commands of the last holder are rejected."""
    return CommandLease(epoch=lease.epoch)
