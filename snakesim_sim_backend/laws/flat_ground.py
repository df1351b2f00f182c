"""Flat ground under the feet: normal forces and dry friction, computed here in every physics step.

MuJoCo solves normal forces and friction of all contacts in one relaxed problem. That is stable, but slip decays with a
time constant instead of being opposed by mu N, and loads that statics does not determine end up where the solver puts
them. A symmetric robot whose wave is mirrored then drifts to the same side twice, by centimeters per second. Here:

- Every foot stands on a spring. Its stiffness is proportional to the weight that the foot carries (half of each link
  that it ends). A body that lies straight therefore sinks in evenly, and every foot carries its share.
- A foot sticks to the ground by a tangential spring from the point where it stuck, which slips when it would pull
  harder than mu N. Slip is measured by how far the foot has moved since the last step. The velocities of the integrator
  belong to a moment half a step away, which would act like an extra force on a foot that moves along a curve.

The state of the law is in MuJoCo's `userdata`, so that a saved MuJoCo state is complete.

Source: P. A. Cundall and O. D. L. Strack, "A discrete numerical model for granular assemblies", Géotechnique 29, 1979.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.laws.chain import LinkChain
from snakesim_sim_backend.laws.directional import (
    BACKWARD,
    FORWARD,
    SEPARATE_LIMITS,
    SIDEWAYS,
    VISCOUS_ACROSS,
    VISCOUS_ALONG,
    DirectionalCoefficients,
    LinkUndersides,
    apply_directional_friction,
    apply_separate_limits,
    combine_coefficients,
)

SINK_M = 2e-4  # how deep a foot sinks in under its share of the weight
# The normal spring vibrates by at most this in one step; long steps get softer ground.
MAX_PHASE_RAD = 0.7
DAMPING_RATIO = 0.5  # of critical damping
VALUES_PER_FOOT = 5  # in `userdata`: two of its slip, three of its position
FOOT = 1.0  # first number of a geom's user data, if the geom is a foot that flat ground carries
UP = (0.0, 0.0, 1.0)  # normal of the ground
MIN_DIVISOR = 1e-12  # keeps 0 / 0 out of the friction of a foot without load


@dataclass(frozen=True)
class GroundFeet:
    """The feet of a model on flat ground: one at the tail end of each link, and one at the head."""

    geoms: NDArray[np.int64]  # (n_feet,), tail to head
    first_body: int  # MuJoCo's number of the tail link's body
    carried_kg: Floats  # (n_feet,), mass that each foot carries when the robot lies straight
    radius_m: float
    friction: float  # Coulomb coefficient, of sides and backs of links
    directions: list[list[float]]  # user data of each foot's geom, see `directional`

    @property
    def are_directional(self) -> bool:
        """Return whether the ground has viscous friction, or rubs otherwise than equally in all directions."""
        same = [self.friction] * 3 + [0.0] * 3
        return any(numbers[FORWARD:] != same for numbers in self.directions)


def find_feet(
    model: mujoco.MjModel, first_body: int, link_count: int, radius_m: float
) -> GroundFeet:
    """Return the feet of a compiled model, whose geoms are called `foot_0` onwards."""
    masses_kg = model.body_mass[first_body : first_body + link_count]
    geoms = np.array([model.geom(f"foot_{i}").id for i in range(link_count + 1)])
    carried_kg = 0.5 * (np.append(masses_kg, 0.0) + np.append(0.0, masses_kg))
    friction = float(model.geom_friction[geoms[0], 0])
    return GroundFeet(
        geoms, first_body, carried_kg, radius_m, friction, model.geom_user[geoms].tolist()
    )


class FlatGround:
    """The ground at height 0 of one simulation. Call `apply` between `mj_step1` and `mj_step2`.

    Equations of one foot, all in the world frame, with the height h of its center, its radius r, the time step dt, and
    m g, the weight that it carries:

        k = m g / sink                               stiffness of the normal and of the tangential spring, N/m
        d = 2 DAMPING_RATIO m sqrt(g / sink) / dt    damping, N per m of motion in one step
        N = max(0, k (r - h) - d dh)                 normal force; dh: rise since the last step
        ds = dx + dt r (-w_y, w_x)                   slip of the lowest point since the last step, from the motion dx of
                                                     the center and the angular velocity w of the link
        s  = (s + ds) min(1, mu N / (k |s + ds|))    stretch of the tangential spring, limited by friction
        F  = -(k s + d ds), limited to |F| <= mu N   friction force

    On ground on which links slide more easily in one direction, `directional` changes F.

    The z axis is normal to the ground, and g is the part of gravity along it. On a slope, gravity has a part g_xy along
    the ground. Each spring then begins with the stretch that holds its foot: s = g_xy sink / g.

    A call of NumPy costs more than what it computes for so few feet, and a physics step runs each millisecond or two.
    So `apply` makes few calls, on arrays and views that were allocated before. An array `..._xy` holds x and y of the
    first foot, then of the next: viewed as complex numbers, each foot has one number, whose absolute value is a length.

    Attributes:
        min_friction: Lowest coefficient that is used; above 0 only while a robot settles.
        normal_force_n: (n_feet,), normal force on each foot in the last step.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        chain: LinkChain,
        feet: GroundFeet,
        underside: LinkUndersides,
    ) -> None:
        """Prepare the law for a compiled model: compute stiffness and damping, and allocate all buffers.

        Args:
            model: Compiled model.
            data: State of the simulation.
            chain: Links on which the forces of the ground act.
            feet: Feet of the model.
            underside: Undersides of the links, for friction that depends on the direction.
        """
        count = len(feet.geoms)
        gravity = -float(model.opt.gravity[2])
        step_s = float(model.opt.timestep)
        min_time_constant_s = step_s / MAX_PHASE_RAD  # of the normal spring
        sink_m = max(SINK_M, gravity * (min_time_constant_s * min_time_constant_s))
        stiffness = feet.carried_kg * gravity / sink_m  # N/m
        # N per m in one step.
        damping = 2.0 * DAMPING_RATIO * feet.carried_kg * math.sqrt(gravity / sink_m) / step_s
        self._chain = chain
        self.min_friction = 0.0
        self.normal_force_n = np.zeros(count)

        # Parameters of the law.
        self._friction = feet.friction
        self._is_directional = feet.are_directional
        self._directions = feet.directions
        self._underside = underside
        self._step_s = step_s
        self._stiffness = stiffness
        self._minus_stiffness = -stiffness
        self._minus_damping = -damping
        self._minus_stiffness_xy = -stiffness.repeat(2)
        self._minus_damping_xy = -damping.repeat(2)
        self._gravity_along_ground = model.opt.gravity[:2]  # m/s², along x and y; a view
        self._start_stretch_per_gravity = sink_m / gravity  # s²
        # M for 1 rad/s.
        self._roll_per_rad_s_xy = np.tile([-feet.radius_m * step_s, feet.radius_m * step_s], count)
        self._radius_m = np.full(count, feet.radius_m)
        self._zeros = np.full(count, 0.0)
        self._min_divisor = np.full(count, MIN_DIVISOR)

        self._bind_mujoco_arrays(data, feet)
        self._allocate_buffers(count)

    def _bind_mujoco_arrays(self, data: mujoco.MjData, feet: GroundFeet) -> None:
        """Cache the views and flat indices of MuJoCo's arrays from which a step computes the friction of the feet.

        Args:
            data: State of the simulation, whose arrays are viewed, not copied.
            feet: The points at which the chain touches the ground.
        """
        first_body = feet.first_body
        count = len(feet.geoms)
        xy_count = 2 * count
        # Foot i belongs to link i; only the last foot belongs to the head link, too, which has two feet.
        link_count = count - 1
        head_body = first_body + link_count - 1
        bodies = np.minimum(np.arange(count) + first_body, head_body)
        self._bodies: list[int] = bodies.tolist()
        # Second link of each foot, and its weight. A foot at a joint belongs half to the link behind the joint. A foot
        # at an end of the body belongs to one link only, so that its second link has no weight.
        self._neighbors = [
            (first_body, 0.0),
            *((body - 1, 0.5) for body in self._bodies[1:-1]),
            (self._bodies[-1], 0.0),
        ]
        xy_indices = np.add.outer(3 * feet.geoms, [0, 1]).ravel()
        z_indices = 3 * feet.geoms + 2
        self._positions = data.geom_xpos.reshape(-1)
        self._position_indices = np.concatenate((xy_indices, z_indices))
        # Per body: angular velocity (x, y, z), then linear velocity.
        self._body_cvel = data.cvel.reshape(-1)
        # The velocity of a point, v = omega x r, has the x component omega_y r_z and the y component -omega_x r_z: so y
        # comes first.
        self._angular_yx_indices = np.add.outer(6 * bodies, [1, 0]).ravel()
        # Reference point of `cvel`: center of mass of the whole chain.
        self._cvel_reference_xy = data.subtree_com[first_body, :2, None]
        self._cvel_reference_z = data.subtree_com[first_body, 2:]
        # In `userdata`: deflection of the friction bristle of every foot (x, y), then the last positions of all feet.
        # As complex numbers, the absolute values of the deflections are computed at once.
        self._bristle_deflection_xy = data.userdata[:xy_count]
        self._bristle_deflection_by_axis = self._bristle_deflection_xy.reshape(count, 2).T
        self._bristle_deflection_complex = self._bristle_deflection_xy.view(np.complex128)
        self._last_position = data.userdata[xy_count : VALUES_PER_FOOT * count]

    def _allocate_buffers(self, count: int) -> None:
        """Allocate the arrays that every step reuses.

        Positions and motions have x and y of all feet, then z of all feet.

        Args:
            count: Number of feet.
        """
        xy_count = 2 * count
        self._position = np.empty(3 * count)
        self._height = self._position[xy_count:]
        self._position_by_axis = self._position[:xy_count].reshape(count, 2).T
        self._motion = np.empty(3 * count)
        self._motion_xy = self._motion[:xy_count]
        self._rise = self._motion[xy_count:]
        self._slip_xy = np.empty(xy_count)
        self._pull_xy = np.empty(xy_count)
        self._pull = self._pull_xy.view(np.complex128)
        self._pull_by_axis = self._pull_xy.reshape(count, 2).T
        # The cyclic order x, y, z, x, y makes each cross product two multiplications of whole blocks of rows.
        self._arms = np.empty((5, count))
        rows = np.zeros((8, count))
        self._moments = rows[:3]
        self._forces = rows[3:]
        self._wrenches = rows[:6]

    def begin(self) -> None:
        """Let all feet stick where they are now. On a slope, their bristles hold the weight along it."""
        start_deflection = self._gravity_along_ground * self._start_stretch_per_gravity
        self._bristle_deflection_by_axis[:] = start_deflection[:, None]
        self._last_position[:] = self._positions[self._position_indices]

    def apply(self) -> None:
        """Add the forces on the feet where they are now to MuJoCo's passive forces, which it computes in each step."""
        height = self._height
        slip_xy = self._slip_xy

        # dx and dh: motion of the feet since the last step.
        self._positions.take(self._position_indices, None, self._position, "clip")
        np.subtract(self._position, self._last_position, self._motion)
        self._last_position[:] = self._position

        # ds = dx + dt r (-w_y, w_x)
        self._body_cvel.take(self._angular_yx_indices, None, slip_xy, "clip")
        slip_xy *= self._roll_per_rad_s_xy
        slip_xy += self._motion_xy

        # N = max(0, k (r - h) - d dh), computed in the memory of dh.
        height -= self._radius_m
        normal_force_n = self._rise
        normal_force_n *= self._minus_damping
        normal_force_n += self._minus_stiffness * height
        self.normal_force_n = np.maximum(normal_force_n, self._zeros)
        coefficients: list[DirectionalCoefficients] = []
        slips: list[list[float]] = []
        if self._is_directional:
            coefficients = [self._find_coefficients(foot) for foot in range(len(self._bodies))]
            slips = slip_xy.reshape(-1, 2).tolist()
            max_friction_n = np.array([each.largest for each in coefficients]) * self.normal_force_n
        else:
            max_friction_n = max(self._friction, self.min_friction) * self.normal_force_n
        divisor = np.maximum(max_friction_n, self._min_divisor)

        # s = (s + ds) min(1, mu N / (k |s + ds|))
        self._bristle_deflection_xy += slip_xy
        stretches: list[list[float]] = []
        if self._is_directional:
            stretches = self._bristle_deflection_xy.reshape(-1, 2).tolist()
        self._bristle_deflection_xy *= (
            max_friction_n
            / np.maximum(self._stiffness * np.abs(self._bristle_deflection_complex), divisor)
        ).repeat(2)

        # F = -(k s + d ds), limited to mu N
        np.multiply(self._minus_stiffness_xy, self._bristle_deflection_xy, self._pull_xy)
        slip_xy *= self._minus_damping_xy
        self._pull_xy += slip_xy
        forces = self._forces
        np.multiply(
            self._pull_by_axis, max_friction_n / np.maximum(np.abs(self._pull), divisor), forces[:2]
        )
        if self._is_directional:
            self._apply_directional_friction(coefficients, slips, stretches)
        forces[2] = self.normal_force_n
        forces[3:] = forces[:2]
        self._add_link_wrenches()

    def _find_coefficients(self, foot: int) -> DirectionalCoefficients:
        """Return the coefficients of a foot, by how its links lie on the ground now."""
        numbers = self._directions[foot]
        viscous_across = numbers[VISCOUS_ACROSS]
        neighbor, weight = self._neighbors[foot]
        if not self._underside.faces(self._bodies[foot], neighbor, weight, UP):
            side = self._friction
            return combine_coefficients(
                side, side, side, viscous_across, viscous_across, self.min_friction
            )
        return combine_coefficients(
            numbers[FORWARD],
            numbers[BACKWARD],
            numbers[SIDEWAYS],
            numbers[VISCOUS_ALONG],
            viscous_across,
            self.min_friction,
            numbers[SEPARATE_LIMITS],
        )

    def _apply_directional_friction(
        self,
        coefficients: list[DirectionalCoefficients],
        slips: list[list[float]],
        stretches: list[list[float]],
    ) -> None:
        """Change the friction forces of the feet by the direction in which they slide.

        Args:
            coefficients: Coefficients of each foot.
            slips: Slip of each foot since the last step, x and y.
            stretches: Stretch of the spring of each foot before it is limited, x and y.
        """
        for foot, of_foot in enumerate(coefficients):
            if of_foot.is_directional:
                neighbor, weight = self._neighbors[foot]
                axis_w = self._underside.find_axis(self._bodies[foot], neighbor, weight, UP)
                force_x, force_y = self._forces[:2, foot].tolist()
                slip_x, slip_y = slips[foot]
                damping_per_viscous = float(self.normal_force_n[foot]) / self._step_s
                if of_foot.separate_limits:
                    stretch_x, stretch_y = stretches[foot]
                    (stretch_x, stretch_y, _), (force_x, force_y, _) = apply_separate_limits(
                        (stretch_x, stretch_y, 0.0),
                        (slip_x, slip_y, 0.0),
                        axis_w,
                        of_foot,
                        of_foot.largest * float(self.normal_force_n[foot]),
                        float(self._stiffness[foot]),
                        float(-self._minus_damping[foot]),
                        damping_per_viscous,
                    )
                    self._bristle_deflection_by_axis[:, foot] = stretch_x, stretch_y
                    self._forces[:2, foot] = force_x, force_y
                    continue
                force_x, force_y, _ = apply_directional_friction(
                    (force_x, force_y, 0.0),
                    (slip_x, slip_y, 0.0),
                    axis_w,
                    of_foot,
                    damping_per_viscous,
                )
                self._forces[:2, foot] = force_x, force_y

    def _add_link_wrenches(self) -> None:
        """Add the forces, and their moments about MuJoCo's reference point, to the links of the chain."""
        arms = self._arms
        moments = self._moments
        # `_height` is the height of each foot's lowest point by now, where the force acts.
        np.subtract(self._position_by_axis, self._cvel_reference_xy, arms[:2])
        np.subtract(self._height, self._cvel_reference_z, arms[2])
        arms[3:] = arms[:2]
        # moment = arm x force
        np.multiply(arms[1:4], self._forces[2:], moments)
        moments -= arms[2:] * self._forces[1:4]
        self._wrenches[:, -2] += self._wrenches[:, -1]  # both feet of the head's link
        self._chain.add_link_wrenches(self._wrenches[:, :-1])
