"""`snakesim robot shape draw` and `check` check robots without IMUs, which an operator bends into drawn shapes."""

import re
from pathlib import Path

import pytest

from snakesim_operator.features.commissioning.shape.design import PLACEMENT_TOLERANCE_RAD
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.bench_host import running_bench_host
from snakesim_testing.runs.bent_robot import JOINT_COUNT, ScriptedOperator, make_bent_folder
from snakesim_testing.runs.command import CompletedRun
from snakesim_testing.runs.command import snakesim as run_snakesim
from snakesim_testing.runs.in_process_command import snakesim

DRIVE_TYPES = [
    "feetech",
    "odrive",
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in ("can", "cia402", "dynamixel", "moteus")
    ),
]
WRONG_MOUNTING = """
[backends.{backend}.mounted.joint_1]
sign = -1

[backends.{backend}.mounted.joint_2]
zero_rad = 0.2
"""
REAL_BACKEND = ("--backend", "./real.py:Real")


@pytest.mark.heavy
@pytest.mark.parametrize("backend", DRIVE_TYPES)
def test_shape_check_names_mounting_faults_on_every_drive_type(
    tmp_path: Path, backend: str
) -> None:
    home = make_bent_folder(tmp_path, backend)
    with (home / "bench.toml").open("a") as scenario:
        scenario.write(WRONG_MOUNTING.format(backend=backend))
    with running_bench_host(home, backend) as endpoint:
        code, printed = ScriptedOperator(home, endpoint, drive_order=(0, 1, 3, 2)).check()
    assert code == 1, printed
    lines = {line.split()[0]: line for line in printed.splitlines() if line.startswith("joint_")}
    assert "sign wrong: turns the other way: sign = -1" in lines["joint_1"]
    zero_error_rad = re.search(r"zero wrong: its zero is off by ([+-]\d.\d+) rad", lines["joint_2"])
    assert zero_error_rad is not None
    assert abs(float(zero_error_rad[1]) - 0.2) < PLACEMENT_TOLERANCE_RAD
    assert "order wrong: exchanged with joint_4: id = 4" in lines["joint_3"]
    assert "order wrong: exchanged with joint_3: id = 3" in lines["joint_4"]
    assert "0 of 4 joints match the robot file; 4 wrong; 0 unknown" in printed
    assert "[checked]" not in (home / "snake.toml").read_text()


def run_real_robot(home: Path, out: str, *options: str) -> CompletedRun:
    """Run the robot to its end in lockstep, and return the completed command."""
    flags = (
        *REAL_BACKEND,
        "--out",
        out,
        "--endpoint",
        find_free_endpoint(),
        "--set",
        "clock_mode=lockstep",
    )
    return run_snakesim("run", "bench.toml", *flags, *options, cwd=home)


@pytest.mark.heavy
def test_robot_without_imus_can_be_armed_after_both_checks(tmp_path: Path) -> None:
    home = make_bent_folder(tmp_path, "Real")
    robot_file = home / "snake.toml"

    # The person does not know whether one of the links is loose.
    with running_bench_host(home, "./real.py:Real") as endpoint:
        answers = ("no", "perhaps", "unknown", "no", "No")
        code, printed = ScriptedOperator(home, endpoint, shake_answers=answers).check()
    assert code == 1, printed
    assert (
        f"{JOINT_COUNT} of {JOINT_COUNT} joints match the robot file; 0 wrong; 0 unknown" in printed
    )
    assert "type no, yes or unknown" in printed
    assert "gear of joint_2 unknown: you do not know" in printed
    text = robot_file.read_text()
    assert 'by_shape = ["order", "sign", "gear", "zero"]' in text
    assert 'confirmed = ["order", "sign", "zero"]' in text
    assert 'shaken = ["joint_1", "joint_3", "joint_4"]' in text
    refused = run_real_robot(home, "never", "--duration", "0.1")
    assert refused.code == 1
    assert "did not confirm of every joint: drive, gear" in refused.out

    check_run = run_real_robot(home, "check", "--controller", "joint_check", "--duration", "14")
    assert check_run.code == 0, check_run.out
    check = ("robot", "check", "check", "--write", "snake.toml")
    unknown = snakesim(*check, cwd=home)
    assert unknown.code == 1
    assert "gear of joint_2: backlash and ratio unknown, as the floor hardly" in unknown.out
    assert "nothing was written" in unknown.out

    # The person shakes all links.
    with running_bench_host(home, "./real.py:Real") as endpoint:
        code, printed = ScriptedOperator(home, endpoint).check()
    assert code == 0, printed
    assert "no link moves before its drive does" in printed
    judged = snakesim(*check, cwd=home)
    assert judged.code == 0, judged.out
    assert f"{JOINT_COUNT} with properties that drawn shapes confirmed" in judged.out
    assert 'shaken = ["joint_1", "joint_2", "joint_3", "joint_4"]' in robot_file.read_text()
    assert run_real_robot(home, "moves", "--duration", "0.1").code == 0

    # The result of the shapes is valid only for the mounting that was checked.
    robot_file.write_text(f"{robot_file.read_text()}\n[joints.joint_2]\nsign = -1\n")
    changed = run_real_robot(home, "changed", "--duration", "0.1")
    assert "was changed in its file since" in changed.out


@pytest.mark.heavy
def test_shape_check_with_loose_link_writes_nothing(tmp_path: Path) -> None:
    home = make_bent_folder(tmp_path, "Real")
    with running_bench_host(home, "./real.py:Real") as endpoint:
        answers = ("no", "no", "yes", "unknown")
        code, printed = ScriptedOperator(home, endpoint, shake_answers=answers).check()
    assert code == 1, printed
    assert "gear of joint_3 wrong: the link moves before its drive" in printed
    assert "gear of joint_4 unknown" in printed
    assert "nothing was written: correct it" in printed
    assert "[checked]" not in (home / "snake.toml").read_text()


@pytest.mark.heavy
def test_shape_draw_writes_pdf_and_names_unknown_properties(tmp_path: Path) -> None:
    drawn = snakesim("robot", "shape", "draw", "planar13", "--out", "shapes.pdf", cwd=tmp_path)
    assert drawn.code == 0, drawn.err
    assert "shapes A, B, C, drawing " in drawn.out
    assert (tmp_path / "shapes.pdf").read_bytes().startswith(b"%PDF-1.4")
    stiff = '\nextends = "planar13"\n[joints.joint_2]\nangle_rad = 0.05\n[joints.joint_3]\nangle_rad = 0.3\n'
    (tmp_path / "stiff.toml").write_text(stiff)
    drawn = snakesim("robot", "shape", "draw", "stiff.toml", "--out", "shapes.svg", cwd=tmp_path)
    assert drawn.code == 0, drawn.err
    assert (
        "joint_2: order, sign, gear, zero will stay unknown: its limits let the shapes bend it by"
        in drawn.out
    )
    assert "joint_3: gear will stay unknown" in drawn.out
    refused = snakesim("robot", "shape", "draw", "planar13", "--out", "shapes.txt", cwd=tmp_path)
    assert refused.code == 2
    assert ".pdf" in refused.err
