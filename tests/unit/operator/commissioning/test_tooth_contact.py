"""What the torque of a joint shows of the contact of its teeth, by gears whose torque is known in closed form."""

import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.joint_check.tooth_contact import (
    MIN_LOAD_NM,
    JointMotion,
    ToothContact,
    estimate_friction_nm,
    measure_tooth_contact,
    measure_unloaded_fraction,
)

STIFFNESS_NM_PER_RAD = 40.0  # of the body and the floor, typical of emulated joints
FLOOR_NM = 0.2  # torque at which the links slide
STEP_RAD = 0.0006  # of the small motion in a tick
LARGE_STEP_RAD = 0.003
SMALL_MOVE_RAD = 0.005
LARGE_MOVE_RAD = 0.06
BACKLASHES_RAD = (0.002, 0.006, 0.0105, 0.0175, 0.025, 0.045)
ROUNDING_NM = 1e-9
PLACES = (-1.0, -0.6, -0.2, 0.0, 0.3, 0.8, 1.0)  # of the link within the backlash, at the start


def make_motion(move_rad: float, step_rad: float, cycles: int) -> Floats:
    """Return the angles of a drive that moves to both sides, (n,)."""
    out = np.arange(0.0, move_rad, step_rad)
    to_one_side = np.concatenate((out, out[::-1]))
    return np.tile(np.concatenate((to_one_side, -to_one_side)), cycles)


def compute_torques(
    drive_rad: Floats, backlash_rad: float, friction_nm: float, place: float
) -> Floats:
    """Return the torque of a drive that moves a link on a floor through a gear, (n,).

    The floor holds the link like a spring up to the torque at which the link slides. A link that the teeth do not push
    rests where this spring is relaxed.

    Args:
        drive_rad: Angle of the drive.
        backlash_rad: Backlash of the gear, from end to end.
        friction_nm: Friction of the drive.
        place: Of the link within the backlash at the start, from -1 to 1.
    """
    relaxed_rad = place * backlash_rad / 2
    max_spring_rad = FLOOR_NM / STIFFNESS_NM_PER_RAD
    torques_nm: list[float] = []
    for angle_rad, speed in zip(drive_rad, np.gradient(drive_rad), strict=True):
        low_rad = angle_rad - backlash_rad / 2
        high_rad = angle_rad + backlash_rad / 2
        link_rad = min(max(relaxed_rad, low_rad), high_rad)
        relaxed_rad = min(max(relaxed_rad, link_rad - max_spring_rad), link_rad + max_spring_rad)
        load_nm = STIFFNESS_NM_PER_RAD * (link_rad - relaxed_rad)
        torques_nm.append(load_nm + friction_nm * float(np.sign(speed)))
    return np.array(torques_nm)


