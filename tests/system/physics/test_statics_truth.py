"""Compares the statics of a triplet with MuJoCo: the forces on three pegs and a tether at the solved torque.

A snake lies between three pegs without friction. A tether holds the link at the first peg along the tangent there.
One joint slowly raises its torque to the solved one, and the test waits until nothing moves. The joints are stiff and
have no torque limit, or they are those of the shipped robot. Pegs touch the straight side of a link, away from joints.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from snakesim_gnc.control.obstacle_triplet import (
    TripletSolution,
    compute_bending_torque_nm,
    solve_triplet,
)
from snakesim_gnc.control.obstacle_triplet.statics import add_tether_force
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.route import Route, place_chain_on_route, sample_sine_curve
from snakesim_hal.model.robot_file.joints import JointMotor, MotionLimits
from snakesim_hal.model.scenario import RunConfig, StartPlacement
from snakesim_hal.model.scene_file.scene import Cylinder, Ground, SceneFile, WaypointRoute
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings, TetherSettings
from snakesim_testing.runs.whole_run import load_run_config

PROPULSION_N = 35.0
PEG_RADIUS_M = 0.05
RISE_S = 0.5
HOLD_S = 2.5
TICKS_PER_S = 100
AVERAGED_TICKS = 20  # the forces are means over the last ticks
TRIPLETS = 10
QUICK_TRIPLETS = 4  # the others are slow tests
MIN_JOINT_DISTANCE_M = 0.015  # between a peg and the ends of its link
MIN_HEAD_DISTANCE_M = 0.03


@dataclass(frozen=True)
class Triplet:
    """A snake between three pegs that touch it, and the solution for it."""

    config: RunConfig
    tether: TetherSettings
    joint: int  # has the solved torque
    solution: TripletSolution
    loads_nm: Floats  # of every joint, for the solved forces


@dataclass(frozen=True)
class SnakeOnRoute:
    """The geometry of a snake that lies on a route."""

    link_lengths_m: Floats  # (links,)
    node_positions_m: Floats  # (nodes,) along the body: tail end, joints, head end
    nodes_w: Floats  # (nodes, 2)
    directions_w: Floats  # (links, 2), unit vectors towards the head


@dataclass(frozen=True)
class PegContact:
    """The contact of a peg with the straight side of a link."""

    link: int
    position_m: float  # along the body
    point_w: Floats
    normal_w: Floats  # from the peg to the link
    tangent_w: Floats  # towards the head


def make_triplet(seed: int) -> Triplet | None:
    """Place random pegs on a random wave; return None if they are no feasible triplet."""
    random = np.random.default_rng(seed)
    wavelength_m = random.uniform(0.5, 1.0)
    slope_rad = np.radians(random.uniform(12, 27))
    amplitude_m = np.tan(slope_rad) * wavelength_m / (2 * np.pi)
    route_points_w = sample_sine_curve(amplitude_m, wavelength_m, 4.0, 0.002)
    route = Route(route_points_w)
    inflections_s_m = route.find_inflections_s_m()
    tail_s_m = inflections_s_m[int(random.integers(0, 2))] - random.uniform(0.1, 0.25)
    robot = load_run_config("triplet").robot
    snake = place_snake(route, tail_s_m, robot.link_lengths_m)

    first = next(index for index, s_m in enumerate(inflections_s_m) if s_m > tail_s_m)
    contacts: list[PegContact] = []
    for inflection_s_m in inflections_s_m[first : first + 3]:
        offset_m = random.uniform(-0.03, 0.03) * wavelength_m
        desired_w = route.compute_positions_w(inflection_s_m) + offset_m * np.array([1, 0])
        contact = find_peg_contact(snake, desired_w)
        if contact is None:
            return None
        contacts.append(contact)

    node_positions_m = snake.node_positions_m
    joint = int(np.searchsorted(node_positions_m[1:-1], contacts[1].position_m))
    if node_positions_m[joint + 1] >= contacts[2].position_m:
        return None
    points_w = [contact.point_w for contact in contacts]
    normals_w = [contact.normal_w for contact in contacts]
    positions_m = [contact.position_m for contact in contacts]
    first_tangent_w = contacts[0].tangent_w
    solution = solve_triplet(
        points_w, normals_w, first_tangent_w, PROPULSION_N, snake.nodes_w[joint + 1]
    )
    if not solution.is_feasible or solution.forces_n.min() < 0.05 * PROPULSION_N:
        return None
    peg_distance_m = robot.module.radius_m + PEG_RADIUS_M
    pegs = [
        Cylinder(position_m=(float(x), float(y)), radius_m=PEG_RADIUS_M, friction=0.0)
        for x, y in np.array(points_w) - peg_distance_m * np.array(normals_w)
    ]
    forces_w = add_tether_force(solution.forces_n, normals_w, -PROPULSION_N * first_tangent_w)
    first_link = contacts[0].link
    return Triplet(
        config=make_stiff_config(route_points_w, pegs, tail_s_m),
        tether=TetherSettings(
            link=first_link,
            point_m=float(positions_m[0] - node_positions_m[first_link]),
            direction_w=(-float(first_tangent_w[0]), -float(first_tangent_w[1])),
        ),
        joint=joint,
        solution=solution,
        loads_nm=compute_bending_torque_nm(
            snake.nodes_w[1:-1], node_positions_m[1:-1], points_w, positions_m, forces_w
        ),
    )


def place_snake(route: Route, tail_s_m: float, link_lengths_m: Sequence[float]) -> SnakeOnRoute:
    """Lay a snake on a route with its tail end at `tail_s_m`."""
    lengths_m = np.array(link_lengths_m)
    placement = place_chain_on_route(route, tail_s_m, lengths_m.tolist())
    headings_rad = placement.heading_rad + np.concatenate(([0.0], np.cumsum(placement.angles_rad)))
    directions_w = np.column_stack([np.cos(headings_rad), np.sin(headings_rad)])
    from_tail_w = np.concatenate(
        ([[0.0, 0.0]], np.cumsum(lengths_m[:, None] * directions_w, axis=0))
    )
    return SnakeOnRoute(
        link_lengths_m=lengths_m,
        node_positions_m=np.concatenate(([0.0], np.cumsum(lengths_m))),
        nodes_w=np.array(placement.tail_w) + from_tail_w,
        directions_w=directions_w,
    )


def find_peg_contact(snake: SnakeOnRoute, desired_w: Floats) -> PegContact | None:
    """Find the contact on the link next to this point; return None if it is too near to a joint or to the head."""
    centers_x_m = snake.nodes_w[:-1, 0] + snake.directions_w[:, 0] * snake.link_lengths_m / 2
    link = int(np.argmin(np.abs(centers_x_m - desired_w[0])))
    tangent_w = snake.directions_w[link]
    on_link_m = float((desired_w - snake.nodes_w[link]) @ tangent_w)
    if not MIN_JOINT_DISTANCE_M < on_link_m < snake.link_lengths_m[link] - MIN_JOINT_DISTANCE_M:
        return None
    position_m = snake.node_positions_m[link] + on_link_m
    if position_m > snake.node_positions_m[-1] - MIN_HEAD_DISTANCE_M:
        return None
    left_w = np.array([-tangent_w[1], tangent_w[0]])
    return PegContact(
        link=link,
        position_m=position_m,
        point_w=snake.nodes_w[link] + on_link_m * tangent_w,
        normal_w=left_w if left_w[0] > 0 else -left_w,
        tangent_w=tangent_w,
    )


def make_stiff_config(
    route_points_w: np.ndarray, pegs: list[Cylinder], tail_s_m: float
) -> RunConfig:
    """Make a run of a robot with stiff joints of practically unlimited torque, on ground without friction."""
    base = load_run_config("triplet")
    motor = JointMotor(
        stiffness_nm_per_rad=4000,
        damping_nm_s_per_rad=40,
        velocity_gain_nm_s_per_rad=40,
        response_time_s=0,  # so stiff a servo would oscillate with a lag
        armature_kg_m2=0.01,
        viscous_nm_s_per_rad=0.02,
    )
    limits = MotionLimits(
        angle_rad=1.5,
        speed_rad_s=100,
        acceleration_rad_s2=1e4,
        torque_nm=1000,
        torque_rate_nm_s=1e5,
    )
    waypoints = WaypointRoute(points_m=[(x, y) for x, y in route_points_w.tolist()])
    return msgspec.structs.replace(
        base,
        robot=msgspec.structs.replace(base.robot, motor=motor, limits=limits),
        scene=SceneFile(name="bench", ground=Ground(friction=0.0), route=waypoints, cylinder=pegs),
        start=StartPlacement(tail_s_m=tail_s_m),
    )


def measure_forces_at_rest(
    triplet: Triplet, propulsion_fraction: float = 1.0, lead_rad: float | Floats = 0.0
) -> tuple[float, Floats]:
    """Raise the torque slowly and wait until the snake is at rest.

    Args:
        triplet: the snake between its pegs.
        propulsion_fraction: which part of the solved torque is applied.
        lead_rad: how far the targets of the joints in position mode lead the initial angles.

    Returns:
        The tension of the tether in N, and the force on each of the three pegs in N.
    """
    backend = SimBackend(triplet.config, SimSettings(timestep_s=0.001, tether=triplet.tether))
    joint_count = triplet.config.robot.chain.modules
    torque_limits_nm = [triplet.config.robot.limits.torque_nm] * joint_count
    start_rad = np.array(backend.true_state().angles_rad)
    mode = [JointMode.POSITION] * joint_count
    mode[triplet.joint] = JointMode.TORQUE
    tensions_n: list[float] = []
    forces_n: list[list[float]] = []
    for tick in range(round((RISE_S + HOLD_S) * TICKS_PER_S)):
        fraction = propulsion_fraction * min(tick / (RISE_S * TICKS_PER_S), 1.0)
        target = start_rad + fraction * lead_rad
        target[triplet.joint] = fraction * triplet.solution.torque_nm
        backend.enact(SafeSetpoints(mode, target.tolist(), torque_limits_nm), "armed")
        backend.advance()
        force_by_peg_n = {f"cylinder_{k}": 0.0 for k in range(3)}
        for contact in backend.true_state().contacts:
            force_by_peg_n[contact.obstacle] += float(np.linalg.norm(contact.force_w))
        tension_n = backend.tether_tension_n
        assert tension_n is not None
        tensions_n.append(tension_n)
        forces_n.append(list(force_by_peg_n.values()))
    mean_tension_n = float(np.mean(tensions_n[-AVERAGED_TICKS:]))
    force_n = np.mean(forces_n[-AVERAGED_TICKS:], axis=0)
    solved_n = propulsion_fraction * triplet.solution.forces_n
    print(
        f"{propulsion_fraction:.2f}: tension {mean_tension_n:.2f} N; contacts {force_n.round(1)} N, "
        f"solved {solved_n.round(1)} N"
    )
    assert np.ptp(tensions_n[-AVERAGED_TICKS:]) < 0.02 * PROPULSION_N, "the snake is not at rest"
    return mean_tension_n, force_n


def replace_motors_by_shipped(triplet: Triplet, **robot_keys: object) -> Triplet:
    """Return the triplet with the motors of the shipped robot, and with other keys of the robot."""
    robot = msgspec.structs.replace(
        triplet.config.robot, motor=load_run_config("triplet").robot.motor, **robot_keys
    )
    config = msgspec.structs.replace(triplet.config, robot=robot)
    return dataclasses.replace(triplet, config=config)


FEASIBLE_TRIPLETS = (
    (seed, triplet) for seed in itertools.count(1) if (triplet := make_triplet(seed)) is not None
)
SEEDS_AND_TRIPLETS = list(itertools.islice(FEASIBLE_TRIPLETS, TRIPLETS))
each_triplet = pytest.mark.parametrize(
    "triplet", [pytest.param(triplet, id=f"seed{seed}") for seed, triplet in SEEDS_AND_TRIPLETS]
)
each_quick_triplet = pytest.mark.parametrize(
    "triplet",
    [
        pytest.param(
            triplet, id=f"seed{seed}", marks=pytest.mark.slow if index >= QUICK_TRIPLETS else ()
        )
        for index, (seed, triplet) in enumerate(SEEDS_AND_TRIPLETS)
    ],
)


@each_triplet
def test_statics_with_stiff_joints_matches_simulated_forces(triplet: Triplet):
    tension_n, force_n = measure_forces_at_rest(triplet)
    assert tension_n == pytest.approx(PROPULSION_N, rel=0.05)
    assert force_n == pytest.approx(triplet.solution.forces_n, rel=0.10)


@each_quick_triplet
def test_statics_matches_if_servo_targets_lead_by_load(triplet: Triplet):
    shipped = replace_motors_by_shipped(triplet)
    tension_without_lead_n, _ = measure_forces_at_rest(shipped)
    lead_rad = triplet.loads_nm / shipped.config.robot.motor.stiffness_nm_per_rad
    tension_n, force_n = measure_forces_at_rest(shipped, lead_rad=lead_rad)
    assert tension_n == pytest.approx(PROPULSION_N, rel=0.005)
    # Without the lead the tension is 33.2 to 42.8 N, and the contact forces are 0.43 to 1.09 of the solved ones.
    error_n = abs(tension_n - PROPULSION_N)
    assert abs(tension_without_lead_n - PROPULSION_N) > 10 * error_n
    assert force_n == pytest.approx(triplet.solution.forces_n, rel=0.01)


@pytest.mark.slow  # the test above applies the full torque
@each_triplet
def test_statics_matches_within_torque_limits_of_shipped_robot(triplet: Triplet):
    shipped = replace_motors_by_shipped(triplet, limits=load_run_config("triplet").robot.limits)
    robot = shipped.config.robot
    max_load_nm = float(np.abs(triplet.loads_nm).max())
    fraction = min(1.0, 0.98 * robot.limits.torque_nm / max_load_nm)
    lead_rad = triplet.loads_nm / robot.motor.stiffness_nm_per_rad
    tension_n, force_n = measure_forces_at_rest(shipped, fraction, lead_rad)
    assert tension_n == pytest.approx(fraction * PROPULSION_N, rel=0.01)
    assert force_n == pytest.approx(fraction * triplet.solution.forces_n, rel=0.02)
