"""Judges robots that lie on drawn shapes: every hidden fault is named, and no joint without a fault is blamed."""

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
MIN_ZERO_ERROR_RAD = 2.02 * PLACEMENT_TOLERANCE_RAD  # smaller errors may be placement errors
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
    """A robot whose construction may differ from its file."""

    file_joints: Sequence[Joint]
    built_joints: Sequence[Joint]
    joint_by_drive: Sequence[int]  # index of the joint on which each drive of the file really is
    faults: dict[int, set[JointProperty]]  # by joint index
    poses: Sequence[ShapePose]

    def measure_angles_rad(
        self, rng: np.random.Generator, *, at_the_tolerance: bool = False
    ) -> Floats:
        """Place the robot in all poses, with random placement errors.

        Args:
            rng: chooses the placement errors.
            at_the_tolerance: whether every error has the largest allowed size.

        Returns:
            The joint angles that the host measures, (n_poses, n_joints).
        """
        drawn_rad = np.array([pose.angle_rad for pose in self.poses])
        relative_errors = rng.uniform(-1.0, 1.0, drawn_rad.shape)
        if at_the_tolerance:
            relative_errors = np.sign(relative_errors)
        placed_rad = drawn_rad + relative_errors * (PLACEMENT_TOLERANCE_RAD - 1e-9)
        drive_rad = DriveMounting(self.built_joints).to_drive_angle_rad(placed_rad)
        return DriveMounting(self.file_joints).to_joint_angle_rad(
            drive_rad[:, list(self.joint_by_drive)]
        )


def make_joints(rng: np.random.Generator, count: int) -> list[Joint]:
    """Make joints with random mountings, which all yaw, or yaw and pitch in turn."""
    robot_file = decode_table(read_table_with_base("planar13", "robots"), RobotFile)
    joint = robot_file.joint_table[0]
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
    """Make a random robot with one hidden fault, or with none, and the generator for its placement errors."""
    rng = np.random.default_rng(trial)
    count = int(rng.integers(3, 19))
    file_joints = make_joints(rng, count)
    built_joints = list(file_joints)
    joint_by_drive = list(range(count))
    faults: dict[int, set[JointProperty]] = {}
    first, second, third = rng.permutation(count)[:3].tolist()

    def change_drive(name: JointProperty, **fields: Any) -> None:
        """Build the first chosen joint with other fields of its drive."""
        joint = built_joints[first]
        built_joints[first] = dataclasses.replace(
            joint, drive=msgspec.structs.replace(joint.drive, **fields)
        )
        faults.setdefault(first, set()).add(name)

    def rotate_places(*joints: int) -> None:
        """Build each of these drives into the place of the next one."""
        for joint, next_joint in zip(joints, (*joints[1:], joints[0]), strict=True):
            joint_by_drive[joint] = next_joint
            faults.setdefault(joint, set()).add("order")

    drive = file_joints[first].drive
    for name in fault.split(" and ") if fault else ():
        match name:
            case "sign":
                change_drive("sign", sign=-drive.sign)
            case "gear":
                change_drive("gear", gear=drive.gear * float(rng.choice(GEAR_ERRORS)))
            case "zero":
                error_rad = float(rng.choice((-1, 1)) * rng.uniform(MIN_ZERO_ERROR_RAD, 2.0))
                change_drive("zero", zero_rad=drive.zero_rad + drive.gear * error_rad)
            case "exchange":
                rotate_places(first, second)
            case _:
                rotate_places(first, second, third)
    robot = HiddenRobot(
        file_joints, built_joints, joint_by_drive, faults, design_poses(file_joints)
    )
    return robot, rng


def list_states(verdicts: Sequence[ShapeVerdict], state: str) -> dict[int, set[JointProperty]]:
    """Return the properties with this state of each joint, by its index."""
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
def test_shapes_name_only_the_fault_of_each_random_robot(at_the_tolerance: bool) -> None:
    for trial in range(TRIALS):
        fault = FAULTS[trial % len(FAULTS)]
        robot, rng = make_robot(trial, fault)
        verdicts = judge_shapes(
            robot.file_joints,
            robot.poses,
            robot.measure_angles_rad(rng, at_the_tolerance=at_the_tolerance),
        )
        assert list_states(verdicts, "wrong") == robot.faults, f"trial {trial}, {fault}: {verdicts}"
        assert list_states(verdicts, "unknown") == {}, f"trial {trial}, {fault}: {verdicts}"


@pytest.mark.trials
@pytest.mark.parametrize("at_the_tolerance", [False, True])
def test_shapes_confirm_each_random_robot_that_matches_its_file(at_the_tolerance: bool) -> None:
    for trial in range(1000, 1000 + TRIALS):
        robot, rng = make_robot(trial, None)
        verdicts = judge_shapes(
            robot.file_joints,
            robot.poses,
            robot.measure_angles_rad(rng, at_the_tolerance=at_the_tolerance),
        )
        assert all(verdict.all_confirmed for verdict in verdicts), f"trial {trial}: {verdicts}"


