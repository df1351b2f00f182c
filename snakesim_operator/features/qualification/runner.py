"""Goes through the steps of a qualification, prints them, and keeps the record after each step."""

import dataclasses
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, RefusedError, SnakesimError
from snakesim_hal.base.terminal import PrintLine
from snakesim_operator.features.qualification.assistant import Assistant, EmulatedBench, Person
from snakesim_operator.features.qualification.emulated_drive import SNAKESIM_MODULE, EmulatedDrive
from snakesim_operator.features.qualification.procedures import PROCEDURES
from snakesim_operator.features.qualification.protocol.checks import (
    Check,
    describe_check,
    judge_check,
)
from snakesim_operator.features.qualification.protocol.record import (
    PROGRESS,
    RECORD,
    SUMMARY,
    Record,
    StepResult,
    Subject,
    find_resume_conflict,
    judge_claims,
    read_record,
    replace_step,
    write_record,
)
from snakesim_operator.features.qualification.protocol.signature import (
    load_or_create_key,
    sign_record,
)
from snakesim_operator.features.qualification.protocol.steps import STEPS, Step, describe_criterion
from snakesim_operator.features.qualification.protocol.summary import (
    EMULATED_BANNER,
    describe_subject,
    make_summary,
)
from snakesim_operator.features.qualification.rig import Rig
from snakesim_operator.features.qualification.setup import (
    Request,
    Setup,
    describe_computer,
    detect_adapter,
    make_setup,
)

CONFIRMATIONS = (
    "The drive is clamped, and nothing can be hit by its lever.",
    "The current is limited, in the drive and at the supply.",
    "A switch that cuts the motor supply is within reach.",
)
MAX_REPETITIONS = 3  # of a step with an emulated drive, whose process a busy computer delays
SKIPPED = "the operator has left this step out"
MARKS = {"confirmed": "ok", "refuted": "NO", "unknown": "??"}


@dataclass(frozen=True)
class Options:
    """How a qualification is carried out."""

    operator: str
    key: Path
    adapter: str = ""  # empty: as far as the computer knows
    firmware: str = ""  # as a vendor's tool prints it, for a drive that does not report it
    only: Sequence[str] = ()  # keys of the steps to carry out; empty: all. The others stay unknown
    yes: bool = False  # do not wait before steps; only for emulated drives
    emulator_module: Sequence[str] = SNAKESIM_MODULE


def qualify_drive(request: Request, options: Options, print_text: PrintLine) -> Record:
    """Qualify a drive, and write its signed record.

    An earlier qualification in the same folder that was interrupted is continued: steps with a verdict stay.

    Args:
        request: Which drive, and where to write.
        options: How to carry it out.
        print_text: Prints a line for the operator.

    Returns:
        The signed record.

    Raises:
        ConfigError: The configuration is invalid, or the folder has a finished record.
        RefusedError: The operator does not confirm that the drive is safe, or it does not start.
    """
    folder = request.folder
    if (folder / RECORD).exists():
        raise ConfigError(
            f"{folder / RECORD}: this qualification is finished; give another folder with --out",
            code="file/already-exists",
        )
    folder.mkdir(parents=True, exist_ok=True)
    request = _resolve_folder(request)
    setup = make_setup(request)
    if options.yes and not setup.is_emulated:
        raise ConfigError(
            f"--yes: the drive on {setup.bus} is real, and a person must watch each step; leave --yes out",
            code="command/invalid-option",
        )
    key = load_or_create_key(options.key)
    confirmations: tuple[str, ...] = ()
    if not setup.is_emulated:
        confirmations = _confirm_safety(Person(print_text))
    with ExitStack() as exit_stack:
        drive = None
        if setup.is_emulated:
            drive = EmulatedDrive(
                setup.config, setup.bus, folder, request.emulator_sets, options.emulator_module
            )
            exit_stack.callback(drive.close)
        rig = Rig(setup, folder, drive, options.firmware)
        exit_stack.callback(rig.close)
        rig.start_host()
        assistant: Assistant = Person(print_text)
        if drive is not None:
            assistant = EmulatedBench(drive, print_text, should_pause=not options.yes)
        record = _begin_record(folder, _describe_subject(rig, options), options, confirmations)
        _print_heading(record, print_text)
        record = _run_steps(rig, assistant, record, options, folder, print_text)
    record = msgspec.structs.replace(
        record, finished_utc=_now_utc(), claims=judge_claims(request.driver_type, record.steps)
    )
    record = sign_record(record, key)
    write_record(record, folder / RECORD)
    (folder / SUMMARY).write_text(make_summary(record), encoding="utf-8")
    (folder / PROGRESS).unlink(missing_ok=True)
    return record


def _resolve_folder(request: Request) -> Request:
    """Return the request with an absolute folder: other processes use it."""
    return dataclasses.replace(request, folder=request.folder.resolve())


