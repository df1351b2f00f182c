"""The record of a qualification: its claims follow from its checks, and its signature covers everything."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.qualification.command import find_claim_problem
from snakesim_operator.features.qualification.protocol.checks import Check
from snakesim_operator.features.qualification.protocol.record import (
    Computer,
    Record,
    StepResult,
    Subject,
    encode_record,
    find_resume_conflict,
    judge_claims,
    read_record,
    replace_step,
    write_record,
)
from snakesim_operator.features.qualification.protocol.signature import (
    find_signature_problem,
    load_or_create_key,
    sign_record,
)
from snakesim_operator.features.qualification.protocol.summary import EMULATED_BANNER, make_summary

SUBJECT = Subject(
    driver_type="moteus",
    emulated=True,
    serial="1",
    firmware="2",
    bus="local:x",
    adapter="none",
    robot="one_drive",
    config_hash="abc",
)
COMPUTER = Computer(name="lab", kernel="Linux 6", machine="x86_64", python="3.11", snakesim="0.1")


def step(key: str, *checks: Check, problem: str = "") -> StepResult:
    return StepResult(
        key=key,
        title=key,
        criterion="A criterion.",
        caused_by="program",
        finished_utc="2026-01-01T00:00:00Z",
        checks=checks,
        problem=problem,
    )


def off(value: float | None, claim: str = "stops-without-host") -> Check:
    return Check(
        name="torque off", value=value, unit="s", maximum=0.2, source="drive log", claims=(claim,)
    )


def make_record(*steps: StepResult) -> Record:
    return Record(
        subject=SUBJECT,
        computer=COMPUTER,
        operator="A | B <script>",
        started_utc="2026-01-01T00:00:00Z",
        steps=steps,
        claims=judge_claims("moteus", steps),
    )


@pytest.mark.parametrize(
    ("steps", "verdict"),
    [
        ([step("watchdog", off(0.1)), step("freeze", off(0.1))], "confirmed"),
        ([step("watchdog", off(0.1)), step("freeze", off(0.9))], "refuted"),
        ([step("watchdog", off(0.1)), step("freeze", off(None))], "unknown"),
        ([step("watchdog", off(0.1), problem="the host ended")], "unknown"),
        ([step("estop_key", off(0.1, "estop-off-at-once"))], "unknown"),
        ([], "unknown"),
    ],
)
def test_claim_is_confirmed_only_if_all_its_checks_are(steps: list[StepResult], verdict: str):
    verdicts = {claim.id: claim.verdict for claim in judge_claims("moteus", tuple(steps))}
    assert verdicts["stops-without-host"] == verdict
    assert "holds-without-host" not in verdicts, "that is about another driver type"


def test_step_with_a_problem_is_never_confirmed():
    assert step("watchdog", off(0.1), problem="the host ended").verdict == "unknown"
    assert step("watchdog").verdict == "unknown"


def test_signed_record_is_read_back_and_valid(tmp_path: Path):
    key = load_or_create_key(tmp_path / "state" / "key.pem")
    assert (tmp_path / "state" / "key.pem").stat().st_mode & 0o077 == 0
    record = sign_record(make_record(step("watchdog", off(0.1))), key)
    write_record(record, tmp_path / "record.json")
    loaded = read_record(tmp_path / "record.json")
    assert loaded == record
    assert find_signature_problem(loaded) == ""
    assert find_claim_problem(loaded) == ""
    assert loaded.signature is not None
    assert find_signature_problem(loaded, loaded.signature.public_key) == ""
    assert load_or_create_key(tmp_path / "state" / "key.pem").public_key() == key.public_key()
    other = sign_record(make_record(), load_or_create_key(tmp_path / "other.pem"))
    assert "another key" in find_signature_problem(other, loaded.signature.public_key)


def test_whole_numbers_do_not_spoil_the_signature(tmp_path: Path):
    check = Check(name="mode", value=5, minimum=5, maximum=5, source="drive status")
    record = make_record(step("configuration", check))
    write_record(sign_record(record, load_or_create_key(tmp_path / "k")), tmp_path / "r")
    assert find_signature_problem(read_record(tmp_path / "r")) == ""


def test_changed_record_is_not_valid(tmp_path: Path):
    record = sign_record(
        make_record(step("watchdog", off(0.9))), load_or_create_key(tmp_path / "key.pem")
    )
    real = msgspec.structs.replace(record, subject=msgspec.structs.replace(SUBJECT, emulated=False))
    better = msgspec.structs.replace(record, steps=(step("watchdog", off(0.1)),))
    for changed in (real, better, msgspec.structs.replace(record, operator="another")):
        assert "changed after it was signed" in find_signature_problem(changed)
    assert (
        find_signature_problem(msgspec.structs.replace(record, signature=None))
        == "it is not signed"
    )


def test_claims_that_do_not_follow_from_the_checks_are_found(tmp_path: Path):
    record = make_record(step("watchdog", off(0.9)))
    claims = tuple(msgspec.structs.replace(claim, verdict="confirmed") for claim in record.claims)
    signed = sign_record(
        msgspec.structs.replace(record, claims=claims), load_or_create_key(tmp_path / "key.pem")
    )
    assert find_signature_problem(signed) == ""
    assert find_claim_problem(signed)


def test_unknown_field_is_refused_because_no_signature_covers_it(tmp_path: Path):
    text = encode_record(make_record()).replace(b'"operator"', b'"approved": true, "operator"')
    (tmp_path / "record.json").write_bytes(text)
    with pytest.raises(ConfigError, match="no record"):
        read_record(tmp_path / "record.json")


def test_interrupted_record_is_continued_only_with_the_same_drive():
    record = make_record()
    real = msgspec.structs.replace(SUBJECT, emulated=False)
    assert find_resume_conflict(record, SUBJECT) == ""
    assert "emulated" in find_resume_conflict(record, real)
    other = msgspec.structs.replace(real, serial="9")
    assert "serial" in find_resume_conflict(msgspec.structs.replace(record, subject=real), other)
    assert "config_hash" in find_resume_conflict(
        record, msgspec.structs.replace(SUBJECT, config_hash="x")
    )


def test_repeated_step_replaces_the_earlier_one():
    record = replace_step(make_record(step("watchdog", off(None))), step("watchdog", off(0.1)))
    assert [result.verdict for result in record.steps] == ["confirmed"]


def test_repeated_step_keeps_its_place():
    record = make_record(step("watchdog", off(None)), step("freeze", off(0.1)))
    repeated = replace_step(record, step("watchdog", off(0.1)))
    assert [result.key for result in repeated.steps] == ["watchdog", "freeze"]
    assert [result.verdict for result in repeated.steps] == ["confirmed", "confirmed"]


def test_summary_of_an_emulated_drive_claims_no_hardware_and_contains_no_markup():
    summary = make_summary(make_record(step("watchdog", off(0.1))))
    assert EMULATED_BANNER in summary
    assert "confirmed on an emulated drive" in summary
    assert "A \\| B &lt;script>" in summary
    assert (
        "| `stops-without-host` | Every drive but one stops by itself when its host dies. |"
        in summary
    )


def test_key_of_another_kind_or_readable_by_all_is_refused(tmp_path: Path):
    (tmp_path / "wrong.pem").write_text("no key")
    (tmp_path / "wrong.pem").chmod(0o600)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_or_create_key(tmp_path / "wrong.pem")
    load_or_create_key(tmp_path / "key.pem")
    (tmp_path / "key.pem").chmod(0o644)
    with pytest.raises(ConfigError, match="every user"):
        load_or_create_key(tmp_path / "key.pem")
