"""The record of a qualification: what was confirmed on which drive, by whom, with what. Pure but for its files."""

from pathlib import Path
from typing import Literal

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.qualification.protocol.checks import (
    Check,
    Verdict,
    combine_verdicts,
    judge_check,
)
from snakesim_operator.features.qualification.protocol.claims import list_claims

FORMAT = "snakesim drive qualification"
VERSION = 1
RECORD = "record.json"
PROGRESS = "progress.json"
SUMMARY = "record.md"


class Subject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The drive, and what it was connected to."""

    driver_type: str
    emulated: bool
    """True: no hardware was there. The record claims nothing about hardware."""

    serial: str
    """Serial number that the drive reports. Empty: it reports none."""

    firmware: str
    """Firmware version that the drive reports. Empty: it reports none."""

    bus: str
    """Channel or port."""

    adapter: str
    """Adapter between computer and bus, as the operator named it."""

    robot: str
    """Name in the robot file."""

    config_hash: str
    """Hash of the whole configuration of the host."""


class Computer(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The computer on which the host ran."""

    name: str
    kernel: str
    machine: str
    python: str
    snakesim: str


class StepResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One step, as it was carried out."""

    key: str
    title: str
    criterion: str
    caused_by: Literal["program", "operator"]
    """Who unplugged the bus, cut the supply or pressed the button."""

    finished_utc: str
    checks: tuple[Check, ...] = ()
    problem: str = ""
    """Why the step could not be carried out to its end. Empty: it could."""

    @property
    def verdict(self) -> Verdict:
        """The verdict of all its checks. A step with a problem confirms nothing."""
        verdict = combine_verdicts(map(judge_check, self.checks))
        if self.problem and verdict == "confirmed":
            return "unknown"
        return verdict


class ClaimResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One sentence of the documentation, and whether it was confirmed on this drive."""

    id: str
    page: str
    sentence: str
    verdict: Verdict


class Signature(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The signature of all other fields."""

    algorithm: Literal["ed25519"]
    public_key: str
    """Base64."""

    value: str
    """Base64."""


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole qualification."""

    format: Literal["snakesim drive qualification"] = FORMAT
    version: Literal[1] = VERSION
    subject: Subject
    computer: Computer
    operator: str
    started_utc: str
    finished_utc: str = ""
    """Empty: not finished."""

    confirmations: tuple[str, ...] = ()
    """What the operator has confirmed before the first step."""

    steps: tuple[StepResult, ...] = ()
    claims: tuple[ClaimResult, ...] = ()
    signature: Signature | None = None

    @property
    def verdict(self) -> Verdict:
        """The verdict of all its steps."""
        return combine_verdicts(step.verdict for step in self.steps)


def judge_claims(driver_type: str, steps: tuple[StepResult, ...]) -> tuple[ClaimResult, ...]:
    """Return every claim about a driver type, with the verdict of all checks that test it; without any it is unknown.

    A step that was not carried out to its end does not confirm a claim.
    """
    results: list[ClaimResult] = []
    for claim in list_claims(driver_type):
        verdicts: list[Verdict] = []
        for step in steps:
            tested: list[Verdict] = [
                judge_check(check) for check in step.checks if claim.id in check.claims
            ]
            if step.problem and tested:
                tested.append("unknown")
            verdicts += tested
        results.append(
            ClaimResult(
                id=claim.id,
                page=claim.page,
                sentence=claim.sentence,
                verdict=combine_verdicts(verdicts),
            )
        )
    return tuple(results)


def replace_step(record: Record, result: StepResult) -> Record:
    """Return the record with the result of a step, in place of an earlier one of the same step."""
    if result.key not in {step.key for step in record.steps}:
        return msgspec.structs.replace(record, steps=(*record.steps, result))
    steps = tuple(result if step.key == result.key else step for step in record.steps)
    return msgspec.structs.replace(record, steps=steps)


def find_resume_conflict(record: Record, subject: Subject) -> str:
    """Return why an unfinished record is not about this drive, so that it cannot be continued; empty if it is."""
    for field in ("driver_type", "emulated", "serial", "firmware", "config_hash"):
        before = getattr(record.subject, field)
        now = getattr(subject, field)
        if field == "serial" and subject.emulated:
            continue
        if before != now:
            return f"it was begun with {field} = {before!r}, and now it is {now!r}"
    return ""


def encode_record(record: Record) -> bytes:
    """Return a record as indented JSON with sorted keys."""
    return msgspec.json.format(msgspec.json.encode(record, order="sorted"), indent=2) + b"\n"


def write_record(record: Record, path: Path) -> None:
    """Write a record, in place of an earlier one."""
    write_atomically(path, encode_record(record))


def read_record(path: Path) -> Record:
    """Read a record.

    Raises:
        ConfigError: The file cannot be read, or is no record of this version.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Record)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", code="file/not-readable") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path}: this is no record of `snakesim drive qualify` of version {VERSION}: {error}",
            code="file/not-readable",
        ) from error
