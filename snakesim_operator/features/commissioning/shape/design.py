"""Chooses the joint angles of the drawn shapes, so that each joint can be identified by its angles. Pure.

The angles of a joint in all shapes, divided by its largest angle, are its code. Codes are chosen so that:

    both signs    a code has a 1 and a -1: the joint bends to both sides, which decides sign, gear and zero
    separation    no code is a multiple of another plus a constant, within the placement tolerance of a person. So a
                  joint is identified by its readings whatever its sign, gear and zero really are
    bounded       the directions of all links differ little, so that no shape crosses itself

Joints that yaw and joints that pitch are bent in different shapes. In the shapes of the other axis they are straight,
because the robot lies flat on the paper.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import Axis
from snakesim_operator.features.commissioning.tolerances import MAX_RATIO_ERROR

# 2.9 degrees: how far a joint of a well placed robot is from its drawn angle, at most.
PLACEMENT_TOLERANCE_RAD = 0.05
# 46 degrees; larger angles decide better, and bend more than many robots like.
MAX_SHAPE_ANGLE_RAD = 0.8
LIMIT_FRACTION = 0.9  # of a joint's travel that a shape uses
MIN_SHAPES = 2
CODE_LEVELS = (5, 7)  # numbers of different angles in a code, from -1 to 1
SEPARATION_MARGIN = 1.2  # smallest separation of two codes, in placement tolerances
# A joint whose largest angle is smaller is not confirmed anyway: its gear would not be known to `MAX_RATIO_ERROR`.
SMALLEST_DECIDING_ANGLE_RAD = PLACEMENT_TOLERANCE_RAD / MAX_RATIO_ERROR
# By which a code may be a multiple of another.
SCALES = np.concatenate((np.linspace(-4.0, 4.0, 161), (1e3, -1e3)))


@dataclass(frozen=True)
class ShapePose:
    """A pose into which a person brings the robot."""

    name: str  # "straight", or the letter of the shape
    axis: Axis | None  # of the joints that are bent; None: no joint is
    angle_rad: Floats  # (n_joints,), tail to head


def design_poses(joints: Sequence[Joint]) -> list[ShapePose]:
    """Return the poses of the check: the straight one, then the shapes of each axis.

    Args:
        joints: Joints of the robot file, tail to head. Their limits bound the angles.
    """
    poses = [ShapePose("straight", None, np.zeros(len(joints)))]
    axes: tuple[Axis, ...] = ("yaw", "pitch")
    for axis in axes:
        group = [i for i, joint in enumerate(joints) if joint.axis == axis]
        if not group:
            continue
        largest_rad = np.array([compute_largest_angle_rad(joints[i]) for i in group])
        for code in _arrange_codes(
            choose_codes(len(group), float(largest_rad.min())), largest_rad
        ).T:
            angle_rad = np.zeros(len(joints))
            angle_rad[group] = code * largest_rad + 0.0  # no -0.0
            poses.append(ShapePose(chr(ord("A") + len(poses) - 1), axis, angle_rad))
    return poses


def compute_largest_angle_rad(joint: Joint) -> float:
    """Return how far a shape bends a joint to either side; 0 for a joint that bends to one side only."""
    travel_rad = min(-joint.limits.lower_rad, joint.limits.upper_rad)
    return max(min(MAX_SHAPE_ANGLE_RAD, LIMIT_FRACTION * travel_rad), 0.0)


def choose_codes(joint_count: int, smallest_rad: float = MAX_SHAPE_ANGLE_RAD) -> Floats:
    """Choose codes that are separated as far as necessary, for the fewest shapes, (joint_count, n_shapes).

    Args:
        joint_count: Number of joints that need a code.
        smallest_rad: Smallest of their largest angles. Joints that bend little need codes that differ more.
    """
    smallest_rad = max(smallest_rad, SMALLEST_DECIDING_ANGLE_RAD)
    min_separation = SEPARATION_MARGIN * PLACEMENT_TOLERANCE_RAD / smallest_rad
    for shape_count in itertools.count(MIN_SHAPES):
        for level_count in CODE_LEVELS:
            codes = _list_codes(shape_count, level_count)
            if len(codes) < joint_count:
                continue
            chosen = _choose_separated(codes, joint_count, min_separation)
            if chosen is not None:
                return chosen
    raise AssertionError("more shapes always have room for more codes")


def compute_separations(code: Floats, codes: Floats) -> Floats:
    """Return how far codes are from being a multiple of another code plus a constant, (n_codes,), in largest angles.

    A person may place both joints wrongly by the separation before one can be taken for the other. The straight pose,
    in which all angles are 0, belongs to every code.

    Args:
        code: The code, (n_shapes,).
        codes: Codes that are compared with it, (n_codes, n_shapes).
    """
    with_straight = np.concatenate(([0.0], code))
    all_with_straight = np.column_stack((np.zeros(len(codes)), codes))
    # (n_scales, n_codes, n_poses).
    differences = SCALES[:, None, None] * with_straight - all_with_straight
    needed_errors = np.ptp(differences, axis=2) / 2 / (1 + np.abs(SCALES[:, None]))
    return needed_errors.min(axis=0)


def _list_codes(shape_count: int, level_count: int) -> Floats:
    """Return all codes with both signs, each once: a code and its mirror image are the same."""
    levels = np.linspace(-1.0, 1.0, level_count)
    every_code = np.array(list(itertools.product(levels, repeat=shape_count)))
    has_both_signs = (every_code.max(axis=1) == 1.0) & (every_code.min(axis=1) == -1.0)
    codes = every_code[has_both_signs]
    return codes[: (len(codes) + 1) // 2]  # the second half are the mirror images, in reverse order


def _choose_separated(codes: Floats, count: int, min_separation: float) -> Floats | None:
    """Choose codes one after another, each as far as possible from those before; None if they come too close."""
    chosen = [0]
    separations = _compute_mutual_separations(codes, 0)
    while len(chosen) < count:
        next_code = int(np.argmax(separations))
        if separations[next_code] < min_separation:
            return None
        chosen.append(next_code)
        separations = np.minimum(separations, _compute_mutual_separations(codes, next_code))
    return codes[chosen]


def _compute_mutual_separations(codes: Floats, index: int) -> Floats:
    """Return the separation of every code from one of them, whichever of the two is taken for the other."""
    from_code = compute_separations(codes[index], codes)
    to_code = np.array([compute_separations(code, codes[index : index + 1])[0] for code in codes])
    separations = np.minimum(from_code, to_code)
    separations[index] = 0.0
    return separations


def _arrange_codes(codes: Floats, largest_rad: Floats) -> Floats:
    """Assign codes to joints, each as it is or mirrored, so that no link turns far away from the first one.

    Args:
        codes: One code for each joint, in any order, (n_joints, n_shapes).
        largest_rad: Largest angle of each joint, (n_joints,).

    Returns:
        The code of each joint, tail to head, (n_joints, n_shapes).
    """
    remaining = list(codes)
    heading_rad = np.zeros(codes.shape[1])  # of the link ahead of the joint, in each shape
    arranged: list[Floats] = []
    for joint_rad in largest_rad:
        options = [(index, mirror) for index in range(len(remaining)) for mirror in (1.0, -1.0)]
        headings_rad = [
            heading_rad + mirror * joint_rad * remaining[index] for index, mirror in options
        ]
        best = min(range(len(options)), key=lambda option: float(np.sum(headings_rad[option] ** 4)))
        index, mirror = options[best]
        heading_rad = headings_rad[best]
        arranged.append(mirror * remaining.pop(index))
    return np.array(arranged)
