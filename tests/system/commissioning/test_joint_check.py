"""The start check: seven defects at once on emulated modules, each named; and a robot without any."""

import re
from pathlib import Path

import pytest

from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

JOINTS = 9
DEFECTS = {
    "joint_1.zero_rad=0.15": "joint_1 .* its zero is off by .0.150 rad: zero_rad = 0.1",
    "joint_3.sign=-1": "joint_3 .* turns the other way: sign = -1",
    "joint_5.connected=false": "joint_5 .* did not move",
    "joint_2.id=8": "joint_2 .* moves the link of joint_8: their ids or cables are swapped",
    "joint_8.id=2": "joint_8 .* moves the link of joint_2: their ids or cables are swapped",
    "joint_7.gear=2": "joint_7 .* turns 0.5",
    "joint_6.backlash_rad=0.035": "joint_6 .* backlash of 0.0[34]",
}


def check(out: Path, *sets: str) -> tuple[int, list[str]]:
    truth = [word for text in sets for word in ("--set", f"backends.can.mounted.{text}")]
    short = ("--set", f"robot.chain.modules={JOINTS}", "--duration", "32")
    run, _ = run_to_summary(out, "joint_check", "--backend", "can", *short, *truth)
    assert "Every joint was moved. Judge the run with `snakesim robot check " in run.out
    assert "no fault." in run.out
    ended = snakesim("robot", "check", str(out), "--straight", cwd=out.parent)
    return ended.code, ended.out.splitlines()


@pytest.mark.slow  # verification/test_commissioning_trials.py hides one defect of each kind
def test_every_defect_is_named_and_no_sound_joint_is(tmp_path: Path) -> None:
    code, lines = check(tmp_path / "run", *DEFECTS)
    assert code == 1
    for defect, said in DEFECTS.items():
        assert any(re.match(said, line) for line in lines), f"{defect}: {lines}"
    assert (
        f"{JOINTS - len(DEFECTS)} of {JOINTS} joints match the robot file; {len(DEFECTS)} wrong"
        in lines
    )


@pytest.mark.slow
def test_a_sound_robot_passes(tmp_path: Path) -> None:
    code, lines = check(tmp_path / "run")
    assert code == 0 and f"{JOINTS} of {JOINTS} joints match the robot file" in lines, lines


def test_a_run_of_another_scenario_is_neither_checked_nor_identified(tmp_path: Path) -> None:
    run_to_summary(tmp_path / "run", "triplet", "--duration", "0.1")
    for typed, wanted in (
        (("robot", "check", "run"), "joint_check"),
        (("robot", "identify", "run"), "identify"),
    ):
        ended = snakesim(*typed, cwd=tmp_path)
        assert ended.code == 2
        assert f"snakesim run {wanted}" in ended.err
