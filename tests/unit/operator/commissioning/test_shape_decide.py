"""Drawn shapes: every hidden fault by its name, and no false alarm, on robots placed within the tolerance."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.checked import JointProperty
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.wire.messages import Axis
from snakesim_operator.features.commissioning.shape.decide import (
    SHAPE_PROPERTIES,
    ShapeVerdict,
    find_placement_hint,
    judge_shapes,
)
from snakesim_operator.features.commissioning.shape.design import (
    PLACEMENT_TOLERANCE_RAD,
    ShapePose,
    design_poses,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count

TRIALS = choose_trial_count(100)  # at least one with each fault
SMALLEST_ZERO_RAD = 2.02 * PLACEMENT_TOLERANCE_RAD  # that is always found
GEAR_ERRORS = (0.25, 0.5, 2 / 3, 0.87, 1.14, 1.5, 2.0, 4.0)
FAULTS = (
    "sign",
    "gear",
    "zero",
    "exchange",
    "cycle of three",
    "sign and gear",
    "sign and zero",
    "exchange and sign",
)


@dataclass(frozen=True)
class HiddenRobot:
    """A robot as its file describes it, and as it really is."""

    file: Sequence[Joint]
    built: Sequence[Joint]
    place_by_drive: Sequence[int]  # the joint on which each drive of the file really is
    faults: dict[int, set[JointProperty]]  # by joint
    poses: Sequence[ShapePose]

    def measure(self, rng: np.random.Generator, *, at_the_tolerance: bool = False) -> Floats:
        """Place it in all poses, and return what the host measures, (n_poses, n_joints)."""
        drawn_rad = np.array([pose.angle_rad for pose in self.poses])
        errors = rng.uniform(-1.0, 1.0, drawn_rad.shape)
        if at_the_tolerance:
            errors = np.sign(errors)
        placed_rad = drawn_rad + errors * (PLACEMENT_TOLERANCE_RAD - 1e-9)
        drive_rad = DriveMounting(self.built).to_drive_angle_rad(placed_rad)
        return DriveMounting(self.file).to_joint_angle_rad(drive_rad[:, list(self.place_by_drive)])


def make_joints(rng: np.random.Generator, count: int) -> list[Joint]:
    """Joints with mountings of their own, that yaw, or yaw and pitch."""
    joint = decode_table(read_table_with_base("planar13", "robots"), RobotFile).joint_table[0]
    axes: list[Axis] = ["yaw", "pitch"] if rng.integers(2) else ["yaw"]
    joints: list[Joint] = []
    for i in range(count):
        drive = msgspec.structs.replace(
            joint.drive,
            sign=int(rng.choice((1, -1))),
            zero_rad=float(rng.uniform(-3.0, 3.0)),
            gear=float(rng.choice((0.5, 1.0, 50.0))),
        )
        joints.append(
            dataclasses.replace(
                joint, name=f"joint_{i + 1}", axis=axes[i % len(axes)], id=i + 1, drive=drive
            )
        )
    return joints


def make_robot(trial: int, fault: str | None) -> tuple[HiddenRobot, np.random.Generator]:
    """A random robot with one hidden fault, or with none."""
    rng = np.random.default_rng(trial)
    count = int(rng.integers(3, 19))
    file = make_joints(rng, count)
    built = list(file)
    places = list(range(count))
    faults: dict[int, set[JointProperty]] = {}
    first, second, third = rng.permutation(count)[:3].tolist()

    def rebuild(name: JointProperty, **fields: Any) -> None:
        built[first] = dataclasses.replace(
            built[first], drive=msgspec.structs.replace(built[first].drive, **fields)
        )
        faults.setdefault(first, set()).add(name)

    def move(*joints: int) -> None:
        for joint, other in zip(joints, (*joints[1:], joints[0]), strict=True):
            places[joint] = other
            faults.setdefault(joint, set()).add("order")

    drive = file[first].drive
    for name in fault.split(" and ") if fault else ():
        match name:
            case "sign":
                rebuild("sign", sign=-drive.sign)
            case "gear":
                rebuild("gear", gear=drive.gear * float(rng.choice(GEAR_ERRORS)))
            case "zero":
                off_rad = float(rng.choice((-1, 1)) * rng.uniform(SMALLEST_ZERO_RAD, 2.0))
                rebuild("zero", zero_rad=drive.zero_rad + drive.gear * off_rad)
            case "exchange":
                move(first, second)
            case _:
                move(first, second, third)
    return HiddenRobot(file, built, places, faults, design_poses(file)), rng


def list_states(verdicts: Sequence[ShapeVerdict], state: str) -> dict[int, set[JointProperty]]:
    """The properties in this state, by the index of their joint."""
    states: dict[int, set[JointProperty]] = {}
    for joint, verdict in enumerate(verdicts):
        names: set[JointProperty] = {
            name for name in SHAPE_PROPERTIES if verdict.findings[name].state == state
        }
        if names:
            states[joint] = names
    return states


@pytest.mark.trials
@pytest.mark.parametrize("at_the_tolerance", [False, True])
def test_shapes_name_the_fault_of_each_random_robot_and_no_other(at_the_tolerance: bool) -> None:
    for trial in range(TRIALS):
        fault = FAULTS[trial % len(FAULTS)]
        robot, rng = make_robot(trial, fault)
        verdicts = judge_shapes(
            robot.file, robot.poses, robot.measure(rng, at_the_tolerance=at_the_tolerance)
        )
        assert list_states(verdicts, "wrong") == robot.faults, f"trial {trial}, {fault}: {verdicts}"
        assert list_states(verdicts, "unknown") == {}, f"trial {trial}, {fault}: {verdicts}"


@pytest.mark.trials
@pytest.mark.parametrize("at_the_tolerance", [False, True])
def test_shapes_confirm_each_random_robot_that_is_as_their_file(at_the_tolerance: bool) -> None:
    for trial in range(1000, 1000 + TRIALS):
        robot, rng = make_robot(trial, None)
        verdicts = judge_shapes(
            robot.file, robot.poses, robot.measure(rng, at_the_tolerance=at_the_tolerance)
        )
        assert all(verdict.all_confirmed for verdict in verdicts), f"trial {trial}: {verdicts}"


def test_reasons_state_what_the_file_should_have() -> None:
    robot, _ = make_robot(1, None)
    joints = [
        dataclasses.replace(
            joint, drive=msgspec.structs.replace(joint.drive, sign=1, zero_rad=0.0, gear=1.0)
        )
        for joint in robot.file
    ]
    poses = design_poses(joints)
    reading_rad = np.array([pose.angle_rad for pose in poses])
    reading_rad[:, 0] *= -1
    reading_rad[:, 1] *= 2
    reading_rad[:, 2] += 0.3
    reading_rad[:, [3, 4]] = reading_rad[:, [4, 3]]
    verdicts = judge_shapes(joints, poses, reading_rad)
    assert verdicts[0].findings["sign"].reason == "turns the other way: sign = -1"
    assert (
        verdicts[1].findings["gear"].reason == "turns 0.50 as far as its drive measures: gear = 2"
    )
    assert verdicts[2].findings["zero"].reason == "its zero is off by +0.300 rad: zero_rad = 0.300"
    assert verdicts[3].findings["order"].reason == "exchanged with joint_5: id = 5"
    assert verdicts[4].findings["order"].reason == "exchanged with joint_4: id = 4"


# --- what stays unknown ----------------------------------------------------------------------------------------


def judge_changed_readings(joint: int, change: Floats) -> list[ShapeVerdict]:
    """Judge a robot without faults, one joint of which reads other angles: in each pose, by the change more."""
    robot, _ = make_robot(2, None)
    reading_rad = np.array([pose.angle_rad for pose in robot.poses])
    reading_rad[:, joint] += change
    return judge_shapes(robot.file, robot.poses, reading_rad)


def test_a_coupling_that_slips_or_a_wrong_placement_is_unknown_with_its_size() -> None:
    robot, _ = make_robot(2, None)
    change = np.zeros(len(robot.poses))
    change[1] = 0.5
    change[2] = 0.45
    verdicts = judge_changed_readings(1, change)
    assert set(list_states(verdicts, "unknown")) == {1}
    assert "its readings fit no joint: here it would be 0." in verdicts[1].findings["order"].reason


def test_an_encoder_that_never_changes_is_unknown() -> None:
    robot, _ = make_robot(2, None)
    change = -np.array([pose.angle_rad[1] for pose in robot.poses])
    verdicts = judge_changed_readings(1, change)
    assert "its angle never changed" in verdicts[1].findings["order"].reason
    assert not verdicts[1].all_confirmed


def test_two_drives_that_measure_one_joint_are_both_unknown() -> None:
    robot, _ = make_robot(2, None)
    reading_rad = np.array([pose.angle_rad for pose in robot.poses])
    reading_rad[:, 2] = reading_rad[:, 0]
    verdicts = judge_shapes(robot.file, robot.poses, reading_rad)
    for joint in (0, 2):
        assert (
            verdicts[joint]
            .findings["order"]
            .reason.startswith("joint_1 and joint_3 all measure joint_1")
        )


@pytest.mark.parametrize(
    ("limit_rad", "unknown"),
    [(0.02, {*SHAPE_PROPERTIES}), (0.3, {"gear"}), (0.6, set[JointProperty]())],
)
def test_a_joint_that_hardly_bends_is_unknown_with_what_is_needed(
    limit_rad: float, unknown: set[JointProperty]
) -> None:
    robot, _ = make_robot(2, None)
    joints = list(robot.file)
    limits = msgspec.structs.replace(joints[1].limits, angle_rad=limit_rad)
    joints[1] = dataclasses.replace(joints[1], limits=limits)
    poses = design_poses(joints)
    verdicts = judge_shapes(joints, poses, np.array([pose.angle_rad for pose in poses]))
    assert list_states(verdicts, "unknown") == ({1: unknown} if unknown else {})
    assert list_states(verdicts, "wrong") == {}


def test_a_robot_that_lay_on_its_back_gets_a_hint() -> None:
    robot, _ = make_robot(2, None)
    reading_rad = np.array([pose.angle_rad for pose in robot.poses])
    mirrored = judge_shapes(robot.file, robot.poses, -reading_rad)
    assert "its head at the arrow" in find_placement_hint(mirrored)
    assert find_placement_hint(judge_shapes(robot.file, robot.poses, reading_rad)) == ""


@pytest.mark.trials
@pytest.mark.parametrize("limit_rad", [0.5, 0.7])
def test_no_fault_of_robots_that_bend_less_is_confirmed_and_no_sound_joint_is_blamed(
    limit_rad: float,
) -> None:
    for trial in range(max(TRIALS // 4, len(FAULTS))):
        robot, rng = make_robot(trial, FAULTS[trial % len(FAULTS)])
        file = [shorten_travel(joint, limit_rad) for joint in robot.file]
        built = [shorten_travel(joint, limit_rad) for joint in robot.built]
        robot = dataclasses.replace(robot, file=file, built=built, poses=design_poses(file))
        verdicts = judge_shapes(robot.file, robot.poses, robot.measure(rng))
        found = list_states(verdicts, "wrong")
        assert set(found) <= set(robot.faults), f"trial {trial}: {verdicts}"
        assert not any(verdicts[joint].all_confirmed for joint in robot.faults), (
            f"trial {trial}: {verdicts}"
        )
        assert "order" not in {
            name for names in list_states(verdicts, "unknown").values() for name in names
        }


def shorten_travel(joint: Joint, limit_rad: float) -> Joint:
    return dataclasses.replace(
        joint, limits=msgspec.structs.replace(joint.limits, angle_rad=limit_rad)
    )
