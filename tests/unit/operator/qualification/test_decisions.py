"""The verdicts of a qualification on measured values; a value that is unknown never confirms a claim."""

import math
import re
from pathlib import Path
from typing import Any

import pytest

from snakesim_operator.features.qualification.procedures import PROCEDURES
from snakesim_operator.features.qualification.protocol.checks import (
    Check,
    combine_verdicts,
    describe_check,
    judge_check,
)
from snakesim_operator.features.qualification.protocol.claims import (
    CLAIM_BY_ID,
    CLAIMS,
    list_claims,
)
from snakesim_operator.features.qualification.protocol.steps import (
    STEPS,
    Bounds,
    describe_criterion,
)
from snakesim_operator.features.qualification.protocol.torque_timeline import (
    TorqueReading,
    make_timeline,
)

DOCS = Path(__file__).parents[4] / "docs"
BOUNDS = Bounds(has_watchdog=True, watchdog_s=0.1, period_s=0.02)


@pytest.mark.parametrize(
    ("value", "bounds", "verdict"),
    [
        (0.1, {"maximum": 0.1}, "confirmed"),
        (0.11, {"maximum": 0.1}, "refuted"),
        (0.5, {"minimum": 1.0}, "refuted"),
        (1.0, {}, "confirmed"),
        (None, {"maximum": 0.1}, "unknown"),
        (math.nan, {"maximum": 0.1}, "unknown"),
        (math.inf, {"minimum": 0.1}, "unknown"),
        ("", {}, "unknown"),
        ("", {"equals": "yes"}, "unknown"),
        ("yes", {"equals": "yes"}, "confirmed"),
        ("no", {"equals": "yes"}, "refuted"),
        ("A1", {}, "confirmed"),
    ],
)
def test_check_confirms_only_value_within_its_bounds(
    value: float | str | None, bounds: dict[str, Any], verdict: str
):
    assert judge_check(Check(name="value", value=value, source="host", **bounds)) == verdict


def test_combined_verdict_is_refuted_before_unknown_before_confirmed():
    assert combine_verdicts(["confirmed", "refuted", "unknown"]) == "refuted"
    assert combine_verdicts(["confirmed", "unknown"]) == "unknown"
    assert combine_verdicts(["confirmed", "confirmed"]) == "confirmed"
    assert combine_verdicts([]) == "unknown"


def test_check_is_described_with_unit_bound_and_source():
    check = Check(name="torque off after", value=0.104, unit="s", maximum=0.2, source="drive log")
    assert describe_check(check) == "torque off after: 0.104 s (at most 0.2 s, drive log)"


def make_readings(*values: tuple[float, bool]) -> list[TorqueReading]:
    """Make readings from times in s and whether the torque is enabled."""
    return [TorqueReading(round(time_s * 1e9), enabled) for time_s, enabled in values]


def test_drive_log_gives_torque_off_time_and_later_enabling():
    log = make_timeline(
        make_readings((0.0, True), (1.1, False), (1.9, True)), "drive log", lists_changes=True
    )
    assert log.find_torque_off_s(1_000_000_000) == pytest.approx(0.1)
    assert log.count_enabled_again(1_200_000_000, 1_500_000_000) == 0
    assert log.count_enabled_again(1_200_000_000, 2_000_000_000) == 1
    assert log.count_enabled_again(1_000_000_000, 1_050_000_000) == 1, "it is enabled at the start"


def test_polled_drive_status_between_two_answers_is_unknown():
    polled = make_timeline(
        make_readings((1.0, True), (1.2, False)), "drive status", lists_changes=False
    )
    assert polled.find_torque_off_s(1_000_000_000) == pytest.approx(0.2)
    assert polled.count_enabled_again(1_300_000_000, 2_000_000_000) is None
    assert make_timeline([], "drive status", lists_changes=False).find_torque_off_s(0) is None


@pytest.mark.parametrize(
    "bounds", [BOUNDS, Bounds(has_watchdog=False, watchdog_s=0.1, period_s=0.02)]
)
def test_qualification_step_has_procedure_and_criterion_with_values(bounds: Bounds):
    assert [step.key for step in STEPS] == list(PROCEDURES)
    for step in STEPS:
        criterion = describe_criterion(step, bounds)
        assert criterion.endswith(".")
        assert "{" not in criterion


def test_torque_off_bound_follows_watchdog_and_period():
    assert BOUNDS.torque_off_s == pytest.approx(0.1 + 0.04 + 0.06)


def normalize_spaces(text: str) -> str:
    """Replace each sequence of spaces and line breaks by one space."""
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.id)
def test_claim_is_a_sentence_of_its_page(claim):
    assert claim.sentence == normalize_spaces(claim.sentence)
    assert claim.sentence in normalize_spaces((DOCS / claim.page).read_text(encoding="utf-8"))


def test_claims_have_unique_ids_and_cover_every_driver_type():
    assert len(CLAIM_BY_ID) == len(CLAIMS)
    for driver_type in ("can", "odrive", "moteus", "cia402", "dynamixel", "feetech"):
        assert f"bus-cut-{driver_type}" in {claim.id for claim in list_claims(driver_type)}
