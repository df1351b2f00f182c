"""Hidden faults of emulated robots, one trial of each kind; `python -m verification.commissioning_trials` has more."""

import pytest

from snakesim_operator.features.commissioning.joint_check.gear_rules import IS_LOOSE
from verification.commissioning_trials import identify_trials
from verification.start_check_trials import NONE, check_trial


@pytest.mark.parametrize("fault", ["backlash", NONE])
def test_hidden_fault_is_named_without_blaming_sound_joints(fault: str) -> None:
    trial = check_trial(4, fault, joint_count=4)
    assert not trial.blamed and not trial.unsure, (trial.blamed, trial.unsure)
    assert fault == NONE or trial.found, [row.summary for row in trial.rows]


@pytest.mark.slow
def test_wrong_torque_constants_are_reported_and_no_right_one() -> None:
    for trial in identify_trials(4, "duration_s=12", backlash=False):
        assert trial.reported_constants == trial.wrong_constants == 4
        assert not trial.falsely_reported_constants


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "number", "fault"),
    [
        ("feetech", 30, "backlash"),  # which do not measure their torque
        ("odrive", 6, "dead zone"),
        ("odrive", 40, "coupling"),
    ],
)
def test_hidden_fault_of_robot_without_imus_is_named(backend: str, number: int, fault: str) -> None:
    trial = check_trial(number, fault, backend=backend)
    assert trial.found, [row.summary for row in trial.rows]
    assert not trial.blamed


@pytest.mark.slow
def test_backlash_wider_than_the_motion_is_not_called_a_coupling() -> None:
    wide = "backends.odrive.mounted.joint_4.backlash_rad=0.3"
    trial = check_trial(5003, NONE, wide, backend="odrive")
    gear = trial.rows[3].findings["gear"]
    assert gear.state == "wrong"
    assert gear.reason.startswith(IS_LOOSE)
    assert "backlash" in gear.reason


@pytest.mark.slow
def test_backlash_spoils_no_values_of_other_joints() -> None:
    named, unnamed = identify_trials(4, "duration_s=12", backlash=True)
    assert named.named == [named.loose]
    for trial in (named, unnamed):
        assert trial.covered == trial.written and trial.constants_off == 0