def measure(
    backlash_rad: float, friction_nm: float = 0.0, place: float = 0.0, noise_nm: float = 0.002
) -> ToothContact:
    """Measure the contact of a gear after the large motion and both cycles of the small one."""
    large_rad = make_motion(LARGE_MOVE_RAD, LARGE_STEP_RAD, 1)
    small_rad = make_motion(SMALL_MOVE_RAD, STEP_RAD, 2)
    all_rad = np.concatenate((large_rad, small_rad))
    torque_nm = compute_torques(all_rad, backlash_rad, friction_nm, place)
    torque_nm = torque_nm + np.random.default_rng(1).uniform(-0.5, 0.5, len(torque_nm)) * noise_nm

    def cut(start: int, stop: int) -> JointMotion:
        angle_rad = all_rad[start:stop]
        return JointMotion(
            angle_rad, angle_rad, torque_nm[start:stop], np.sign(np.gradient(angle_rad))
        )

    begin, end = len(large_rad), len(all_rad)
    return measure_tooth_contact(
        cut(begin, end),
        cut((begin + end) // 2, end),
        cut(0, begin),
        noise_nm=noise_nm,
        angle_step_rad=1e-4,
        window_ticks=5,
    )


@pytest.mark.parametrize("friction_nm", [0.0, 0.05])
def test_reversal_of_a_tight_gear_excludes_backlash_within_the_allowed_one(
    friction_nm: float,
) -> None:
    contact = measure(0.0, friction_nm)
    assert contact.reversal_rad is not None
    assert contact.reversal_rad < 0.01
    assert contact.unloaded_fraction < 0.1


@pytest.mark.parametrize("friction_nm", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("backlash_rad", BACKLASHES_RAD)
def test_bound_is_never_below_the_true_backlash(
    backlash_rad: float, place: float, friction_nm: float
) -> None:
    reversal_rad = measure(backlash_rad, friction_nm, place).reversal_rad
    assert reversal_rad is None or reversal_rad >= backlash_rad


def test_drive_with_more_friction_than_load_bounds_nothing() -> None:
    """Its torque changes its sign at each reversal, also without any load."""
    assert measure(0.0, friction_nm=0.5).reversal_rad is None
    assert measure(0.1, friction_nm=0.5).reversal_rad is None


def test_friction_is_never_estimated_too_low() -> None:
    angle_rad = make_motion(SMALL_MOVE_RAD, STEP_RAD, 2)
    for friction_nm in (0.0, 0.05, 0.3):
        torque_nm = compute_torques(angle_rad, 0.045, friction_nm, 0.0)
        motion = JointMotion(angle_rad, angle_rad, torque_nm, np.sign(np.gradient(angle_rad)))
        assert estimate_friction_nm(motion) == pytest.approx(friction_nm, abs=ROUNDING_NM)
        torque_nm = compute_torques(angle_rad, 0.0, friction_nm, 0.0)
        motion = JointMotion(angle_rad, angle_rad, torque_nm, np.sign(np.gradient(angle_rad)))
        assert estimate_friction_nm(motion) >= friction_nm - ROUNDING_NM


def test_friction_that_cannot_be_estimated_bounds_nothing() -> None:
    angle_rad = make_motion(SMALL_MOVE_RAD, STEP_RAD, 2)
    torque_nm = compute_torques(angle_rad, 0.0, 0.0, 0.0)
    unknown_direction = np.zeros(len(angle_rad))
    motion = JointMotion(angle_rad, angle_rad, torque_nm, unknown_direction)
    contact = measure_tooth_contact(
        motion, motion, motion, noise_nm=0.0, angle_step_rad=0.0, window_ticks=5
    )
    assert contact.reversal_rad is None
    assert contact.load_threshold_nm == float("inf")


@pytest.mark.parametrize("friction_nm", [0.0, 0.05])
@pytest.mark.parametrize("contact_rad", [-0.002, 0.0, 0.002])
def test_load_at_one_end_only_is_measured(contact_rad: float, friction_nm: float) -> None:
    """The drive meets the teeth at an angle within its small stroke, and leaves them at the other end."""
    angle_rad = make_motion(SMALL_MOVE_RAD, STEP_RAD, 1)
    load_nm = STIFFNESS_NM_PER_RAD * np.maximum(angle_rad - contact_rad, 0.0)
    direction = np.sign(np.gradient(angle_rad))
    motion = JointMotion(angle_rad, angle_rad, load_nm + friction_nm * direction, direction)
    fraction = measure_unloaded_fraction(motion, 0.01 + friction_nm)
    stroke_rad = float(np.ptp(angle_rad))
    assert fraction == pytest.approx((contact_rad - angle_rad.min()) / stroke_rad, abs=0.1)


@pytest.mark.parametrize("backlash_rad", [0.0175, 0.025, 0.045])
def test_travel_without_a_load_is_that_of_the_backlash(backlash_rad: float) -> None:
    """It is shortened by its error, and a load too small to be proven lengthens it at both ends."""
    travel_rad = measure(backlash_rad).unloaded_travel_rad
    weak_load_rad = 2 * (MIN_LOAD_NM + 0.002) / STIFFNESS_NM_PER_RAD
    shortest_rad = backlash_rad - 5 * LARGE_STEP_RAD
    assert shortest_rad <= travel_rad <= backlash_rad + weak_load_rad


def test_tight_gear_turns_no_long_way_without_a_load() -> None:
    assert measure(0.0).unloaded_travel_rad < 0.01
