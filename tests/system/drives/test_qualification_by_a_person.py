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
    QualificationTerminal,
    answer_until,
    emulated_drive_on_bench,
    running_qualification,
    skip_step,
)

pytestmark = pytest.mark.e2e

# Exit codes of the command.
NOT_CONFIRMED = 1  # at least one step is refuted or unknown
INTERRUPTED = 130

ANSWER_NO = "n\n"

# Parts of the questions.
READY = "Press Enter when you are ready"
SHAFT_TURNED = "Did the shaft turn the positive way"
WITHOUT_TORQUE = "is the motor without torque?"
SAFETY_QUESTION = "A switch that cuts the motor supply"
STEP_KEYS = [step.key for step in STEPS]
ALL_UNKNOWN = dict.fromkeys(
    STEP_KEYS, "unknown"
)  # verdicts of a qualification without a completed step
TITLES = {step.key: step.title for step in STEPS}


def get_verdicts(record: Record) -> dict[str, str]:
    """Return the verdict of each step."""
    return {step.key: step.verdict for step in record.steps}


def skip_all_but(*kept: str) -> dict[str, Answer]:
    """Return answers that skip all steps except these."""
    return {title: skip_step for key, title in TITLES.items() if key not in kept}


def answer_no(terminal: QualificationTerminal, question: str) -> str:
    """Return the answer of a person who has seen something else than expected."""
    del terminal, question
    return ANSWER_NO


def answer_nothing(terminal: QualificationTerminal, question: str) -> str:
    """Return what a person types who does not know the answer."""
    del terminal, question
    return ENTER


def qualify_without_confirmation(tmp_path: Path, answers: dict[str, Answer]) -> Record:
    """Run a qualification with these answers, which must not confirm all steps, and return its record."""
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        answer_until(terminal, "", answers)
        assert terminal.end() == NOT_CONFIRMED, terminal.printed
    return read_record(terminal.folder / RECORD)


def get_claim_verdicts(record: Record) -> dict[str, str]:
    """Return the verdict of each claim about the drive, which follows from the verdicts of its steps."""
    return {claim.id: claim.verdict for claim in record.claims}


def go_to_step(terminal: QualificationTerminal, key: str) -> None:
    """Answer with Enter until the question of a step whose instruction the person must confirm."""
    answer_until(terminal, READY, {})
    while terminal.find_step() != TITLES[key]:
        terminal.answer(ENTER)
        terminal.wait_for_question()


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
            assert terminal.end() == INTERRUPTED
            bench.assert_stays_off()
            assert "continues with this step" in terminal.printed

        progress_verdicts = get_verdicts(terminal.read_progress())
        confirmed = dict.fromkeys(STEP_KEYS[:4], "confirmed")
        assert progress_verdicts == {**confirmed, "limits": "unknown"}

        with running_qualification(tmp_path, bench) as terminal:
            answer_until(terminal, "", skip_all_but("limits", "torque", "supply", "estop_key"))
            assert terminal.end() == NOT_CONFIRMED, terminal.printed
            assert terminal.printed.count("done before") == 3, "all confirmed steps but torque"

    record = read_record(terminal.folder / RECORD)
    answered = dict.fromkeys((*STEP_KEYS[:5], "supply", "estop_key"), "confirmed")
    assert get_verdicts(record) == {**ALL_UNKNOWN, **answered}
    assert [step.key for step in record.steps] == STEP_KEYS
    assert {step.caused_by for step in record.steps} == {"operator"}
    assert len(record.confirmations) == 3

    verified = snakesim("drive", "verify", f"out/{RECORD}", cwd=tmp_path)
    assert "the signature is valid" in verified.out
    assert "A. Person" in verified.out


# Claims that a drive which is hardly tested may confirm: it did not move by itself in the steps that were carried out.
CLAIMS_WITHOUT_MOTION = {"never-arms-itself", "stays-off"}


@pytest.mark.timeout(300)
def test_qualification_answer_no_refutes_step_claim_and_record(tmp_path: Path):
    """The person watches a motion and answers that the shaft did not turn the positive way."""
    answers = {**skip_all_but("identity", "motion"), SHAFT_TURNED: answer_no}

    record = qualify_without_confirmation(tmp_path, answers)

    assert get_verdicts(record) == {**ALL_UNKNOWN, "identity": "confirmed", "motion": "refuted"}
    assert record.verdict == "refuted"
    claims = get_claim_verdicts(record)
    assert claims["si-units"] == "refuted", "it depends on the direction of the motion"
    confirmed = {claim for claim, verdict in claims.items() if verdict == "confirmed"}
    assert confirmed <= CLAIMS_WITHOUT_MOTION


