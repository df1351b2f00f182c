"""The command lease has one holder at a time, for one term, and a new epoch for each new holder."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.safety.lease import (
    CommandLease,
    LeaseDecision,
    decide_lease_request,
    free_lease,
    renew_lease,
)
from snakesim_hal.wire.messages import LeaseRequest

TERM_NS = 50  # ns
HELD = CommandLease(holder="control", epoch=4, priority=100, expires_ns=1000)
FREE = CommandLease(epoch=4)
DURING_LEASE_NS = 990
AFTER_LEASE_NS = 1001


def make_request(
    action: str, holder: str = "control", epoch: int = 4, priority: int = 100
) -> LeaseRequest:
    return LeaseRequest(action=action, holder=holder, epoch=epoch, priority=priority)  # pyright: ignore[reportArgumentType]


def grant_to_new_holder(holder: str, now: int, priority: int = 100) -> LeaseDecision:
    """Return the decision that gives the lease to a new holder."""
    return LeaseDecision(CommandLease(holder, 5, priority, now + TERM_NS), None, True)


GRANTED = {
    "acquire a free lease": (
        FREE,
        make_request("acquire", "teleop", 0),
        DURING_LEASE_NS,
        grant_to_new_holder("teleop", DURING_LEASE_NS),
    ),
    "acquire a lease that ran out": (
        HELD,
        make_request("acquire", "teleop", 0),
        AFTER_LEASE_NS,
        grant_to_new_holder("teleop", AFTER_LEASE_NS),
    ),
    "acquire again after it ran out": (
        HELD,
        make_request("acquire"),
        AFTER_LEASE_NS,
        grant_to_new_holder("control", AFTER_LEASE_NS),
    ),
    "preempt": (
        HELD,
        make_request("acquire", "teleop", 0, 101),
        DURING_LEASE_NS,
        grant_to_new_holder("teleop", DURING_LEASE_NS, 101),
    ),
    "renew": (
        HELD,
        make_request("renew"),
        DURING_LEASE_NS,
        LeaseDecision(CommandLease("control", 4, 100, DURING_LEASE_NS + TERM_NS)),
    ),
    "renew at the last moment": (
        HELD,
        make_request("renew"),
        1000,
        LeaseDecision(CommandLease("control", 4, 100, 1000 + TERM_NS)),
    ),
    "release": (
        HELD,
        make_request("release"),
        DURING_LEASE_NS,
        LeaseDecision(CommandLease(epoch=4), None, True),
    ),
}


@pytest.mark.parametrize("case", GRANTED)
def test_lease_valid_request_is_granted(case: str) -> None:
    lease, lease_request, now, expected = GRANTED[case]
    assert decide_lease_request(lease, lease_request, now, TERM_NS) == expected


REFUSED = {
    "acquire, held at the same priority": (
        HELD,
        make_request("acquire", "teleop", 0),
        DURING_LEASE_NS,
        "priority above 100",
    ),
    "acquire, held at a higher one": (
        HELD,
        make_request("acquire", "teleop", 0, 99),
        DURING_LEASE_NS,
        "held by control (epoch 4",
    ),
    "acquire one's own": (HELD, make_request("acquire"), DURING_LEASE_NS, "held by control"),
    "renew another's": (
        HELD,
        make_request("renew", "teleop"),
        DURING_LEASE_NS,
        "teleop does not hold epoch 4",
    ),
    "renew an old epoch": (
        HELD,
        make_request("renew", epoch=3),
        DURING_LEASE_NS,
        "does not hold epoch 3",
    ),
    "renew what ran out": (HELD, make_request("renew"), AFTER_LEASE_NS, "acquire the lease first"),
    "renew nothing": (FREE, make_request("renew"), DURING_LEASE_NS, "does not hold"),
    "release another's": (
        HELD,
        make_request("release", "teleop"),
        DURING_LEASE_NS,
        "nothing to release",
    ),
    "release an old epoch": (
        HELD,
        make_request("release", epoch=3),
        DURING_LEASE_NS,
        "does not hold epoch 3",
    ),
    "release what ran out": (HELD, make_request("release"), AFTER_LEASE_NS, "nothing to release"),
    "priority does not renew": (
        HELD,
        make_request("renew", "teleop", 4, 255),
        DURING_LEASE_NS,
        "does not hold",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_lease_invalid_request_is_refused_without_change(case: str) -> None:
    lease, lease_request, now, expected_text = REFUSED[case]
    decision = decide_lease_request(lease, lease_request, now, TERM_NS)
    assert decision.lease == lease
    assert not decision.has_holder_changed
    assert decision.refusal is not None
    assert expected_text in decision.refusal
    assert decision.refusal_code == (
        "lease_held" if lease_request.action == "acquire" else "not_holder"
    )


def test_lease_refusal_contains_the_remaining_time() -> None:
    lease = CommandLease("control", 4, 100, 50_000_000)
    decision = decide_lease_request(lease, make_request("acquire", "teleop"), 20_000_000, TERM_NS)
    assert decision.refusal is not None
    assert "for another 30 ms" in decision.refusal


def test_lease_is_held_until_exactly_its_end() -> None:
    assert HELD.is_held(1000)
    assert not HELD.is_held(1001)
    assert not FREE.is_held(0)
    assert free_lease(HELD) == CommandLease(epoch=4)
    assert renew_lease(HELD, 2000, TERM_NS).expires_ns == 2050


def test_lease_and_decision_are_immutable() -> None:
    for frozen_value in (HELD, LeaseDecision(HELD)):
        with pytest.raises(dataclasses.FrozenInstanceError):
            frozen_value.lease = FREE  # pyright: ignore[reportAttributeAccessIssue]
    assert CommandLease() == CommandLease(None, 0, 0, 0)


REQUESTS = st.tuples(
    st.sampled_from(["acquire", "renew", "release"]),
    st.sampled_from(["control", "teleop"]),
    st.integers(0, 6),
    st.sampled_from([50, 100, 200]),
    st.integers(0, 80),
)


@given(st.lists(REQUESTS, max_size=30))
def test_lease_every_holder_in_any_history_has_unique_epoch(
    history: list[tuple[str, str, int, int, int]],
) -> None:
    lease = CommandLease()
    now_ns = 0
    holders: dict[int, str] = {}
    for action, holder, epoch, priority, elapsed_ns in history:
        now_ns += elapsed_ns
        lease_before = lease
        decision = decide_lease_request(
            lease, make_request(action, holder, epoch, priority), now_ns, TERM_NS
        )
        lease = decision.lease
        assert lease.epoch in (lease_before.epoch, lease_before.epoch + 1)
        assert (lease.epoch > lease_before.epoch) == (
            decision.has_holder_changed and lease.holder is not None
        )
        assert lease.expires_ns <= now_ns + TERM_NS or lease == lease_before
        if lease.holder is not None:
            assert holders.setdefault(lease.epoch, lease.holder) == lease.holder
        if (
            lease_before.is_held(now_ns)
            and decision.has_holder_changed
            and lease.holder is not None
        ):
            assert priority > lease_before.priority
