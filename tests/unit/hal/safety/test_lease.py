"""The lease: one holder at a time, for one term, and a new epoch for every new holder."""

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

TERM = 50
HELD = CommandLease(holder="control", epoch=4, priority=100, expires_ns=1000)
FREE = CommandLease(epoch=4)
DURING, AFTER = 990, 1001


def request(
    action: str, holder: str = "control", epoch: int = 4, priority: int = 100
) -> LeaseRequest:
    return LeaseRequest(action=action, holder=holder, epoch=epoch, priority=priority)  # pyright: ignore[reportArgumentType]


def taken(holder: str, now: int, priority: int = 100) -> LeaseDecision:
    return LeaseDecision(CommandLease(holder, 5, priority, now + TERM), None, True)


GRANTED = {
    "acquire a free lease": (
        FREE,
        request("acquire", "teleop", 0),
        DURING,
        taken("teleop", DURING),
    ),
    "acquire a lease that ran out": (
        HELD,
        request("acquire", "teleop", 0),
        AFTER,
        taken("teleop", AFTER),
    ),
    "acquire again after it ran out": (HELD, request("acquire"), AFTER, taken("control", AFTER)),
    "preempt": (HELD, request("acquire", "teleop", 0, 101), DURING, taken("teleop", DURING, 101)),
    "renew": (
        HELD,
        request("renew"),
        DURING,
        LeaseDecision(CommandLease("control", 4, 100, DURING + TERM)),
    ),
    "renew at the last moment": (
        HELD,
        request("renew"),
        1000,
        LeaseDecision(CommandLease("control", 4, 100, 1000 + TERM)),
    ),
    "release": (HELD, request("release"), DURING, LeaseDecision(CommandLease(epoch=4), None, True)),
}


@pytest.mark.parametrize("case", GRANTED)
def test_granted(case: str) -> None:
    lease, asked, now, ruling = GRANTED[case]
    assert decide_lease_request(lease, asked, now, TERM) == ruling


REFUSED = {
    "acquire, held at the same priority": (
        HELD,
        request("acquire", "teleop", 0),
        DURING,
        "priority above 100",
    ),
    "acquire, held at a higher one": (
        HELD,
        request("acquire", "teleop", 0, 99),
        DURING,
        "held by control (epoch 4",
    ),
    "acquire one's own": (HELD, request("acquire"), DURING, "held by control"),
    "renew another's": (HELD, request("renew", "teleop"), DURING, "teleop does not hold epoch 4"),
    "renew an old epoch": (HELD, request("renew", epoch=3), DURING, "does not hold epoch 3"),
    "renew what ran out": (HELD, request("renew"), AFTER, "acquire the lease first"),
    "renew nothing": (FREE, request("renew"), DURING, "does not hold"),
    "release another's": (HELD, request("release", "teleop"), DURING, "nothing to release"),
    "release an old epoch": (HELD, request("release", epoch=3), DURING, "does not hold epoch 3"),
    "release what ran out": (HELD, request("release"), AFTER, "nothing to release"),
    "priority does not renew": (HELD, request("renew", "teleop", 4, 255), DURING, "does not hold"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_and_nothing_changed(case: str) -> None:
    lease, asked, now, words = REFUSED[case]
    ruling = decide_lease_request(lease, asked, now, TERM)
    assert ruling.lease == lease
    assert not ruling.has_holder_changed
    assert ruling.refusal is not None
    assert words in ruling.refusal
    assert ruling.refusal_code == ("lease_held" if asked.action == "acquire" else "not_holder")


def test_the_refusal_says_how_long_it_may_take() -> None:
    lease = CommandLease("control", 4, 100, 50_000_000)
    ruling = decide_lease_request(lease, request("acquire", "teleop"), 20_000_000, TERM)
    assert ruling.refusal is not None
    assert "for another 30 ms" in ruling.refusal


def test_live_until_the_last_nanosecond() -> None:
    assert HELD.is_held(1000)
    assert not HELD.is_held(1001)
    assert not FREE.is_held(0)
    assert free_lease(HELD) == CommandLease(epoch=4)
    assert renew_lease(HELD, 2000, TERM).expires_ns == 2050


def test_nobody_changes_a_lease_in_place() -> None:
    for held in (HELD, LeaseDecision(HELD)):
        with pytest.raises(dataclasses.FrozenInstanceError):
            held.lease = FREE  # pyright: ignore[reportAttributeAccessIssue]
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
    lease, now, holders = CommandLease(), 0, {}
    for action, holder, epoch, priority, passes in history:
        now += passes
        before = lease
        ruling = decide_lease_request(lease, request(action, holder, epoch, priority), now, TERM)
        lease = ruling.lease
        assert lease.epoch in (before.epoch, before.epoch + 1)
        assert (lease.epoch > before.epoch) == (
            ruling.has_holder_changed and lease.holder is not None
        )
        assert lease.expires_ns <= now + TERM or lease == before
        if lease.holder is not None:
            assert holders.setdefault(lease.epoch, lease.holder) == lease.holder
        if before.is_held(now) and ruling.has_holder_changed and lease.holder is not None:
            assert priority > before.priority
