"""A snake that slides along a wave among obstacles, without physics, and what its sensors tell: truth for guidance."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.pose.body_history import BasePose
from snakesim_gnc.guidance.pose.localization import PoseNoise
from snakesim_gnc.guidance.ranging.scan import RangeNoise
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.model.geometry.route import (
    Route,
    compute_yaw_segments_m,
    place_chain_on_route,
    sample_sine_curve,
)
from snakesim_hal.wire.messages import DepthImage, Imu, JointState, KnownObstacle, Pose
from snakesim_testing.gnc.rendered import (
    Ground,
    SensorErrors,
    flat_ground,
    make_box,
    make_cylinder,
    render_depth_image,
)
from snakesim_testing.gnc.stage import BODY_RADIUS_M, make_robot
from snakesim_testing.hal.small_robots import make_joint_state, make_pose

STEP_NS = 20_000_000  # duration of a guidance cycle
IMAGE_EVERY = 3  # cycles
DELAY_CYCLES = 2
POSE_NOISE = PoseNoise(0.0005, 0.001)
YAW_NOISE_RAD = 0.001  # standard deviation
NOISE = RangeNoise(0.002, 0.003)
# Random obstacles.
MAX_TRIES_PER_OBSTACLE = 100
BOX_FRACTION = 0.35
MIN_CORNER_M = (1.6, -1.0)  # of the area with obstacles, x and y
MAX_CORNER_M = (6.0, 1.0)
BOX_SIZE_RANGE_M = (0.06, 0.18)  # length and width
RADIUS_RANGE_M = (0.03, 0.06)
MAX_YAW_RAD = 3.0  # nearly half a revolution, after which a box looks the same
MIN_GAP_M = 0.12  # between obstacles
WAVE_HALF_WIDTH_M = 0.1  # strip along the x axis that stays free
ROUTE = Route(sample_sine_curve(0.045, 0.6, 12.0))


@dataclass(frozen=True)
class SnakePose:
    """Pose of the snake at one time: base, joint angles and links, without errors."""

    base_w: tuple[float, float, float]  # x, y, heading
    angles_rad: Floats
    origins_w: Floats
    rotations: Floats
    headings_rad: Floats
    head_w: Floats


@dataclass
class SlidingSnake:
    """A snake that slides along the path at constant speed, and a guidance that gets its simulated measurements."""

    obstacles: Sequence[KnownObstacle]
    speed_m_s: float = 0.2
    ground: Ground = flat_ground
    eye: SensorErrors = field(
        default_factory=lambda: SensorErrors(NOISE.floor_m, NOISE.per_m2, 0.01)
    )
    seed: int = 0
    cycle: int = 0

    def __post_init__(self) -> None:
        """Create the robot, and a guidance that knows only the start pose."""
        self.robot = make_robot()
        self.axes = [joint.axis for joint in self.robot.joints]
        self.lengths = [link.length_m for link in self.robot.links]
        self.random = np.random.default_rng(self.seed)
        start = BasePose(np.array(self.compute_pose(0).base_w), BODY_RADIUS_M, np.eye(3))
        self.world = PerceivedWorld(self.robot, start, POSE_NOISE)
        self.delayed_images: list[tuple[int, DepthImage]] = []

    def compute_pose(self, cycle: int) -> SnakePose:
        """Return the true pose of the snake in a guidance cycle."""
        lay = place_chain_on_route(
            ROUTE,
            0.02 + self.speed_m_s * cycle * STEP_NS * 1e-9,
            compute_yaw_segments_m(self.axes, self.lengths),
        )
        rotation = rotation_from_quaternion(quaternion_from_yaw(lay.heading_rad))
        tail = (*lay.tail_w, BODY_RADIUS_M)
        origins, rotations = compute_link_frames(
            tail, rotation, lay.angles_rad, self.axes, self.lengths
        )
        headings = lay.heading_rad + np.concatenate([[0.0], np.cumsum(lay.angles_rad)])
        head = origins[-1] + self.lengths[-1] * rotations[-1][:, 0]
        return SnakePose(
            (*lay.tail_w, lay.heading_rad), lay.angles_rad, origins, rotations, headings, head
        )

    def run_cycles(
        self, count: int, *, pose: bool = True, images: bool = True, imu: bool = True
    ) -> Iterator[SnakePose]:
        """Move the snake cycle by cycle, pass the measurements to guidance, and yield the true pose after each cycle.

        Calling this again continues from the last cycle.

        Args:
            count: Number of guidance cycles.
            pose: Whether guidance gets measured poses.
            images: Whether guidance gets depth images.
            imu: Whether guidance gets IMU samples.
        """
        for cycle in range(self.cycle, self.cycle + count):
            self.cycle = cycle
            here = self.compute_pose(self.cycle)
            before = self.compute_pose(self.cycle - 1)
            timestamp_ns = self.cycle * STEP_NS
            self.world.add_joints(
                self.make_joint_state(here, before),
                None,
                self.make_imu(here, before) if imu else None,
            )
            if pose:
                self.world.add_pose(self.make_pose(here))
            if images and self.cycle % IMAGE_EVERY == 0:
                self.delayed_images.append(
                    (self.cycle + DELAY_CYCLES, self.make_depth_image(here, timestamp_ns))
                )
            while self.delayed_images:
                arrival_cycle, image = self.delayed_images[0]
                if arrival_cycle > self.cycle:
                    break
                self.delayed_images.pop(0)
                self.world.add_ranging_sample(image, NOISE)
            self.world.make_world(self.cycle, timestamp_ns)
            yield here
        self.cycle += 1

    def make_joint_state(self, here: SnakePose, before: SnakePose) -> JointState:
        """Return the joint state with the noise of encoders."""
        angles = here.angles_rad + 0.0005 * self.random.standard_normal(len(here.angles_rad))
        speeds = (here.angles_rad - before.angles_rad) / (STEP_NS * 1e-9)
        return make_joint_state(
            self.robot,
            angles.tolist(),
            speeds.tolist(),
            tick=self.cycle,
            timestamp_ns=self.cycle * STEP_NS,
        )

    def make_imu(self, here: SnakePose, before: SnakePose) -> Imu:
        """Return an IMU sample of every link, with noise."""
        rates = (here.headings_rad - before.headings_rad) / (STEP_NS * 1e-9)
        rates = rates + 0.005 * self.random.standard_normal(len(rates))
        return Imu(
            tick=self.cycle,
            timestamp_ns=self.cycle * STEP_NS,
            link=list(range(len(rates))),
            angular_velocity_rad_s=[(0.0, 0.0, float(rate)) for rate in rates],
            acceleration_m_s2=[(0.0, 0.0, 9.81)] * len(rates),
        )

    def make_pose(self, here: SnakePose, off_m: float = 0.0) -> Pose:
        """Return the pose with the noise of motion capture.

        Args:
            here: True pose of the snake.
            off_m: Error along x that is added, as of a jump of the measurement.
        """
        standard_deviations = [POSE_NOISE.position_m, POSE_NOISE.position_m, YAW_NOISE_RAD]
        x_error_m, y_error_m, yaw_error_rad = self.random.standard_normal(3) * standard_deviations
        return make_pose(
            self.cycle,
            self.cycle * STEP_NS,
            position_w=(
                here.base_w[0] + float(x_error_m) + off_m,
                here.base_w[1] + float(y_error_m),
                BODY_RADIUS_M,
            ),
            orientation_wxyz=quaternion_from_yaw(here.base_w[2] + float(yaw_error_rad)),
        )

    def make_depth_image(self, here: SnakePose, timestamp_ns: int) -> DepthImage:
        """Return the image of a depth camera at the front end of the head."""
        forward_w = here.rotations[-1][:2, 0]
        # Obstacles that are too far behind or ahead cannot be seen. Without them rendering is faster.
        visible_obstacles: list[KnownObstacle] = []
        for obstacle in self.obstacles:
            distance_ahead_m = (np.array(obstacle.position_w[:2]) - here.head_w[:2]) @ forward_w
            if -0.2 < distance_ahead_m < 2.5:
                visible_obstacles.append(obstacle)
        return render_depth_image(
            visible_obstacles,
            here.head_w,
            here.rotations[-1],
            ground=self.ground,
            sensor_errors=self.eye,
            timestamp_ns=timestamp_ns,
            link_index=len(self.lengths) - 1,
            position_l=(self.lengths[-1], 0.0, 0.0),
        )


def make_random_obstacles(seed: int, count: int = 60) -> list[KnownObstacle]:
    """Return random obstacles on both sides of the snake's path, which is a wave along x.

    About two thirds of them are cylinders, one third boxes. A strip around the path stays free of obstacles.

    Args:
        seed: Seed of shapes and places.
        count: Number of obstacles; fewer if there are no free places left.
    """
    rng = np.random.default_rng(seed)
    obstacles: list[KnownObstacle] = []
    for _ in range(MAX_TRIES_PER_OBSTACLE * count):
        if len(obstacles) == count:
            break
        x, y = rng.uniform(MIN_CORNER_M, MAX_CORNER_M).tolist()
        length_m, width_m = rng.uniform(*BOX_SIZE_RANGE_M, 2).tolist()
        radius_m = float(rng.uniform(*RADIUS_RANGE_M))
        is_box = rng.random() < BOX_FRACTION
        bounding_radius_m = math.hypot(length_m, width_m) / 2 if is_box else radius_m
        has_free_place = all(
            compute_outline_distance_m(other, np.array([x, y])) > bounding_radius_m + MIN_GAP_M
            for other in obstacles
        )
        is_clear_of_wave = abs(y) > bounding_radius_m + WAVE_HALF_WIDTH_M
        if not (has_free_place and is_clear_of_wave):
            continue
        name = f"{len(obstacles)}"
        # Also drawn for cylinders, so that the shape does not change the next obstacle.
        yaw_rad = float(rng.uniform(0, MAX_YAW_RAD))
        if is_box:
            obstacles.append(make_box(name, x, y, (length_m, width_m), yaw_rad))
        else:
            obstacles.append(make_cylinder(name, x, y, radius_m))
    return obstacles