def test_shapes_reason_states_correct_value_for_file() -> None:
    robot, _ = make_robot(1, None)
    joints = [
        dataclasses.replace(
            joint, drive=msgspec.structs.replace(joint.drive, sign=1, zero_rad=0.0, gear=1.0)
        )
        for joint in robot.file_joints
    ]
    poses = design_poses(joints)
    measured_rad = np.array([pose.angle_rad for pose in poses])
    measured_rad[:, 0] *= -1
    measured_rad[:, 1] *= 2
    measured_rad[:, 2] += 0.3
    measured_rad[:, [3, 4]] = measured_rad[:, [4, 3]]
    verdicts = judge_shapes(joints, poses, measured_rad)
    assert verdicts[0].findings["sign"].reason == "turns the other way: sign = -1"
    assert (
        verdicts[1].findings["gear"].reason == "turns 0.50 as far as its drive measures: gear = 2"
    )
    assert verdicts[2].findings["zero"].reason == "its zero is off by +0.300 rad: zero_rad = 0.300"
    assert verdicts[3].findings["order"].reason == "exchanged with joint_5: id = 5"
    assert verdicts[4].findings["order"].reason == "exchanged with joint_4: id = 4"


# --- properties that stay unknown ------------------------------------------------------------------


def judge_changed_angles(joint: int, change_rad: Floats) -> list[ShapeVerdict]:
    """Judge a robot without faults after a change of one joint's measured angle in each pose."""
    robot, _ = make_robot(2, None)
    measured_rad = np.array([pose.angle_rad for pose in robot.poses])
    measured_rad[:, joint] += change_rad
    return judge_shapes(robot.file_joints, robot.poses, measured_rad)


def test_shapes_slipping_coupling_or_wrong_placement_is_unknown_with_size() -> None:
    robot, _ = make_robot(2, None)
    change_rad = np.zeros(len(robot.poses))
    change_rad[1] = 0.5
    change_rad[2] = 0.45
    verdicts = judge_changed_angles(1, change_rad)
    assert set(list_states(verdicts, "unknown")) == {1}
    assert "its readings fit no joint: here it would be 0." in verdicts[1].findings["order"].reason


def test_shapes_encoder_that_never_changes_is_unknown() -> None:
    robot, _ = make_robot(2, None)
    change_rad = -np.array([pose.angle_rad[1] for pose in robot.poses])
    verdicts = judge_changed_angles(1, change_rad)
    assert "its angle never changed" in verdicts[1].findings["order"].reason
    assert not verdicts[1].all_confirmed


def test_shapes_two_drives_that_measure_one_joint_are_unknown() -> None:
    robot, _ = make_robot(2, None)
    measured_rad = np.array([pose.angle_rad for pose in robot.poses])
    measured_rad[:, 2] = measured_rad[:, 0]
    verdicts = judge_shapes(robot.file_joints, robot.poses, measured_rad)
    for joint in (0, 2):
        reason = verdicts[joint].findings["order"].reason
        assert reason.startswith("joint_1 and joint_3 all measure joint_1")


@pytest.mark.parametrize(
    ("limit_rad", "unknown"),
    [(0.02, {*SHAPE_PROPERTIES}), (0.3, {"gear"}), (0.6, set[JointProperty]())],
)
def test_shapes_joint_with_small_travel_has_unknown_properties(
    limit_rad: float, unknown: set[JointProperty]
) -> None:
    robot, _ = make_robot(2, None)
    joints = list(robot.file_joints)
    limits = msgspec.structs.replace(joints[1].limits, angle_rad=limit_rad)
    joints[1] = dataclasses.replace(joints[1], limits=limits)
    poses = design_poses(joints)
    verdicts = judge_shapes(joints, poses, np.array([pose.angle_rad for pose in poses]))
    assert list_states(verdicts, "unknown") == ({1: unknown} if unknown else {})
    assert list_states(verdicts, "wrong") == {}


def test_shapes_robot_on_its_back_gets_placement_hint() -> None:
    robot, _ = make_robot(2, None)
    measured_rad = np.array([pose.angle_rad for pose in robot.poses])
    mirrored = judge_shapes(robot.file_joints, robot.poses, -measured_rad)
    assert "its head at the arrow" in find_placement_hint(mirrored)
    assert find_placement_hint(judge_shapes(robot.file_joints, robot.poses, measured_rad)) == ""


@pytest.mark.trials
@pytest.mark.parametrize("limit_rad", [0.5, 0.7])
def test_shapes_small_travel_confirms_no_fault_and_blames_no_other(
    limit_rad: float,
) -> None:
    for trial in range(max(TRIALS // 4, len(FAULTS))):
        robot, rng = make_robot(trial, FAULTS[trial % len(FAULTS)])
        file_joints = [shorten_travel(joint, limit_rad) for joint in robot.file_joints]
        robot = dataclasses.replace(
            robot,
            file_joints=file_joints,
            built_joints=[shorten_travel(joint, limit_rad) for joint in robot.built_joints],
            poses=design_poses(file_joints),
        )
        verdicts = judge_shapes(robot.file_joints, robot.poses, robot.measure_angles_rad(rng))
        blamed = list_states(verdicts, "wrong")
        assert set(blamed) <= set(robot.faults), f"trial {trial}: {verdicts}"
        assert not any(verdicts[joint].all_confirmed for joint in robot.faults), (
            f"trial {trial}: {verdicts}"
        )
        assert "order" not in {
            name for names in list_states(verdicts, "unknown").values() for name in names
        }


def shorten_travel(joint: Joint, limit_rad: float) -> Joint:
    """Return the joint with another angle limit."""
    return dataclasses.replace(
        joint, limits=msgspec.structs.replace(joint.limits, angle_rad=limit_rad)
    )
