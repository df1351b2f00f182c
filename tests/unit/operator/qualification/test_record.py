"""The record of a qualification: its claims follow from its checks, and its signature covers every field."""

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


def make_step(key: str, *checks: Check, problem: str = "") -> StepResult:
    """Make the result of a step with these checks."""
    return StepResult(
        key=key,
        title=key,
        criterion="A criterion.",
        caused_by="program",
        finished_utc="2026-01-01T00:00:00Z",
        checks=checks,
        problem=problem,
    )


def make_torque_off_check(value: float | None, claim: str = "stops-without-host") -> Check:
    """Make the check of a measured time until the torque is off, which must be at most 0.2 s."""
    return Check(
        name="torque off",
        value=value,
        unit="s",
        maximum=0.2,
        source="drive log",
        claims=(claim,),
    )


def make_record(*steps: StepResult) -> Record:
    """Make an unsigned record of an emulated drive."""
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
        (
            [
                make_step("watchdog", make_torque_off_check(0.1)),
                make_step("freeze", make_torque_off_check(0.1)),
            ],
            "confirmed",
        ),
        (
            [
                make_step("watchdog", make_torque_off_check(0.1)),
                make_step("freeze", make_torque_off_check(0.9)),
            ],
            "refuted",
        ),
        (
            [
                make_step("watchdog", make_torque_off_check(0.1)),
                make_step("freeze", make_torque_off_check(None)),
            ],
            "unknown",
        ),
        ([make_step("watchdog", make_torque_off_check(0.1), problem="the host ended")], "unknown"),
        (
            [make_step("estop_key", make_torque_off_check(0.1, "estop-off-at-once"))],
            "unknown",
        ),
        ([], "unknown"),
    ],
)
def test_claim_is_confirmed_only_if_all_its_checks_are(steps: list[StepResult], verdict: str):
    verdicts = {claim.id: claim.verdict for claim in judge_claims("moteus", tuple(steps))}
    assert verdicts["stops-without-host"] == verdict
    assert "holds-without-host" not in verdicts, "this claim is of another driver type"


def test_step_with_problem_or_without_checks_is_unknown():
    assert (
        make_step("watchdog", make_torque_off_check(0.1), problem="the host ended").verdict
        == "unknown"
    )
    assert make_step("watchdog").verdict == "unknown"


def test_signed_record_is_read_back_and_valid(tmp_path: Path):
    key = load_or_create_key(tmp_path / "state" / "key.pem")
    assert (tmp_path / "state" / "key.pem").stat().st_mode & 0o077 == 0
    record = sign_record(make_record(make_step("watchdog", make_torque_off_check(0.1))), key)
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


def test_record_with_whole_numbers_keeps_valid_signature(tmp_path: Path):
    check = Check(name="mode", value=5, minimum=5, maximum=5, source="drive status")
    record = make_record(make_step("configuration", check))
    write_record(sign_record(record, load_or_create_key(tmp_path / "k")), tmp_path / "r")
    assert find_signature_problem(read_record(tmp_path / "r")) == ""


def test_changed_record_is_not_valid(tmp_path: Path):
    record = sign_record(
        make_record(make_step("watchdog", make_torque_off_check(0.9))),
        load_or_create_key(tmp_path / "key.pem"),
    )
    real_drive = msgspec.structs.replace(
        record, subject=msgspec.structs.replace(SUBJECT, emulated=False)
    )
    better_value = msgspec.structs.replace(
        record, steps=(make_step("watchdog", make_torque_off_check(0.1)),)
    )
    for changed in (real_drive, better_value, msgspec.structs.replace(record, operator="another")):
        assert "changed after it was signed" in find_signature_problem(changed)
    unsigned = msgspec.structs.replace(record, signature=None)
    assert find_signature_problem(unsigned) == "it is not signed"


def test_record_with_claims_against_its_checks_has_claim_problem(tmp_path: Path):
    record = make_record(make_step("watchdog", make_torque_off_check(0.9)))
    claims = tuple(msgspec.structs.replace(claim, verdict="confirmed") for claim in record.claims)
    signed = sign_record(
        msgspec.structs.replace(record, claims=claims), load_or_create_key(tmp_path / "key.pem")
    )
    assert find_signature_problem(signed) == ""
    assert find_claim_problem(signed)


def test_record_with_unknown_field_is_refused(tmp_path: Path):
    # No signature covers a field that the record does not define.
    text = encode_record(make_record()).replace(b'"operator"', b'"approved": true, "operator"')
    (tmp_path / "record.json").write_bytes(text)
    with pytest.raises(ConfigError, match="no record"):
        read_record(tmp_path / "record.json")


def test_interrupted_record_is_resumed_only_with_the_same_drive():
    record = make_record()
    assert find_resume_conflict(record, SUBJECT) == ""
    real_drive = msgspec.structs.replace(SUBJECT, emulated=False)
    assert "emulated" in find_resume_conflict(record, real_drive)
    real_record = msgspec.structs.replace(record, subject=real_drive)
    other_serial = msgspec.structs.replace(real_drive, serial="9")
    assert "serial" in find_resume_conflict(real_record, other_serial)
    other_config = msgspec.structs.replace(SUBJECT, config_hash="x")
    assert "config_hash" in find_resume_conflict(record, other_config)


def test_repeated_step_replaces_the_earlier_one():
    record = replace_step(
        make_record(make_step("watchdog", make_torque_off_check(None))),
        make_step("watchdog", make_torque_off_check(0.1)),
    )
    assert [result.verdict for result in record.steps] == ["confirmed"]


def test_repeated_step_keeps_its_place():
    record = make_record(
        make_step("watchdog", make_torque_off_check(None)),
        make_step("freeze", make_torque_off_check(0.1)),
    )
    repeated = replace_step(record, make_step("watchdog", make_torque_off_check(0.1)))
    assert [result.key for result in repeated.steps] == ["watchdog", "freeze"]
    assert [result.verdict for result in repeated.steps] == ["confirmed", "confirmed"]


def test_summary_of_emulated_drive_has_banner_and_escaped_markup():
    summary = make_summary(make_record(make_step("watchdog", make_torque_off_check(0.1))))
    assert EMULATED_BANNER in summary
    assert "confirmed on an emulated drive" in summary
    assert "A \\| B &lt;script>" in summary
    assert (
        "| `stops-without-host` | Every drive but one stops by itself when its host dies. |"
        in summary
    )


def test_signature_key_that_is_invalid_or_readable_is_refused(tmp_path: Path):
    (tmp_path / "wrong.pem").write_text("no key")
    (tmp_path / "wrong.pem").chmod(0o600)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_or_create_key(tmp_path / "wrong.pem")
    load_or_create_key(tmp_path / "key.pem")
    (tmp_path / "key.pem").chmod(0o644)
    with pytest.raises(ConfigError, match="every user"):
        load_or_create_key(tmp_path / "key.pem")
