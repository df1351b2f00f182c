"""A robot, a wavy path with pegs, and observations of a body on it, without any physics."""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from snakesim_gnc.geometry.body_on_path import compute_chain_points
from snakesim_hal.controller import Observation
from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.geometry.route import (
    Route,
    compute_yaw_segments_m,
    expand_yaw_angles,
    place_chain_on_route,
    sample_sine_curve,
)
from snakesim_hal.wire.messages import (
    Axis,
    KnownObstacle,
    RobotDescription,
    Trajectory,
    WorldContact,
    WorldModel,
)
from snakesim_testing.hal.small_robots import make_description, make_joint_state

T = TypeVar("T")

PERIOD_S = 0.01
AMPLITUDE_M = 0.045  # of the route
WAVELENGTH_M = 0.6
LENGTH_M = 6.0
BODY_RADIUS_M = 0.04
PEG_RADIUS_M = 0.05
CLEARANCE_M = 0.005  # between body and peg


def tick_to_time_ns(tick: int) -> int:
    """Return the robot time of a tick."""
    return tick * round(PERIOD_S * 1e9)


def require_value(value: T | None) -> T:
    """Return a value that must not be None."""
    assert value is not None
    return value


def make_robot(
    module_count: int = 13, axes: tuple[Axis, ...] = ("yaw",), torque_nm: float = 7.0
) -> RobotDescription:
    """Return the description of a chain of equal modules with a length of 0.11 m.

    Args:
        module_count: Number of modules, which is the number of joints.
        axes: Axes of the joints, repeated from tail to head.
        torque_nm: Torque limit of each joint.
    """
    limits = {
        "speed_rad_s": 7.5,
        "acceleration_rad_s2": 400,
        "torque_nm": torque_nm,
        "torque_rate_nm_s": 200,
    }
    gains = {
        "stiffness_nm_per_rad": 60,
        "damping_nm_s_per_rad": 1.5,
        "velocity_gain_nm_s_per_rad": 1.5,
    }
    return make_description(
        chain={"modules": module_count, "axes": list(axes)},
        module={"length_m": 0.11, "radius_m": BODY_RADIUS_M, "mass_kg": 0.3},
        limits={"angle_rad": 1.5, **limits},
        motor={"response_time_s": 0.01, "armature_kg_m2": 0.005, **gains},
    )


def make_world(**changes: Any) -> WorldModel:
    """Return a world model with a body at the origin and nothing around it, with changes of its fields."""
    values: dict[str, Any] = {
        "tick": 0,
        "timestamp_ns": 0,
        "base_position_w": (0.0, 0.0, 0.0),
        "base_orientation_wxyz": (1.0, 0.0, 0.0, 0.0),
        "base_confidence": 1.0,
        "contacts": [],
        "obstacles": [],
    }
    return WorldModel(**(values | changes))


def make_contact(
    obstacle: str, force_w: tuple[float, float, float], link_index: int = 0, body_s_m: float = 0.1
) -> WorldContact:
    """Return a contact on the right side of a body that lies along x."""
    return WorldContact(
        link=link_index,
        obstacle=obstacle,
        body_s_m=body_s_m,
        position_w=(0.0, 0.0, 0.0),
        normal_w=(0.0, 1.0, 0.0),
        tangent_w=(1.0, 0.0, 0.0),
        force_w=force_w,
    )


def make_route(amplitude_m: float = AMPLITUDE_M, wavelength_m: float = WAVELENGTH_M) -> Route:
    """Return a route that is a sine along x."""
    return Route(sample_sine_curve(amplitude_m, wavelength_m, LENGTH_M))


def make_pegs(route: Route) -> list[KnownObstacle]:
    """Return a peg at each inflection of a route along x, on the side from which it pushes the body forward."""
    distance_m = BODY_RADIUS_M + CLEARANCE_M + PEG_RADIUS_M  # from the route to the center of a peg
    pegs: list[KnownObstacle] = []
    for index, s_m in enumerate(route.find_inflections_s_m()):
        tangent = route.tangent_w(s_m)
        left = np.array([-tangent[1], tangent[0]])
        push_direction = left if left[0] > 0 else -left  # of the force from the peg on the body
        x, y = (route.compute_positions_w(s_m) - push_direction * distance_m).tolist()
        pegs.append(
            KnownObstacle(
                name=f"peg_{index}",
                shape="cylinder",
                position_w=(x, y, 0.1),
                radius_m=PEG_RADIUS_M,
                height_m=0.2,
            )
        )
    return pegs


