"""A short fuzz run; `python -m tests.fuzz` is the long one."""

from tests.fuzz.run import run

PAYLOADS = 20_000


def test_no_payload_brings_a_decoder_or_what_stands_behind_it_down() -> None:
    report = run(PAYLOADS, seed=7)
    assert sum(outcomes.total() for outcomes in report.outcomes.values()) == PAYLOADS
    refused = {reason for outcomes in report.outcomes.values() for reason in outcomes}
    assert refused == {"taken", "malformed", "unknown_message", "unknown_version"}
    assert {"JointCommand: accepted", "LeaseRequest: yes", "LifecycleRequest: no"} <= set(report.answers)
    assert report.outcomes["valid"]["malformed"] == 0 < report.outcomes["type-confused"]["malformed"]
    assert report.growth_mb < 16