@pytest.mark.timeout(300)
def test_qualification_unanswered_or_skipped_step_is_unknown(tmp_path: Path):
    """The person unplugs the bus, but does not say whether the motor is without torque, and skips the other steps."""
    answers = {**skip_all_but("identity", "unplug"), WITHOUT_TORQUE: answer_nothing}

    record = qualify_without_confirmation(tmp_path, answers)

    assert get_verdicts(record) == {**ALL_UNKNOWN, "identity": "confirmed"}
    claims = get_claim_verdicts(record)
    assert claims["bus-cut-odrive"] == "unknown", "it depends on the unanswered question"
    confirmed = {claim for claim, verdict in claims.items() if verdict == "confirmed"}
    assert confirmed <= CLAIMS_WITHOUT_MOTION
    skipped = next(step for step in record.steps if step.key == "supply")
    assert skipped.problem == "the operator has left this step out"
    assert not skipped.checks, "a skipped step has measured something"


def test_qualification_starts_only_after_person_confirms_safety(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        for confirmation in (ANSWER_NO, ENTER):
            with running_qualification(tmp_path, bench) as terminal:
                answer_until(terminal, SAFETY_QUESTION)
                terminal.answer(confirmation)
                assert terminal.end() == NOT_CONFIRMED
                assert "That must be true first" in terminal.printed
                assert not (terminal.folder / PROGRESS).exists(), "a step has begun"

        assert not any(state.is_enabled for state in bench.drive.read_log())


def test_qualification_whose_terminal_is_closed_stops_the_motor(tmp_path: Path):
    with emulated_drive_on_bench(tmp_path, "odrive") as bench:
        with running_qualification(tmp_path, bench) as terminal:
            go_to_step(terminal, "limits")
            start_rad = bench.read_newest_state().angle_rad
            terminal.answer(ENTER)
            wait_until(lambda: bench.read_newest_state().angle_rad > start_rad + 0.05, "a motion")

            terminal.close()

            assert terminal.end() == INTERRUPTED
            bench.assert_stays_off()
            assert bench.read_newest_state().angle_rad < 0.15, "it did not reach the limit"
        assert list(get_verdicts(terminal.read_progress())) == STEP_KEYS[:2]


def test_qualification_ignores_keys_typed_before_the_question(tmp_path: Path):
    """The person presses Enter three times, although only one question is shown."""
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        go_to_step(terminal, "limits")
        terminal.answer(ENTER + 2 * ENTER)  # the first answers; the others are too early

        # The first Enter has started the step "limits", after which the next step asks before it moves the motor.
        assert READY in terminal.wait_for_question()
        assert terminal.find_step() == TITLES["motion"]
        time.sleep(1.0)  # a key that is not ignored would have answered by now
        newest_line = terminal.printed.splitlines()[-1]
        assert READY in newest_line, "a key that was typed early has answered the question"
        assert not bench.read_newest_state().is_enabled

        terminal.answer(CTRL_D)
        assert terminal.end() == INTERRUPTED


def end_input_while_motor_is_enabled(terminal: QualificationTerminal) -> None:
    """Answer until the step "motion" asks which way the shaft turned, and type Ctrl-D instead of an answer."""
    answer_until(terminal, SHAFT_TURNED)
    assert terminal.bench.read_newest_state().is_enabled, "the motor does not hold the shaft"
    terminal.answer(CTRL_D)


def test_qualification_at_end_of_input_stops_the_motor(tmp_path: Path):
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        end_input_while_motor_is_enabled(terminal)
        assert terminal.end() == INTERRUPTED
        bench.assert_stays_off()


def test_qualification_at_end_of_input_keeps_completed_steps(tmp_path: Path):
    with (
        emulated_drive_on_bench(tmp_path, "odrive") as bench,
        running_qualification(tmp_path, bench) as terminal,
    ):
        end_input_while_motor_is_enabled(terminal)  # in the step "motion"
        assert terminal.end() == INTERRUPTED

    record = terminal.read_progress()
    steps_before_motion = STEP_KEYS[: STEP_KEYS.index("motion")]
    assert steps_before_motion == ["identity", "configuration", "limits"]
    assert get_verdicts(record) == dict.fromkeys(steps_before_motion, "confirmed")
    claims = {claim.id: claim.verdict for claim in judge_claims("odrive", record.steps)}
    assert claims["si-units"] == "unknown", "it depends on the step that was not completed"
