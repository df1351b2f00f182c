"""Injected faults of outgoing messages: loss, duplication, reordering, delay, repetition and corruption."""

import random
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.errors import WireError
from snakesim_hal.faults.disturbance import (
    MAX_REPEATS_PER_CALL,
    MessageDisturbance,
    corrupt_payload,
)
from snakesim_hal.model.fault_kinds import FaultInjection, validate_and_complete_injection
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import JointCommand
from snakesim_testing.hal.small_robots import make_description, make_joint_command

KEY = "sensor/joints"
MESSAGES = [b"%05d" % i for i in range(400)]
STEP_S = 0.01


def make_fault(kind: str, amount: float | None = None) -> FaultInjection:
    """Return a fault of the messages with the tested key."""
    return validate_and_complete_injection(FaultInjection(kind, KEY, amount=amount))


def make_disturbance(*faults: FaultInjection, seed: str = "1") -> MessageDisturbance:
    """Return a disturbance in which these faults have started at 0 s."""
    disturbance = MessageDisturbance(seed)
    for fault in faults:
        disturbance.start_fault(fault, 0.0)
    return disturbance


def send_messages(
    disturbance: MessageDisturbance, messages: list[bytes] = MESSAGES, step_s: float = STEP_S
) -> list[tuple[float, bytes]]:
    """Send messages at fixed intervals, and return the time and payload of each that leaves, to the last late one."""
    sent_payloads: list[tuple[float, bytes]] = []
    for i, message in enumerate(messages):
        now_s = i * step_s
        sent_payloads += [
            (now_s, payload)
            for payload in disturbance.pop_due_payloads(now_s)
            + disturbance.disturb_payload(message, now_s)
        ]
    while (now_s := disturbance.next_due_s()) < inf:
        sent_payloads += [(now_s, payload) for payload in disturbance.pop_due_payloads(now_s)]
    return sent_payloads


fault_lists = st.lists(
    st.one_of(
        st.builds(
            make_fault, st.sampled_from(["drop", "duplicate", "reorder"]), st.floats(0.0, 1.0)
        ),
        st.builds(make_fault, st.just("delay"), st.floats(0.0, 0.2)),
    ),
    max_size=4,
)


@given(fault_lists, st.text(max_size=5))
def test_disturbance_never_invents_or_advances_messages(
    chosen: list[FaultInjection], seed: str
) -> None:
    disturbance = make_disturbance(*chosen, seed=seed)
    sent_payloads = send_messages(disturbance, MESSAGES[:40])
    assert {payload for _, payload in sent_payloads} <= set(MESSAGES[:40])
    assert all(sent_s >= int(payload) * STEP_S for sent_s, payload in sent_payloads)
    assert [sent_s for sent_s, _ in sent_payloads] == sorted(sent_s for sent_s, _ in sent_payloads)
    kinds = {fault.kind for fault in chosen}
    payloads = [payload for _, payload in sent_payloads]
    if "duplicate" not in kinds:
        assert len(set(payloads)) == len(payloads)
    if "reorder" not in kinds:
        assert payloads == sorted(payloads), "late messages stay in order"
    if not kinds & {"drop", "reorder"}:
        assert set(payloads) == set(MESSAGES[:40])


@given(fault_lists, st.integers(0, 39))
def test_disturbance_after_its_end_passes_messages_unchanged(
    chosen: list[FaultInjection], end_index: int
) -> None:
    disturbance = make_disturbance(*chosen)
    for message in MESSAGES[:end_index]:
        disturbance.disturb_payload(message, 0.0)
    for fault in chosen:
        disturbance.end_fault(fault.kind, 0.0)
    while disturbance.next_due_s() < inf:
        disturbance.pop_due_payloads(disturbance.next_due_s())
    assert disturbance.is_over
    assert disturbance.disturb_payload(b"new", 9.0) == [b"new"]
    assert disturbance.is_over


def test_disturbance_depends_only_on_its_seed() -> None:
    first, same_seed, other_seed = (
        send_messages(make_disturbance(make_fault("drop", 0.5), seed=seed))
        for seed in ("1", "1", "2")
    )
    assert first == same_seed != other_seed


