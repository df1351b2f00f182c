"""`snakesim drive qualify` asks a person, who answers in a terminal and acts on the drive."""

import time
from pathlib import Path

import pytest

from snakesim_operator.features.qualification.protocol.record import (
    PROGRESS,
    RECORD,
    Record,
    judge_claims,
    read_record,
)
from snakesim_operator.features.qualification.protocol.steps import STEPS
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import snakesim
from snakesim_testing.runs.qualification_terminal import (
    CTRL_C,
    CTRL_D,
    ENTER,
    Answer,
    answer_until,
    emulated_drive_on_bench,
    running_qualification,
    skip_step,
)

pytestmark = pytest.mark.e2e

READY = "Press Enter when you are ready"
SHAFT_TURNED = "Did the shaft turn the positive way"
WITHOUT_TORQUE = "is the motor without torque?"
STEP_KEYS = [step.key for step in STEPS]
TITLES = {step.key: step.title for step in STEPS}


def get_verdicts(record: Record) -> dict[str, str]:
    """Return the verdict of each step."""
    return {step.key: step.verdict for step in record.steps}


def skip_all_but(*kept: str) -> dict[str, Answer]:
    """Return answers that skip all steps except these."""
    return {title: skip_step for key, title in TITLES.items() if key not in kept}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_qualification_by_person_confirms_every_step(tmp_path: Path):
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        answer_until(terminal, "")
        assert terminal.end() == 0, terminal.printed
    record = read_record(terminal.folder / RECORD)
    assert get_verdicts(record) == dict.fromkeys(STEP_KEYS, "confirmed"), terminal.printed
    assert {claim.verdict for claim in record.claims} == {"confirmed"}


@pytest.mark.timeout(300)
def test_interrupted_qualification_by_person_continues_with_unknown_steps(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        with running_qualification(tmp_path, bench) as terminal:
            answer_until(terminal, "Block the shaft: hold", {TITLES["limits"]: skip_step})
            assert bench.read_newest_state().is_enabled
            terminal.type(CTRL_C)
            assert terminal.end() == 130
            bench.assert_stays_off()
            assert "continues with this step" in terminal.printed
        progress_verdicts = get_verdicts(terminal.read_progress())
        confirmed = dict.fromkeys(STEP_KEYS[:4], "confirmed")
        assert progress_verdicts == {**confirmed, "limits": "unknown"}
        with running_qualification(tmp_path, bench) as terminal:
            answer_until(terminal, "", skip_all_but("limits", "torque", "supply", "estop_key"))
            assert terminal.end() == 1, terminal.printed
            assert terminal.printed.count("done before") == 3
    record = read_record(terminal.folder / RECORD)
    all_unknown = dict.fromkeys(STEP_KEYS, "unknown")
    answered = dict.fromkeys((*STEP_KEYS[:5], "supply", "estop_key"), "confirmed")
    assert get_verdicts(record) == {**all_unknown, **answered}
    assert [step.key for step in record.steps] == STEP_KEYS
    assert {step.caused_by for step in record.steps} == {"operator"}
    assert len(record.confirmations) == 3
    verified = snakesim("drive", "verify", f"out/{RECORD}", cwd=tmp_path)
    assert "the signature is valid" in verified.out
    assert "A. Person" in verified.out


@pytest.mark.timeout(300)
def test_qualification_answer_no_is_refuted_and_skipped_is_unknown(tmp_path: Path):
    answers: dict[str, Answer] = {
        **skip_all_but("identity", "motion", "unplug"),
        SHAFT_TURNED: lambda _terminal, _question: "n\n",
        WITHOUT_TORQUE: lambda _terminal, _question: ENTER,
    }
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        answer_until(terminal, "", answers)
        assert terminal.end() == 1, terminal.printed
    record = read_record(terminal.folder / RECORD)
    all_unknown = dict.fromkeys(STEP_KEYS, "unknown")
    assert get_verdicts(record) == {**all_unknown, "identity": "confirmed", "motion": "refuted"}
    assert record.verdict == "refuted"
    claims = {claim.id: claim.verdict for claim in record.claims}
    assert claims["si-units"] == "refuted"
    assert claims["bus-cut-odrive"] == "unknown"
    confirmed = {claim for claim, verdict in claims.items() if verdict == "confirmed"}
    assert not confirmed - {"never-arms-itself", "stays-off"}
    skipped = next(step for step in record.steps if step.key == "supply")
    assert skipped.problem == "the operator has left this step out"
    assert not skipped.checks


def test_qualification_starts_only_after_person_confirms_safety(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        for confirmation in ("n\n", ENTER):
            with running_qualification(tmp_path, bench) as terminal:
                answer_until(terminal, "A switch that cuts the motor supply")
                terminal.answer(confirmation)
                assert terminal.end() == 1
                assert "That must be true first" in terminal.printed
                assert not (terminal.folder / PROGRESS).exists()
        assert not any(state.is_enabled for state in bench.drive.read_log())


def test_qualification_whose_terminal_is_closed_stops_the_motor(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        with running_qualification(tmp_path, bench) as terminal:
            answer_until(terminal, READY, {})
            while terminal.find_step() != TITLES["limits"]:
                terminal.answer(ENTER)
                terminal.wait_for_question()
            start_rad = bench.read_newest_state().angle_rad
            terminal.answer(ENTER)
            wait_until(lambda: bench.read_newest_state().angle_rad > start_rad + 0.05, "a motion")
            terminal.close()
            assert terminal.end() == 130
            bench.assert_stays_off()
            assert bench.read_newest_state().angle_rad < 0.15, "it did not reach the limit"
        assert list(get_verdicts(terminal.read_progress())) == STEP_KEYS[:2]


def test_qualification_ignores_early_keys_and_stops_at_end_of_input(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        with running_qualification(tmp_path, bench) as terminal:
            answer_until(terminal, READY, {})
            while terminal.find_step() != TITLES["limits"]:
                terminal.answer(ENTER)
                terminal.wait_for_question()
            terminal.answer(3 * ENTER)
            assert READY in terminal.wait_for_question()
            time.sleep(1.0)
            assert READY in terminal.printed.splitlines()[-1], "a key typed early has answered"
            assert not bench.read_newest_state().is_enabled
            answer_until(terminal, SHAFT_TURNED)
            assert bench.read_newest_state().is_enabled
            terminal.answer(CTRL_D)
            assert terminal.end() == 130
            bench.assert_stays_off()
        record = terminal.read_progress()
        assert get_verdicts(record) == dict.fromkeys(STEP_KEYS[:3], "confirmed")
        claims = {claim.id: claim.verdict for claim in judge_claims("odrive", record.steps)}
        assert claims["si-units"] == "unknown"
