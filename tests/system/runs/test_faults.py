"""Faults that are planned with `--fault` occur in runs of one process (faults that are refused: refusals.toml)."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

MAX_ONE_ISOLATED_JOINT = "robot.safety.max_isolated_joints=1"
slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("backend", "fault", "what"),
    [
        ("sim", "mute:joint_3@1", "state_invalid"),
        slow("sim", "nan:joint_3@1", "state_invalid"),
        slow("sim", "diverge:simulator@1", "backend_failed"),
        ("can", "mute:joint_3@1", "module_silent"),
        slow("can", "leak:joint_3@1", "module_leak"),
        slow("can", "cut:bus_1@1-1.3", "interface_down"),
        slow("odrive", "mute:joint_3@1", "drive_silent"),
        slow("odrive", "reboot:joint_3@1", "drive_silent"),  # as dynamixel
        slow("odrive", "overheat:joint_3@1", "drive_fault"),
        slow("odrive", "cut:bus_1@1-1.3", "interface_down"),  # as can
        slow("moteus", "mute:joint_3@1", "drive_silent"),  # as odrive
        slow("moteus", "reboot:joint_3@1", "drive_silent"),  # as odrive
        slow("moteus", "overheat:joint_3@1", "drive_fault"),  # as odrive
        slow("moteus", "cut:bus_1@1-1.3", "interface_down"),  # as odrive
        slow("dynamixel", "mute:joint_3@1", "drive_silent"),  # as odrive
        slow("dynamixel", "reboot:joint_3@1", "drive_silent"),
        slow("dynamixel", "overheat:joint_3@1", "drive_fault"),  # as odrive
        slow("dynamixel", "undervoltage:joint_3@1", "drive_fault"),
        ("dynamixel", "cut:bus_1@1-1.3", "interface_down"),
        slow("mixed", "reboot:joint_12@1", "drive_silent"),  # as dynamixel
        slow("mixed", "cut:bus_2@1-1.3", "interface_down"),
    ],
)
def test_planned_fault_occurs_at_its_tick_and_ends_run(
    tmp_path: Path, backend: str, fault: str, what: str
) -> None:
    robot_option = ("--set", "robot=planar13_mixed") if backend == "mixed" else ()
    result, summary = run_to_summary(
        tmp_path / "run", "triplet", "--backend", backend, *robot_option, "--fault", fault
    )
    record = RunRecord.load(tmp_path / "run").host
    # A drive reports its own fault in its heartbeat of 10 Hz.
    last_tick = 112 if what == "drive_fault" else 104
    assert result.code == 1
    assert summary.faults[0].what == what
    assert record.injected[0].startswith(f"tick 100: {fault} ")
    assert 100 <= record.faults[0].tick <= last_tick
    assert record.lifecycle == "fault"


@pytest.mark.heavy
@pytest.mark.parametrize(
    "backend", ["sim", "can", slow("odrive"), slow("moteus"), slow("dynamixel")]
)
def test_isolated_joint_is_passive_while_run_continues(tmp_path: Path, backend: str) -> None:
    flags = [
        "--backend",
        backend,
        "--fault",
        "mute:joint_5@1",
        "--duration",
        "1.5",
        "--set",
        MAX_ONE_ISOLATED_JOINT,
    ]
    result, summary = run_to_summary(tmp_path / "run", "triplet", *flags)
    assert result.code == 0, result.out
    assert summary.ended == "complete", result.out
    assert summary.duration_s == 1.5, result.out
    assert summary.isolated == ["joint_5"]
    assert summary.faults[0].joint == "joint_5"
    assert "isolated              joint_5: failed, and passive since" in result.out
    record = RunRecord.load(tmp_path / "run")
    joint_5 = 4  # its index
    ticks_before = slice(50, 95)
    ticks_after = slice(106, 150)
    assert (record.mode[ticks_before, joint_5] == JointMode.POSITION).all()
    assert (record.mode[ticks_after, joint_5] == JointMode.PASSIVE).all()
    assert (record.torque_limit_nm[ticks_after, joint_5] == 0.0).all()
    modes_of_others = np.delete(record.mode, joint_5, axis=1)
    assert (modes_of_others[ticks_after] != JointMode.PASSIVE).all()


def test_fault_list_is_printed_without_a_robot(tmp_path: Path) -> None:
    result = snakesim("fault", "list", cwd=tmp_path)
    assert result.code == 0
    assert "undervoltage" in result.out
