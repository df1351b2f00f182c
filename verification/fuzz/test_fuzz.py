"""A short fuzz run; `python -m verification.fuzz` is the long one."""

from pathlib import Path

import pytest

from verification.fuzz import bus, inputs
from verification.fuzz.run import run

PAYLOADS = 20_000
PAYLOADS_EACH = 50  # into every file and the like
FRAMES = 4_000


def test_fuzz_payloads_never_crash_decoders_or_their_users() -> None:
    report = run(PAYLOADS, seed=7)
    assert sum(outcomes.total() for outcomes in report.outcomes.values()) == PAYLOADS
    refused = {reason for outcomes in report.outcomes.values() for reason in outcomes}
    assert refused == {"taken", "malformed", "unknown_message", "unknown_version"}
    assert {"JointCommand: accepted", "LeaseRequest: yes", "LifecycleRequest: no"} <= set(
        report.answers
    )
    assert (
        report.outcomes["valid"]["malformed"] == 0 < report.outcomes["type-confused"]["malformed"]
    )
    assert report.growth_mb < 16


@pytest.mark.slow
def test_no_file_flag_or_datagram_does_more_than_be_refused(tmp_path: Path) -> None:
    with inputs.all_inputs(tmp_path) as found:
        outcomes = inputs.run(found, PAYLOADS_EACH, seed=4)
    assert len(outcomes) >= 18 and all(
        outcome.words.total() == PAYLOADS_EACH for outcome in outcomes.values()
    )
    assert (
        outcomes["motion capture"].words["malformed"]
        > 0
        < outcomes["motion capture"].words["reordered"]
    )
    for name in (
        "--set",
        "a fault",
        "a robot file",
        "a scenario",
        "config.json",
        "a run's host.json",
    ):
        assert outcomes[name].words["refused"] > 0 < outcomes[name].words["taken"], name


@pytest.mark.timeout(120)
def test_fuzz_bus_frames_never_raise_in_driver_or_modules() -> None:
    words = bus.run(FRAMES, seed=7)
    assert all(words[kind] > 0 for kind in bus.KINDS) and words["openings"] >= 2
    assert words["fault second_host"] > 0
