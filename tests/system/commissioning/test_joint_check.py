"""`snakesim robot check` names every defect of emulated joint modules, and none on a robot without defects."""

import re
from pathlib import Path

import pytest

from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

JOINT_COUNT = 9
DEFECTS = {  # settings of an emulated module, and the line that the command must print
    "joint_1.zero_rad=0.15": "joint_1 .* its zero is off by .0.150 rad: zero_rad = 0.1",
    "joint_3.sign=-1": "joint_3 .* turns the other way: sign = -1",
    "joint_5.connected=false": "joint_5 .* did not move",
    "joint_2.id=8": "joint_2 .* moves the link of joint_8: their ids or cables are swapped",
    "joint_8.id=2": "joint_8 .* moves the link of joint_2: their ids or cables are swapped",
    "joint_7.gear=2": "joint_7 .* turns 0.5",
    "joint_6.backlash_rad=0.035": "joint_6 .* backlash of 0.0[34]",
}


def run_joint_check(out: Path, *defects: str) -> tuple[int, list[str]]:
    """Run the start check, and return exit code and lines of `snakesim robot check`."""
    mounting = [
        argument for defect in defects for argument in ("--set", f"backends.can.mounted.{defect}")
    ]
    short_robot = ("--set", f"robot.chain.modules={JOINT_COUNT}", "--duration", "32")
    run, _ = run_to_summary(out, "joint_check", "--backend", "can", *short_robot, *mounting)
    assert "Every joint was moved. Judge the run with `snakesim robot check " in run.out
    assert "no fault." in run.out
    completed = snakesim("robot", "check", str(out), "--straight", cwd=out.parent)
    return completed.code, completed.out.splitlines()


@pytest.mark.slow  # verification/test_commissioning_trials.py hides one defect of each kind
def test_joint_check_names_every_defect_and_no_sound_joint(tmp_path: Path) -> None:
    code, lines = run_joint_check(tmp_path / "run", *DEFECTS)
    assert code == 1
    for defect, pattern in DEFECTS.items():
        assert any(re.match(pattern, line) for line in lines), f"{defect}: {lines}"
    sound_count = JOINT_COUNT - len(DEFECTS)
    summary = f"{sound_count} of {JOINT_COUNT} joints match the robot file; {len(DEFECTS)} wrong"
    assert summary in lines


@pytest.mark.slow
def test_joint_check_of_sound_robot_passes(tmp_path: Path) -> None:
    code, lines = run_joint_check(tmp_path / "run")
    assert code == 0, lines
    assert f"{JOINT_COUNT} of {JOINT_COUNT} joints match the robot file" in lines, lines


@pytest.mark.heavy
def test_loose_end_joint_without_imus_is_reported_with_end_weights(tmp_path: Path) -> None:
    """Without weights, the torque of joint_1 could be that of a sound joint whose light link slides."""
    settings = ("robot.chain.modules=4", "backends.odrive.mounted.joint_1.coupling_slip_nm=0.02")
    run_to_summary(
        tmp_path / "run",
        *("joint_check", "--backend", "odrive", "--duration", "14"),
        *(argument for setting in settings for argument in ("--set", setting)),
    )
    judge = ("robot", "check", "run", "--straight")
    light_ends = snakesim(*judge, cwd=tmp_path)
    weighted_ends = snakesim(*judge, "--end-weights", "1", cwd=tmp_path)
    assert re.search("joint_1 .*unknown: order, sign, gear$", light_ends.out, re.MULTILINE)
    assert "add --end-weights" in light_ends.out
    assert re.search("joint_1 .*(coupling slips|loose)", weighted_ends.out)
    assert "; 1 wrong; 3 unknown" in weighted_ends.out


def test_check_and_identify_of_other_scenario_are_refused(tmp_path: Path) -> None:
    run_to_summary(tmp_path / "run", "triplet", "--duration", "0.1")
    for arguments, scenario in (
        (("robot", "check", "run"), "joint_check"),
        (("robot", "identify", "run"), "identify"),
    ):
        completed = snakesim(*arguments, cwd=tmp_path)
        assert completed.code == 2
        assert f"snakesim run {scenario}" in completed.err