@dataclass
class ObservationStage:
    """Makes observations of a body that lies on the route, with whatever is to be different."""

    robot: RobotDescription
    route: Route
    pegs: list[KnownObstacle]
    speed_m_s: float = 0.2
    path_id: int = 0
    assumed_obstacle_friction: float = 0.0  # the path was planned with this friction

    def make_observation(
        self,
        tick: int,
        tail_s_m: float,
        *,
        world_age_ticks: int = 0,
        world_tail_s_m: float | None = None,
        turned: dict[int, float] | None = None,
        torque_nm: float = 0.0,
        contacts: list[WorldContact] | None = None,
        pose_age_ticks: int | None = None,
        without: str = "",
    ) -> Observation:
        """Return what a controller observes of a body on the route.

        Args:
            tick: Tick of the observation and of the joint state.
            tail_s_m: Position of the tail along the route.
            world_age_ticks: Age of the world model.
            world_tail_s_m: Position of the tail in the world model. None: the true one.
            turned: Difference between a joint angle and that of the route in rad, by joint index.
            torque_nm: Measured torque of every joint.
            contacts: Contacts in the world model. None: their time is unknown.
            pose_age_ticks: Age of the pose in the world model. None: that of the world model.
            without: What is missing: "world", "trajectory" or nothing.
        """
        axes = [joint.axis for joint in self.robot.joints]
        segments = compute_yaw_segments_m(axes, [link.length_m for link in self.robot.links])
        true_placement = place_chain_on_route(self.route, tail_s_m, segments)
        angles = expand_yaw_angles(axes, true_placement.angles_rad)
        for joint, angle_rad in (turned or {}).items():
            angles[joint] += angle_rad
        seen_placement = true_placement
        if world_tail_s_m is not None:
            seen_placement = place_chain_on_route(self.route, world_tail_s_m, segments)
        world_tick = tick - world_age_ticks
        pose_tick = world_tick if pose_age_ticks is None else tick - pose_age_ticks
        world = make_world(
            tick=world_tick,
            timestamp_ns=tick_to_time_ns(world_tick),
            pose_timestamp_ns=tick_to_time_ns(pose_tick),
            base_position_w=(*seen_placement.tail_w, BODY_RADIUS_M),
            base_orientation_wxyz=quaternion_from_yaw(seen_placement.heading_rad),
            contacts=contacts or [],
            contacts_timestamp_ns=None if contacts is None else tick_to_time_ns(world_tick),
            obstacles=self.pegs,
        )
        joints = make_joint_state(
            self.robot,
            angles.tolist(),
            torque=torque_nm,
            tick=tick,
            timestamp_ns=tick_to_time_ns(tick),
        )
        trajectory = Trajectory(
            tick=0,
            timestamp_ns=0,
            path_id=self.path_id,
            path_w=[(x, y) for x, y in self.route.points_w.tolist()],
            speed_m_s=self.speed_m_s,
            push_points=[],
            finished=False,
            assumed_obstacle_friction=self.assumed_obstacle_friction,
        )
        return Observation(
            tick=tick,
            time_s=tick * PERIOD_S,
            period_s=PERIOD_S,
            joints=joints,
            world=None if without == "world" else world,
            trajectory=None if without == "trajectory" else trajectory,
        )


def make_stage(
    module_count: int = 13, axes: tuple[Axis, ...] = ("yaw",), torque_nm: float = 7.0
) -> ObservationStage:
    """Return a robot on a sine route with a peg at each inflection."""
    route = make_route()
    return ObservationStage(make_robot(module_count, axes, torque_nm), route, make_pegs(route))


def compute_body_points(stage: ObservationStage, tail_s_m: float) -> np.ndarray:
    """Return the nodes (2, n_nodes) of the body on the route."""
    axes = [joint.axis for joint in stage.robot.joints]
    segments = compute_yaw_segments_m(axes, [link.length_m for link in stage.robot.links])
    lay = place_chain_on_route(stage.route, tail_s_m, segments)
    return compute_chain_points(lay.tail_w, lay.heading_rad, lay.angles_rad.tolist(), segments)