@pytest.mark.parametrize(("kind", "count_change"), [("drop", -1), ("duplicate", 1)])
@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 0.5, 0.9, 1.0])
def test_disturbance_drops_and_duplicates_the_configured_fraction(
    kind: str, count_change: int, fraction: float
) -> None:
    payloads = [
        payload for _, payload in send_messages(make_disturbance(make_fault(kind, fraction)))
    ]
    changed_count = count_change * (len(payloads) - len(MESSAGES))
    assert changed_count == pytest.approx(
        fraction * len(MESSAGES), abs=4 * (fraction * (1 - fraction) * len(MESSAGES)) ** 0.5
    )
    assert payloads == sorted(payloads)


def test_disturbance_reordered_message_follows_its_successor() -> None:
    payloads = [payload for _, payload in send_messages(make_disturbance(make_fault("reorder")))]
    assert payloads == [
        payload for i in range(0, 400, 2) for payload in (MESSAGES[i + 1], MESSAGES[i])
    ]


def test_disturbance_held_message_is_sent_when_reordering_ends() -> None:
    disturbance = make_disturbance(make_fault("reorder"))
    assert disturbance.disturb_payload(b"1", 0.0) == []
    assert disturbance.end_fault("reorder", 0.0) == [b"1"]
    assert disturbance.is_over


def test_disturbance_delay_has_configured_length_and_keeps_order() -> None:
    disturbance = make_disturbance(make_fault("delay", 0.05))
    sent_payloads = send_messages(disturbance)
    delays_s = [sent_s - int(payload) * STEP_S for sent_s, payload in sent_payloads]
    assert len(delays_s) == len(MESSAGES)
    assert min(delays_s) > 0.0499
    assert max(delays_s) < 0.0501 + STEP_S
    disturbance.disturb_payload(b"late", 10.0)
    assert disturbance.end_fault("delay", 10.01) == []
    assert not disturbance.is_over
    assert disturbance.disturb_payload(b"prompt", 10.02) == []
    assert disturbance.pop_due_payloads(10.049) == []
    assert disturbance.pop_due_payloads(10.05) == [b"late", b"prompt"]
    assert disturbance.is_over


def test_disturbance_flood_repeats_the_newest_message_at_its_rate() -> None:
    disturbance = make_disturbance(make_fault("flood", 1000.0))
    assert disturbance.next_due_s() == inf, "there is no message to repeat yet"
    assert disturbance.disturb_payload(b"1", 1.0) == [b"1"]
    repeated = [disturbance.pop_due_payloads(1.0 + i / 1000) for i in range(100)]
    assert 100 <= sum(map(len, repeated)) <= 101
    disturbance.disturb_payload(b"2", 1.2)
    assert set(disturbance.pop_due_payloads(1.3)) == {b"2"}
    assert len(disturbance.pop_due_payloads(99.0)) == MAX_REPEATS_PER_CALL, (
        "a pause is not caught up"
    )
    assert disturbance.pop_due_payloads(99.0) == []
    disturbance.end_fault("flood", 99.0)
    assert disturbance.is_over
    assert disturbance.pop_due_payloads(100.0) == []


# --- bytes ---------------------------------------------------------------------------------------------------


@given(st.binary(max_size=200), st.integers(0, 2**32))
def test_corrupted_payload_differs_from_the_original(payload: bytes, seed: int) -> None:
    assert corrupt_payload(payload, random.Random(seed)) != payload


def test_disturbance_corrupted_payloads_are_refused_by_decoders() -> None:
    payload = encode(make_joint_command(make_description(), 0.1))
    decoder = MessageDecoder(JointCommand)
    rng = random.Random(5)
    lengths: set[int] = set()
    refused_count = 0
    accepted_count = 0
    for _ in range(20_000):
        corrupted = corrupt_payload(payload, rng)
        lengths.add(len(corrupted))
        try:
            decoder.decode(corrupted, format_encoding(JointCommand))
            accepted_count += 1
        except WireError:
            refused_count += 1
    assert min(lengths) == 0
    assert max(lengths) > len(payload)
    assert len(lengths) > 100
    assert refused_count > 5_000
    assert accepted_count > 1_000, "some remain valid commands, which the limiter must handle"


def test_disturbance_corrupts_the_configured_fraction() -> None:
    payloads = [
        payload for _, payload in send_messages(make_disturbance(make_fault("corrupt", 0.5)))
    ]
    unchanged_count = sum(
        payload == message for payload, message in zip(payloads, MESSAGES, strict=True)
    )
    assert unchanged_count == pytest.approx(200, abs=40)
