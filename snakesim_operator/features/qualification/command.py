"""What `snakesim drive qualify` and `snakesim drive verify` do."""

import argparse
import sys
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    get_user_name,
    raise_on_stop_signals,
    set_realtime_priority,
)
from snakesim_hal.base.terminal import PrintLine, print_json, print_line, print_stderr
from snakesim_hal.network.local_registry import get_state_folder
from snakesim_operator.features.qualification.protocol.record import (
    RECORD,
    SUMMARY,
    Record,
    judge_claims,
    read_record,
)
from snakesim_operator.features.qualification.protocol.signature import (
    compute_fingerprint,
    find_signature_problem,
)
from snakesim_operator.features.qualification.protocol.summary import EMULATED_BANNER
from snakesim_operator.features.qualification.runner import Options, qualify_drive
from snakesim_operator.features.qualification.setup import Request

OK = 0
FAILED = 1
INTERRUPTED = 130
KEY_NAME = "qualification.pem"


def qualify(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive qualify`, and return the exit code.

    Raises:
        SnakesimError: The configuration is invalid, or the drive does not start.
    """
    if not arguments.yes and not sys.stdin.isatty():
        raise ConfigError(
            "drive qualify: a person confirms each step, and stdin is no terminal; start it in one, or add --yes for "
            "an emulated drive",
            code="command/invalid-option",
        )
    print_text: PrintLine = print_stderr if arguments.json else print_line
    request = Request(
        driver_type=arguments.driver_type,
        folder=arguments.out or Path(f"qualify-{arguments.driver_type}"),
        scenario=arguments.scenario,
        channel=arguments.channel,
        sets=arguments.set,
        emulator_sets=arguments.emulator_set,
    )
    options = Options(
        operator=arguments.operator or get_user_name(),
        key=arguments.key or get_state_folder() / KEY_NAME,
        adapter=arguments.adapter,
        firmware=arguments.firmware_version,
        yes=arguments.yes,
    )
    set_realtime_priority(SERVICE_PRIORITY)  # where it is allowed: a late command ends the lease
    try:
        with raise_on_stop_signals():
            record = qualify_drive(request, options, print_text)
    except KeyboardInterrupt:
        print_text("")
        print_text("Interrupted. The motor is off. The same command continues with this step.")
        return INTERRUPTED
    _print_result(record, request.folder, print_text)
    if arguments.json:
        print_json({"record": str(request.folder / RECORD), **_summarize(record)})
    return OK if record.verdict == "confirmed" else FAILED


def verify(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive verify`, and return the exit code.

    Raises:
        ConfigError: The file is no record.
    """
    record = read_record(arguments.record)
    problem = find_signature_problem(record, arguments.public_key) or find_claim_problem(record)
    key = record.signature.public_key if record.signature is not None else ""
    if arguments.json:
        print_json(
            {"valid": not problem, "problem": problem, "public_key": key, **_summarize(record)}
        )
        return FAILED if problem else OK
    if problem:
        print_line(f"{arguments.record}: NOT VALID: {problem}")
        return FAILED
    print_line(f"{arguments.record}: the signature is valid")
    print_line(f"  signed by  {key} ({compute_fingerprint(key)})")
    print_line(f"  operator   {record.operator}")
    print_line(
        f"  drive      {record.subject.driver_type}, serial number {record.subject.serial or 'not reported'}"
    )
    for name, count in _count_verdicts(record).items():
        print_line(f"  {name:<10} {count} claims")
    if record.subject.emulated:
        print_line(EMULATED_BANNER.strip("*"))
    return OK


def find_claim_problem(record: Record) -> str:
    """Return why the claims of a record do not follow from its own measurements; empty if they do."""
    if record.claims != judge_claims(record.subject.driver_type, record.steps):
        return "its claims do not follow from its measurements, or are those of another version of SnakeSIM"
    return ""


def _print_result(record: Record, folder: Path, print_text: PrintLine) -> None:
    print_text("")
    print_text("Claims of the documentation:")
    for claim in record.claims:
        print_text(f"  {claim.verdict:<10} {claim.id:<20} {claim.page}")
    counts = ", ".join(f"{count} {name}" for name, count in _count_verdicts(record).items())
    steps = sum(step.verdict == "confirmed" for step in record.steps)
    print_text("")
    print_text(f"{steps} of {len(record.steps)} steps confirmed. Claims: {counts}.")
    if record.subject.emulated:
        print_text(EMULATED_BANNER.strip("*"))
    assert record.signature is not None
    print_text(
        f"record:  {folder / RECORD}, signed by {compute_fingerprint(record.signature.public_key)}"
    )
    print_text(f"summary: {folder / SUMMARY}")


def _count_verdicts(record: Record) -> dict[str, int]:
    counts: dict[str, int] = {"confirmed": 0, "refuted": 0, "unknown": 0}
    for claim in record.claims:
        counts[claim.verdict] += 1
    return counts


def _summarize(record: Record) -> dict[str, object]:
    return {
        "verdict": record.verdict,
        "emulated": record.subject.emulated,
        "steps": {step.key: step.verdict for step in record.steps},
        "claims": {claim.id: claim.verdict for claim in record.claims},
    }
