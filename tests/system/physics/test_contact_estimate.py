"""Compares the contact estimate with the true contacts of the simulator, in runs that push off pegs.

True contacts on one side within 8 cm count as one push, because the estimate cannot distinguish them.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pytest

from snakesim_gnc.guidance.contacts.contact_estimate import EstimatedPush, estimate_pushes
from snakesim_hal.backend import Samples
from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.model.plugins import BACKENDS, register_plugin_temporarily
from snakesim_hal.model.scenario import KeyOverride, load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Imu, Pose, RobotDescription
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.state.truth import TrueState

SAME_PUSH_M = 0.08  # the estimate cannot distinguish contacts that are closer together
MIN_FORCE_N = 2.0  # weaker pushes are not counted
FIRST_TICK = 30  # the snake starts to push before it
TICKS_PER_SAMPLE = 2


@dataclass(frozen=True, order=True)
class Push:
    """A force on one side of the body."""

    position_m: float  # along the body, from the tail end
    side: int  # 1: left, -1: right
    force_n: float


@dataclass
class EstimateErrors:
    """The errors of the estimates in a run, for true pushes of at least MIN_FORCE_N."""

    # |estimated - true force| / true force; 1 if the estimate missed the push.
    force_error_ratios: list[float] = field(default_factory=list[float])
    position_errors_m: list[float] = field(default_factory=list[float])  # of the detected pushes
    false_detections: int = 0  # estimated pushes of at least MIN_FORCE_N without a true push

    @property
    def push_count(self) -> int:
        """The number of true pushes."""
        return len(self.force_error_ratios)

    @property
    def detected_count(self) -> int:
        """The number of true pushes that the estimate has detected."""
        return len(self.position_errors_m)

    def add_sample(self, true_pushes: list[Push], estimated_pushes: list[Push]) -> None:
        """Add the errors of the estimates of one tick."""
        unmatched = list(estimated_pushes)
        for true_push in true_pushes:
            matching = [push for push in unmatched if _is_same_push(push, true_push)]
            unmatched = [push for push in unmatched if push not in matching]
            if true_push.force_n < MIN_FORCE_N:
                continue
            force_n = sum(push.force_n for push in matching)
            self.force_error_ratios.append(abs(force_n - true_push.force_n) / true_push.force_n)
            if matching:
                moment_nm = sum(push.position_m * push.force_n for push in matching)
                self.position_errors_m.append(abs(moment_nm / force_n - true_push.position_m))
        self.false_detections += sum(push.force_n >= MIN_FORCE_N for push in unmatched)


def _is_same_push(push: Push, other: Push) -> bool:
    return push.side == other.side and abs(push.position_m - other.position_m) < SAME_PUSH_M


def measure_estimate_errors(
    scenario: str, *settings: str, with_pose: bool = True
) -> EstimateErrors:
    """Run a scenario and compare the contact estimate with the true contacts.

    Args:
        scenario: name of a shipped scenario.
        settings: KEY=VALUE to set a key, or -KEY to remove it.
        with_pose: whether the estimate may use the pose of the robot.
    """
    errors = EstimateErrors()
    robot, samples_and_pushes = run_and_record_pushes(scenario, *settings)
    no_imu = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])
    for samples, true_pushes in samples_and_pushes:
        imu = samples.by_key.get(keys.IMU, no_imu)
        pose = samples.by_key.get(keys.POSE)
        joints = samples.joints
        assert isinstance(imu, Imu)
        assert isinstance(pose, Pose | None)
        estimated = estimate_pushes(
            robot,
            joints.angle_rad,
            joints.velocity_rad_s,
            joints.torque_nm,
            imu,
            pose if with_pose else None,
        )
        errors.add_sample(true_pushes, convert_estimated_pushes(robot, estimated))
    return errors


@lru_cache(maxsize=1)
def run_and_record_pushes(
    scenario: str, *settings: str
) -> tuple[RobotDescription, list[tuple[Samples, list[Push]]]]:
    """Return the robot of a run, and its samples with the true pushes.

    The last run is cached, because two tests evaluate it in different ways.
    """
    overrides = (
        KeyOverride(text[1:], None, text) if text.startswith("-") else parse_set_option(text)
        for text in settings
    )
    config = load_scenario(scenario, [parse_set_option("duration_s=3"), *overrides]).config
    samples_and_pushes: list[tuple[Samples, list[Push]]] = []

    class PushRecordingBackend(SimBackend):
        """A simulator that records the true pushes of its samples."""

        def sample(self, tick: int, timestamp_ns: int) -> Samples:
            samples = super().sample(tick, timestamp_ns)
            if tick >= FIRST_TICK and tick % TICKS_PER_SAMPLE == 0:
                true_pushes = compute_true_pushes(self.describe(), self.true_state())
                samples_and_pushes.append((samples, true_pushes))
            return samples

    with (
        register_plugin_temporarily(BACKENDS, "sim", PushRecordingBackend),
        InProcessRun(config) as run,
    ):
        for _ in run.iterate_ticks():
            pass
        return run.host.description, samples_and_pushes


def convert_estimated_pushes(robot: RobotDescription, estimated: list[EstimatedPush]) -> list[Push]:
    """Convert pushes that are relative to links into positions along the body."""
    link_starts_m = np.append(0.0, np.cumsum([link.length_m for link in robot.links]))
    return [
        Push(
            float(link_starts_m[push.link] + push.distance_from_rear_joint_m),
            -int(np.sign(push.normal_l[1])),
            push.force_n,
        )
        for push in estimated
    ]


def compute_true_pushes(robot: RobotDescription, truth: TrueState) -> list[Push]:
    """Return the contacts of the simulator from tail to head; neighbors on one side are merged."""
    lengths_m = [link.length_m for link in robot.links]
    link_starts_m = np.append(0.0, np.cumsum(lengths_m))
    base_rotation = rotation_from_quaternion(truth.base_orientation_wxyz)
    axes = [joint.axis for joint in robot.joints]
    rear_w, frames = compute_link_frames(
        truth.base_position_w, base_rotation, truth.angles_rad, axes, lengths_m
    )
    pushes: list[Push] = []
    for contact in truth.contacts:
        position_l = frames[contact.link].T @ (contact.position_w - rear_w[contact.link])
        along_m, across_m = position_l[:2]
        pushes.append(
            Push(
                float(link_starts_m[contact.link] + along_m),
                1 if across_m > 0 else -1,
                float(np.linalg.norm(contact.force_w)),
            )
        )
    return merge_neighbors(pushes)


def merge_neighbors(pushes: list[Push]) -> list[Push]:
    """Merge pushes of one side that are close together into one push at their center of force."""
    merged: list[Push] = []
    for push in sorted(pushes):
        neighbors = [
            index
            for index, other in enumerate(merged)
            if other.side == push.side and push.position_m - other.position_m < SAME_PUSH_M
        ]
        if neighbors and push.force_n + merged[neighbors[-1]].force_n > 0:
            other = merged[neighbors[-1]]
            force_n = other.force_n + push.force_n
            moment_nm = other.position_m * other.force_n + push.position_m * push.force_n
            merged[neighbors[-1]] = Push(moment_nm / force_n, push.side, force_n)
        else:
            merged.append(push)
    return merged


@pytest.mark.heavy
@pytest.mark.parametrize("with_pose", [True, False])
@pytest.mark.parametrize("scenario", ["triplet", "peg_row"])
def test_contact_estimate_median_force_error_is_below_15_percent(
    scenario: str, with_pose: bool
) -> None:
    errors = measure_estimate_errors(scenario, with_pose=with_pose)
    assert errors.push_count > 100
    assert np.median(errors.force_error_ratios) < 0.15
    assert errors.detected_count > 0.95 * errors.push_count
    assert errors.false_detections < 0.1 * errors.push_count
    assert np.median(errors.position_errors_m) < 0.04


def measure_estimate_errors_from_joint_states_alone() -> EstimateErrors:
    """Return the errors of an estimate from joint states alone: without IMUs, contact sensors and a pose."""
    return measure_estimate_errors(
        "triplet", "-robot.sensors.imu", "-robot.sensors.contacts", with_pose=False
    )


@pytest.mark.slow
def test_contact_estimate_without_imus_detects_three_of_four_pushes() -> None:
    errors = measure_estimate_errors_from_joint_states_alone()
    assert errors.push_count > 100, "too few true pushes to judge the estimate"
    assert errors.detected_count > 0.75 * errors.push_count


@pytest.mark.slow
def test_contact_estimate_without_imus_has_bounded_median_errors() -> None:
    """A push that the estimate has missed has a force error of 100 %, and no position error."""
    errors = measure_estimate_errors_from_joint_states_alone()
    assert errors.push_count > 100, "too few true pushes for a median"
    assert np.median(errors.force_error_ratios) < 0.4
    assert np.median(errors.position_errors_m) < 0.05
