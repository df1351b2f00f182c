"""Judges what a killed run has left: no process, no error, a true exit code, and every stop that was answered."""

import re
import signal

from verification.soak.kill_trial import SUPERVISOR, KillTrial
from verification.soak.killed_run import KillOutcome

DONE = 0
FAULT = 1
INTERRUPTED = 130
ERROR_PATTERN = re.compile(
    r"Traceback|panicked|Exception ignored|RuntimeWarning|Fatal Python error"
)
FAULT_TEXTS = ("fault:", "snakesim:", "left no record")
MIN_OBSERVED_FRACTION = 0.8  # of the requested ticks: the session on the network may miss some
MAX_QUOTED_LINES = 40
MAX_QUOTED_CHARACTERS = 600


def find_violations(outcome: KillOutcome) -> list[str]:
    """Return everything that is wrong with the outcome of a trial."""
    violations = [f"left behind: {process}" for process in outcome.left_behind]
    violations += _find_errors(outcome)
    violations += _find_false_exit_code(outcome)
    if outcome.stop_answered and not outcome.reset_requested and not outcome.stop_kept:
        violations.append("an emergency stop was answered, and is not on the disk")
    if outcome.reset_answered and outcome.stop_kept:
        violations.append("a reset was answered, and the emergency stop is still on the disk")
    is_silent = not outcome.printed.strip()
    if is_silent and outcome.exit_code not in (None, DONE) and outcome.trial.moment != "starting":
        violations.append(f"exit code {outcome.exit_code} without a message")
    return violations


def _find_errors(outcome: KillOutcome) -> list[str]:
    """Find errors of the interpreter in what the run printed and in its logs."""
    violations: list[str] = []
    texts = {"the run": outcome.printed, **outcome.logs}
    for name, text in texts.items():
        error = ERROR_PATTERN.search(text)
        if error is None:
            continue
        if name == "the run" and _was_interrupted_while_importing(outcome.trial, text):
            continue
        violations.append(f"{name}: {_quote(text[error.start() :])}")
    return violations


def _was_interrupted_while_importing(trial: KillTrial, text: str) -> bool:
    """Return whether an interrupt came while Python itself was starting, before any of our modules was imported."""
    interrupts_supervisor = any(
        kill.victim == SUPERVISOR and kill.signal_number is signal.SIGINT for kill in trial.kills
    )
    return interrupts_supervisor and "KeyboardInterrupt" in text and "snakesim_" not in text


def _find_false_exit_code(outcome: KillOutcome) -> list[str]:
    """Return the violation if the exit code is not true.

    It is 0 if the robot was armed for as long as requested, 1 after a fault, and 130 after an interrupt. Otherwise it
    is that of a signal which the supervisor got.
    """
    exit_code = outcome.exit_code
    if exit_code == DONE:
        return _find_missing_ticks(outcome)
    if exit_code == INTERRUPTED:
        return [] if outcome.interrupted else [f"exit code {exit_code} without an interrupt"]
    if exit_code == FAULT:
        names_fault = any(text in outcome.printed for text in FAULT_TEXTS)
        return [] if names_fault else [f"exit code {exit_code} without a message about a fault"]
    if exit_code not in _list_signal_exit_codes(outcome):
        return [f"exit code {exit_code}"]
    return []


def _find_missing_ticks(outcome: KillOutcome) -> list[str]:
    """Return the violation if a run that ended with exit code 0 was not complete."""
    requested_ticks = outcome.trial.requested_ticks
    recorded_ticks = None
    if outcome.host_record is not None:
        recorded_ticks = outcome.host_record.armed_ticks
    ended = None
    if outcome.summary is not None:
        ended = outcome.summary.ended
    if recorded_ticks is None or recorded_ticks < requested_ticks or ended != "complete":
        return [
            f"exit code 0 with {recorded_ticks} of {requested_ticks} ticks armed by the host's record, "
            f"ended {ended!r}"
        ]
    is_observed = outcome.reached_moment and outcome.trial.moment == "ending"
    if is_observed and outcome.armed_ticks < MIN_OBSERVED_FRACTION * requested_ticks:
        return [
            f"exit code 0, and {outcome.armed_ticks} of {requested_ticks} ticks were observed armed"
        ]
    if outcome.stop_kept:
        return ["exit code 0 with the emergency stop latched"]
    return []


def _list_signal_exit_codes(outcome: KillOutcome) -> set[int]:
    """List the exit codes of a supervisor that a signal of the trial has ended."""
    kills = outcome.trial.kills
    signals = {kill.signal_number for kill in kills if kill.victim == SUPERVISOR}
    if outcome.interrupted:
        signals.add(signal.SIGINT)
    return {-number for number in signals}


def _quote(text: str) -> str:
    """Quote the beginning of a text in one line."""
    lines = [line.strip() for line in text.splitlines()[:MAX_QUOTED_LINES] if line.strip()]
    return " | ".join(lines)[-MAX_QUOTED_CHARACTERS:]