def _confirm_safety(person: Person) -> tuple[str, ...]:
    """Ask what must be true before a motor may turn. Raises RefusedError."""
    for confirmation in CONFIRMATIONS:
        if person.read_yes_or_no(confirmation) != "yes":
            raise RefusedError(
                f"not started: {confirmation} That must be true first.", code="robot/not-armed"
            )
    return CONFIRMATIONS


def _describe_subject(rig: Rig, options: Options) -> Subject:
    setup: Setup = rig.setup
    joint = rig.robot.joints[0]
    adapter = options.adapter or (
        "none, an emulated bus" if setup.is_emulated else detect_adapter(setup.bus)
    )
    return Subject(
        driver_type=setup.config.backend,
        emulated=rig.robot.emulated,
        serial=joint.serial,
        firmware=joint.firmware or options.firmware,
        bus=rig.robot.hardware or setup.bus,
        adapter=adapter,
        robot=rig.robot.robot,
        config_hash=rig.robot.config_hash,
    )


def _begin_record(
    folder: Path, subject: Subject, options: Options, confirmations: tuple[str, ...]
) -> Record:
    """Return a new record, or an interrupted one of the same drive. Raises ConfigError if that is another drive."""
    progress = folder / PROGRESS
    if progress.exists():
        record = read_record(progress)
        conflict = find_resume_conflict(record, subject)
        if conflict:
            raise ConfigError(
                f"{progress}: this qualification cannot be continued: {conflict}. Give another folder with --out",
                code="config/conflict",
            )
        return record
    return Record(
        subject=subject,
        computer=describe_computer(),
        operator=options.operator,
        started_utc=_now_utc(),
        confirmations=confirmations,
    )


def _run_steps(
    rig: Rig,
    assistant: Assistant,
    record: Record,
    options: Options,
    folder: Path,
    print_text: PrintLine,
) -> Record:
    done = {step.key for step in record.steps if step.verdict != "unknown"}
    for number, step in enumerate(STEPS, start=1):
        if options.only and step.key not in options.only:
            continue
        print_text("")
        print_text(f"{number:2}/{len(STEPS)}  {step.title}")
        criterion = describe_criterion(step, rig.setup.bounds)
        print_text(f"       {criterion}")
        if step.key in done:
            print_text("       done before")
            continue
        if assistant.confirm_step(step.instruction):
            result = _run_step(step, criterion, rig, assistant)
            for _ in range(MAX_REPETITIONS if record.subject.emulated else 0):
                if not result.problem:
                    break
                print_text(
                    f"       repeated, because an emulated drive needs a computer with time: {result.problem}"
                )
                result = _run_step(step, criterion, rig, assistant)
        else:
            result = _make_result(step, criterion, assistant, [], SKIPPED)
        record = replace_step(record, result)
        write_record(record, folder / PROGRESS)
        _print_step(result, print_text)
    return record


def _print_step(result: StepResult, print_text: PrintLine) -> None:
    for check in result.checks:
        print_text(f"       {MARKS[judge_check(check)]}  {describe_check(check)}")
    if result.problem:
        print_text(f"       ??  {result.problem}")
    print_text(f"       {result.verdict}")


def _run_step(step: Step, criterion: str, rig: Rig, assistant: Assistant) -> StepResult:
    """Carry out one step; an error makes it unknown. The robot is disarmed afterwards."""
    problem = ""
    checks: list[Check] = []
    try:
        if rig.wait_for_lifecycle("disarmed", timeout_s=1.0) != "disarmed":
            rig.disarm()
        checks = PROCEDURES[step.key](rig, assistant)
        rig.disarm()
    except SnakesimError as error:
        problem = str(error)
        _restart_host(rig)
    return _make_result(step, criterion, assistant, checks, problem)


def _make_result(
    step: Step, criterion: str, assistant: Assistant, checks: Sequence[Check], problem: str
) -> StepResult:
    result = StepResult(
        key=step.key,
        title=step.title,
        criterion=criterion,
        caused_by=assistant.actor,
        finished_utc=_now_utc(),
        checks=tuple(checks),
        problem=problem,
    )
    # As it is read from a file.
    return msgspec.json.decode(msgspec.json.encode(result), type=StepResult)


def _restart_host(rig: Rig) -> None:
    """Begin the next step with a new host, so that an error of one step does not spoil the others."""
    rig.stop_host()
    time.sleep(0.5)
    rig.start_host()
    rig.wait_for_lifecycle("disarmed", "estop", timeout_s=5.0)
    rig.disarm()


def _print_heading(record: Record, print_text: PrintLine) -> None:
    print_text(f"First hour with one drive: {len(STEPS)} steps")
    if record.subject.emulated:
        print_text(EMULATED_BANNER.strip("*"))
    for name, value in describe_subject(record)[:-1]:
        print_text(f"  {name:<14} {value}")


def _now_utc() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
