"""Short fuzz runs in this process; `python -m verification.fuzz` is the long one."""

from pathlib import Path

import pytest

from verification.fuzz.all_inputs import open_all_inputs
from verification.fuzz.bus import MUTATIONS, fuzz_bus
from verification.fuzz.decoders import fuzz_decoders
from verification.fuzz.inputs import fuzz_inputs

PAYLOAD_COUNT = 20_000
PAYLOADS_PER_INPUT = 50
FRAME_COUNT = 4_000
MAX_GROWTH_MB = 16


def test_fuzz_payloads_never_crash_decoders_or_their_users() -> None:
    report = fuzz_decoders(PAYLOAD_COUNT, seed=7)
    assert sum(outcomes.total() for outcomes in report.outcomes.values()) == PAYLOAD_COUNT
    all_outcomes = {outcome for outcomes in report.outcomes.values() for outcome in outcomes}
    assert all_outcomes == {"decoded", "malformed", "unknown_message", "unknown_version"}
    expected_reactions = {"JointCommand: accepted", "LeaseRequest: yes", "LifecycleRequest: no"}
    assert expected_reactions <= set(report.reactions)
    assert report.outcomes["valid"]["malformed"] == 0
    assert report.outcomes["type-confused"]["malformed"] > 0
    assert report.growth_mb < MAX_GROWTH_MB


@pytest.mark.slow
def test_fuzz_payloads_are_refused_by_every_input(tmp_path: Path) -> None:
    with open_all_inputs(tmp_path) as inputs:
        reports = fuzz_inputs(inputs, PAYLOADS_PER_INPUT, seed=4)
    assert len(reports) >= 18
    for name, report in reports.items():
        assert report.outcomes.total() == PAYLOADS_PER_INPUT, name
    assert reports["motion capture"].outcomes["malformed"] > 0
    assert reports["motion capture"].outcomes["reordered"] > 0
    for name in (
        "--set",
        "a fault",
        "a robot file",
        "a scenario",
        "config.json",
        "a run's host.json",
    ):
        assert reports[name].outcomes["refused"] > 0, name
        assert reports[name].outcomes["accepted"] > 0, name


@pytest.mark.timeout(120)
def test_fuzz_bus_frames_never_raise_in_driver_or_modules() -> None:
    counts = fuzz_bus(FRAME_COUNT, seed=7)
    for mutation in MUTATIONS:
        assert counts[mutation] > 0, mutation
    assert counts["openings"] >= 2
    assert counts["fault second_host"] > 0
