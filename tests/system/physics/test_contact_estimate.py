"""The contact estimate against the simulator's truth, on runs that push off pegs.

True contacts of one side within 8 cm are one push, because the estimate cannot tell them apart.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

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

NEAR_M, MIN_FORCE_N = 0.08, 2.0
FROM_TICK, EVERY = 30, 2
Push = tuple[float, int, float]  # place along the body in m, side (1: left), force in N


@dataclass
class Score:
    """Errors over a run, for true pushes of at least MIN_FORCE_N."""

    # Error / true force; 1 where nothing was found.
    share: list[float] = field(default_factory=list[float])
    place_m: list[float] = field(default_factory=list[float])  # of those found
    ghosts: int = 0  # found, at least MIN_FORCE_N, and nothing there

    def add(self, true: list[Push], felt: list[Push]) -> None:
        """One tick."""
        left = list(felt)
        for place, side, force in true:
            mine = [push for push in left if push[1] == side and abs(push[0] - place) < NEAR_M]
            left = [push for push in left if push not in mine]
            if force < MIN_FORCE_N:
                continue
            found = sum(push[2] for push in mine)
            self.share.append(abs(found - force) / force)
            if mine:
                self.place_m.append(abs(sum(push[0] * push[2] for push in mine) / found - place))
        self.ghosts += sum(push[2] >= MIN_FORCE_N for push in left)


def score(scenario: str, *settings: str, with_pose: bool = True) -> Score:
    """Of the estimates in a run of a scenario. settings: KEY=VALUE, or -KEY to leave it out."""
    result, (robot, seen) = Score(), watched(scenario, *settings)
    nothing = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])
    for samples, true in seen:
        imu, pose, reported = (
            samples.by_key.get(keys.IMU, nothing),
            samples.by_key.get(keys.POSE),
            samples.joints,
        )
        assert isinstance(imu, Imu)
        assert isinstance(pose, Pose | None)
        felt = estimate_pushes(
            robot,
            reported.angle_rad,
            reported.velocity_rad_s,
            reported.torque_nm,
            imu,
            pose if with_pose else None,
        )
        result.add(true, pushes(robot, felt))
    return result


@lru_cache(maxsize=1)
def watched(
    scenario: str, *settings: str
) -> tuple[RobotDescription, list[tuple[Samples, list[Push]]]]:
    """A run's robot, and its samples with what was true; the last run is kept, to be judged in another way."""
    sets = (
        KeyOverride(text[1:], None, text) if text.startswith("-") else parse_set_option(text)
        for text in settings
    )
    config = load_scenario(scenario, [parse_set_option("duration_s=3"), *sets]).config
    seen: list[tuple[Samples, list[Push]]] = []

    class Watched(SimBackend):
        """The backend, with a look at what is true."""

        def sample(self, tick: int, timestamp_ns: int) -> Samples:
            samples = super().sample(tick, timestamp_ns)
            if tick >= FROM_TICK and tick % EVERY == 0:
                seen.append((samples, true_pushes(self.describe(), self.true_state())))
            return samples

    with register_plugin_temporarily(BACKENDS, "sim", Watched), InProcessRun(config) as run:
        for _ in run.iterate_ticks():
            pass
        return run.host.description, seen


def pushes(robot: RobotDescription, felt: list[EstimatedPush]) -> list[Push]:
    """Where along the body."""
    starts = np.append(0.0, np.cumsum([link.length_m for link in robot.links]))
    return [
        (starts[c.link] + c.distance_from_rear_joint_m, -int(np.sign(c.normal_l[1])), c.force_n)
        for c in felt
    ]


def true_pushes(robot: RobotDescription, truth: TrueState) -> list[Push]:
    """The simulator's contacts, tail to head."""
    lengths = [link.length_m for link in robot.links]
    starts = np.append(0.0, np.cumsum(lengths))
    base = rotation_from_quaternion(truth.base_orientation_wxyz)
    axes = [joint.axis for joint in robot.joints]
    rear_w, frames = compute_link_frames(
        truth.base_position_w, base, truth.angles_rad, axes, lengths
    )
    found: list[Push] = []
    for contact in truth.contacts:
        force_n = float(np.linalg.norm(contact.force_w))
        along, across = (frames[contact.link].T @ (contact.position_w - rear_w[contact.link]))[:2]
        found.append((float(starts[contact.link] + along), 1 if across > 0 else -1, force_n))
    return together(found)


def together(found: list[Push]) -> list[Push]:
    """Neighbors on one side are added up."""
    merged: list[Any] = []
    for place, side, force in sorted(found):
        same = [push for push in merged if push[1] == side and place - push[0] < NEAR_M]
        if same and force + same[-1][2] > 0:
            total = same[-1][2] + force
            same[-1][0], same[-1][2] = (same[-1][0] * same[-1][2] + place * force) / total, total
        else:
            merged.append([place, side, force])
    return [(place, side, force) for place, side, force in merged]


@pytest.mark.parametrize("with_pose", [True, False])
@pytest.mark.parametrize("scenario", ["triplet", "peg_row"])
def test_the_median_error_of_a_push_is_below_15_percent(scenario: str, with_pose: bool) -> None:
    found = score(scenario, with_pose=with_pose)
    assert len(found.share) > 100
    assert np.median(found.share) < 0.15
    assert len(found.place_m) > 0.95 * len(found.share)  # so few are missed
    assert found.ghosts < 0.1 * len(found.share)
    assert np.median(found.place_m) < 0.04


@pytest.mark.slow
def test_without_imus_three_of_four_pushes_are_still_found() -> None:
    found = score("triplet", "-robot.sensors.imu", "-robot.sensors.contacts", with_pose=False)
    assert len(found.place_m) > 0.75 * len(found.share) > 75
    assert np.median(found.share) < 0.4
    assert np.median(found.place_m) < 0.05
