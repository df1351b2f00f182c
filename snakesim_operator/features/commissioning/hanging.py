"""The torques that the links of a robot need which hangs by its tail: for their inertia and their weight.

Newton's and Euler's equations from link to link (Luh, Walker and Paul, 1980), for all instants at once. The tail link
is clamped, and its x axis points down; so how it is turned about x does not matter.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.links import Link
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.solids import GRAVITY_M_S2

AXES = {"yaw": (0.0, 0.0, 1.0), "pitch": (0.0, 1.0, 0.0)}


def links_of(robot: RobotFile) -> Sequence[Link]:
    """Every link, tail to head, also of a robot whose file lists none."""
    if robot.links:
        return robot.links
    pairs = zip(robot.link_lengths_m, robot.link_masses_kg, strict=True)
    return [Link(length_m=length, mass_kg=mass) for length, mass in pairs]


def load_nm(robot: RobotFile, angle_rad: Floats, velocity_rad_s: Floats, acceleration_rad_s2: Floats) -> Floats:
    """The torque through every joint, (n, joints), from its angles and their derivatives; rotors not included."""
    links, count = links_of(robot), len(angle_rad)
    turn, spin = np.zeros((count, 3)), np.zeros((count, 3))  # of a link, in its own frame
    rise = np.tile([-GRAVITY_M_S2, 0.0, 0.0], (count, 1))  # of its rear joint; weight as an acceleration upwards
    states: list[tuple[Floats, Floats, Floats]] = []
    rotations: list[Floats] = []
    for i, axis_name in enumerate(robot.axes):
        axis = np.array(AXES[axis_name])
        rear = np.array([links[i].length_m, 0.0, 0.0])
        rise = rise + np.cross(spin, rear) + np.cross(turn, np.cross(turn, rear))
        rotations.append(rotations_about(axis, angle_rad[:, i]))  # from this link's frame to that of the one before
        turn, spin, rise = (np.einsum("nji,nj->ni", rotations[-1], v) for v in (turn, spin, rise))
        rate = velocity_rad_s[:, i, None] * axis
        spin = spin + np.cross(turn, rate) + acceleration_rad_s2[:, i, None] * axis
        turn = turn + rate
        states.append((turn, spin, rise))
    torque = np.zeros_like(angle_rad)
    force, moment = np.zeros((count, 3)), np.zeros((count, 3))  # of the next link on this one, at the next joint
    for i in reversed(range(len(states))):
        link, (turn, spin, rise) = links[i + 1], states[i]
        center, ahead = np.array(link.center), np.array([link.length_m, 0.0, 0.0])
        xx, yy, zz, xy, xz, yz = link.inertia(robot.module.radius_m)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        push = link.mass_kg * (rise + np.cross(spin, center) + np.cross(turn, np.cross(turn, center)))
        own = spin @ inertia + np.cross(turn, turn @ inertia)
        moment = own + np.cross(center, push) + moment + np.cross(ahead, force)
        force = push + force
        torque[:, i] = moment @ np.array(AXES[robot.axes[i]])
        force, moment = (np.einsum("nij,nj->ni", rotations[i], v) for v in (force, moment))
    return torque


def rotations_about(axis: Floats, angle_rad: Floats) -> Floats:
    """Return the rotations by angles about a unit axis, (n, 3, 3)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, cos = np.sin(angle_rad)[:, None, None], np.cos(angle_rad)[:, None, None]
    return np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)
