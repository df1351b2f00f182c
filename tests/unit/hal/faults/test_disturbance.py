"""Messages that go wrong on their way out: what may come of them, whatever happens."""

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


def on(kind: str, amount: float | None = None) -> FaultInjection:
    return validate_and_complete_injection(FaultInjection(kind, KEY, amount=amount))


def disturbed(*faults: FaultInjection, seed: str = "1") -> MessageDisturbance:
    made = MessageDisturbance(seed)
    for fault in faults:
        made.start_fault(fault, 0.0)
    return made


def sent(
    way: MessageDisturbance, messages: list[bytes] = MESSAGES, step_s: float = STEP_S
) -> list[tuple[float, bytes]]:
    """(when, what) of everything that goes out, to the last that is late."""
    out: list[tuple[float, bytes]] = []
    for i, message in enumerate(messages):
        now_s = i * step_s
        out += [
            (now_s, payload)
            for payload in way.pop_due_payloads(now_s) + way.disturb_payload(message, now_s)
        ]
    while (now_s := way.next_due_s()) < inf:
        out += [(now_s, payload) for payload in way.pop_due_payloads(now_s)]
    return out


faults = st.lists(
    st.one_of(
        st.builds(on, st.sampled_from(["drop", "duplicate", "reorder"]), st.floats(0.0, 1.0)),
        st.builds(on, st.just("delay"), st.floats(0.0, 0.2)),
    ),
    max_size=4,
)


@given(faults, st.text(max_size=5))
def test_nothing_is_invented_and_nothing_comes_before_its_time(
    chosen: list[FaultInjection], seed: str
) -> None:
    way = disturbed(*chosen, seed=seed)
    out = sent(way, MESSAGES[:40])
    assert {payload for _, payload in out} <= set(MESSAGES[:40])
    assert all(when >= int(payload) * STEP_S for when, payload in out)
    assert [when for when, _ in out] == sorted(when for when, _ in out)
    kinds = {fault.kind for fault in chosen}
    payloads = [payload for _, payload in out]
    if "duplicate" not in kinds:
        assert len(set(payloads)) == len(payloads)
    if "reorder" not in kinds:
        assert payloads == sorted(payloads), "late, but in order"
    if not kinds & {"drop", "reorder"}:
        assert set(payloads) == set(MESSAGES[:40])


@given(faults, st.integers(0, 39))
def test_when_all_is_over_everything_is_as_before(chosen: list[FaultInjection], at: int) -> None:
    way = disturbed(*chosen)
    for message in MESSAGES[:at]:
        way.disturb_payload(message, 0.0)
    for fault in chosen:
        way.end_fault(fault.kind, 0.0)
    while way.next_due_s() < inf:
        way.pop_due_payloads(way.next_due_s())
    assert way.is_over
    assert way.disturb_payload(b"new", 9.0) == [b"new"]
    assert way.is_over


def test_disturbance_depends_only_on_its_seed() -> None:
    first, again, other = (sent(disturbed(on("drop", 0.5), seed=seed)) for seed in ("1", "1", "2"))
    assert first == again != other


@pytest.mark.parametrize(("kind", "change"), [("drop", -1), ("duplicate", 1)])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.9, 1.0])
def test_disturbance_drops_and_duplicates_the_configured_fraction(
    kind: str, change: int, share: float
) -> None:
    payloads = [payload for _, payload in sent(disturbed(on(kind, share)))]
    struck = change * (len(payloads) - len(MESSAGES))
    assert struck == pytest.approx(
        share * len(MESSAGES), abs=4 * (share * (1 - share) * len(MESSAGES)) ** 0.5
    )
    assert payloads == sorted(payloads)


def test_disturbance_reordered_message_follows_its_successor() -> None:
    payloads = [payload for _, payload in sent(disturbed(on("reorder")))]
    assert payloads == [
        payload for i in range(0, 400, 2) for payload in (MESSAGES[i + 1], MESSAGES[i])
    ]


def test_a_held_message_goes_out_when_the_reordering_ends() -> None:
    way = disturbed(on("reorder"))
    assert way.disturb_payload(b"1", 0.0) == []
    assert way.end_fault("reorder", 0.0) == [b"1"]
    assert way.is_over


def test_disturbance_delay_has_configured_length_and_keeps_order() -> None:
    way = disturbed(on("delay", 0.05))
    out = sent(way)
    late_s = [when - int(payload) * STEP_S for when, payload in out]
    assert len(late_s) == len(MESSAGES)
    assert min(late_s) > 0.0499
    assert max(late_s) < 0.0501 + STEP_S
    way.disturb_payload(b"late", 10.0)
    assert way.end_fault("delay", 10.01) == []
    assert not way.is_over
    assert way.disturb_payload(b"prompt", 10.02) == []
    assert way.pop_due_payloads(10.049) == []
    assert way.pop_due_payloads(10.05) == [b"late", b"prompt"]
    assert way.is_over


def test_a_flood_repeats_the_newest_message_at_its_rate() -> None:
    way = disturbed(on("flood", 1000.0))
    assert way.next_due_s() == inf, "there is nothing to repeat yet"
    assert way.disturb_payload(b"1", 1.0) == [b"1"]
    repeated = [way.pop_due_payloads(1.0 + i / 1000) for i in range(100)]
    assert 100 <= sum(map(len, repeated)) <= 101
    way.disturb_payload(b"2", 1.2)
    assert (
        set(way.pop_due_payloads(1.3)) == {b"2"}
        and len(way.pop_due_payloads(99.0)) == MAX_REPEATS_PER_CALL
    ), "a hiccup is not made up for"
    assert way.pop_due_payloads(99.0) == []
    way.end_fault("flood", 99.0)
    assert way.is_over
    assert way.pop_due_payloads(100.0) == []


# --- bytes ---------------------------------------------------------------------------------------------------


@given(st.binary(max_size=200), st.integers(0, 2**32))
def test_corrupt_bytes_are_other_bytes(payload: bytes, seed: int) -> None:
    assert corrupt_payload(payload, random.Random(seed)) != payload


def test_disturbance_corrupted_payloads_are_refused_by_decoders() -> None:
    payload, decoder, rng = (
        encode(make_joint_command(make_description(), 0.1)),
        MessageDecoder(JointCommand),
        random.Random(5),
    )
    lengths, refused, taken = set(), 0, 0
    for _ in range(20_000):
        wrong = corrupt_payload(payload, rng)
        lengths.add(len(wrong))
        try:
            decoder.decode(wrong, format_encoding(JointCommand))
            taken += 1
        except WireError:
            refused += 1
    assert min(lengths) == 0
    assert max(lengths) > len(payload)
    assert len(lengths) > 100
    assert refused > 5_000 and taken > 1_000, (
        "some still make sense: what those ask for is the limiter's to judge"
    )


def test_corruption_strikes_as_often_as_it_says() -> None:
    payloads = [payload for _, payload in sent(disturbed(on("corrupt", 0.5)))]
    kept = sum(payload == message for payload, message in zip(payloads, MESSAGES, strict=True))
    assert kept == pytest.approx(200, abs=40)
