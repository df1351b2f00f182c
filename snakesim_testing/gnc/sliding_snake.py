"""A snake that slides along a wave among obstacles, without physics, and what its sensors tell: truth for guidance."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from snakesim_gnc.guidance.body_history import Base
from snakesim_gnc.guidance.localization import PoseNoise
from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.scan import Noise
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames, quaternion_from_yaw, rotation_from_quaternion
from snakesim_hal.model.outlines import outline_distance_m
from snakesim_hal.model.route import Route, lay_chain, sine_points, yaw_segments_m
from snakesim_hal.wire.messages import DepthImage, Imu, JointState, Obstacle, Pose
from snakesim_testing.gnc.rendered import Eye, Ground, box, cylinder, depth_image, flat
from snakesim_testing.gnc.stage import BODY_RADIUS_M, make_robot
from snakesim_testing.hal.small_robots import pose, state

STEP_NS = 20_000_000  # guidance's turn
IMAGE_EVERY = 3  # turns
DELAY_TURNS = 2
POSE_NOISE = PoseNoise(0.0005, 0.001)
NOISE = Noise(0.002, 0.003)
# Random obstacles.
MAX_TRIES_PER_OBSTACLE = 100
BOX_FRACTION = 0.35
MIN_GAP_M = 0.12  # between obstacles
WAVE_HALF_WIDTH_M = 0.1  # strip along the x axis that stays free
ROUTE = Route(sine_points(0.045, 0.6, 12.0))


@dataclass(frozen=True)
class Place:
    """Where the snake is."""

    base_w: tuple[float, float, float]  # x, y, heading
    angles_rad: Floats
    origins_w: Floats
    rotations: Floats
    headings_rad: Floats
    head_w: Floats


@dataclass
class Drive:
    """A snake at a steady speed; `turns` goes on from where it was."""

    obstacles: Sequence[Obstacle]
    speed_m_s: float = 0.2
    ground: Ground = flat
    eye: Eye = field(default_factory=lambda: Eye(NOISE.floor_m, NOISE.per_m2, 0.01))
    seed: int = 0
    turn: int = 0

    def __post_init__(self) -> None:
        """A robot, and guidance that knows only where it was laid down."""
        self.robot = make_robot()
        self.axes = [joint.axis for joint in self.robot.joints]
        self.lengths = [link.length_m for link in self.robot.links]
        self.random = np.random.default_rng(self.seed)
        start = Base(np.array(self.place(0).base_w), BODY_RADIUS_M, np.eye(3))
        self.world = PerceivedWorld(self.robot, start, POSE_NOISE)
        self.under_way: list[tuple[int, DepthImage]] = []

    def place(self, turn: int) -> Place:
        """Where it is at a turn."""
        lay = lay_chain(ROUTE, 0.02 + self.speed_m_s * turn * STEP_NS * 1e-9, yaw_segments_m(self.axes, self.lengths))
        rotation = rotation_from_quaternion(quaternion_from_yaw(lay.heading_rad))
        tail = (*lay.tail_w, BODY_RADIUS_M)
        origins, rotations = link_frames(tail, rotation, lay.angles_rad, self.axes, self.lengths)
        headings = lay.heading_rad + np.concatenate([[0.0], np.cumsum(lay.angles_rad)])
        head = origins[-1] + self.lengths[-1] * rotations[-1][:, 0]
        return Place((*lay.tail_w, lay.heading_rad), lay.angles_rad, origins, rotations, headings, head)

    def turns(self, count: int, *, pose: bool = True, images: bool = True, imu: bool = True) -> Iterator[Place]:
        """Move, tell guidance what the sensors measure, and yield where it really is, after each turn."""
        for turn in range(self.turn, self.turn + count):
            self.turn = turn
            here, before = self.place(self.turn), self.place(self.turn - 1)
            timestamp_ns = self.turn * STEP_NS
            self.world.add_joints(self.joints(here, before), None, self.imu(here, before) if imu else None)
            if pose:
                self.world.add_pose(self.pose(here))
            if images and self.turn % IMAGE_EVERY == 0:
                self.under_way.append((self.turn + DELAY_TURNS, self.image(here, timestamp_ns)))
            while self.under_way and self.under_way[0][0] <= self.turn:
                self.world.add_ranging_sample(self.under_way.pop(0)[1], NOISE)
            self.world.make_world(self.turn, timestamp_ns)
            yield here
        self.turn += 1

    def joints(self, here: Place, before: Place) -> JointState:
        """With the noise of an encoder."""
        angles = here.angles_rad + 0.0005 * self.random.standard_normal(len(here.angles_rad))
        speeds = (here.angles_rad - before.angles_rad) / (STEP_NS * 1e-9)
        return state(self.robot, angles.tolist(), speeds.tolist(), tick=self.turn, timestamp_ns=self.turn * STEP_NS)

    def imu(self, here: Place, before: Place) -> Imu:
        """Of every link."""
        rates = (here.headings_rad - before.headings_rad) / (STEP_NS * 1e-9)
        rates = rates + 0.005 * self.random.standard_normal(len(rates))
        return Imu(
            tick=self.turn,
            timestamp_ns=self.turn * STEP_NS,
            link=list(range(len(rates))),
            angular_velocity_rad_s=[(0.0, 0.0, float(rate)) for rate in rates],
            acceleration_m_s2=[(0.0, 0.0, 9.81)] * len(rates),
        )

    def pose(self, here: Place, off_m: float = 0.0) -> Pose:
        """With the noise of motion capture. off_m: a jump."""
        x, y, turn = self.random.standard_normal(3) * [POSE_NOISE.position_m, POSE_NOISE.position_m, 0.001]
        return pose(
            self.turn,
            self.turn * STEP_NS,
            position_w=(here.base_w[0] + float(x) + off_m, here.base_w[1] + float(y), BODY_RADIUS_M),
            orientation_wxyz=quaternion_from_yaw(here.base_w[2] + float(turn)),
        )

    def image(self, here: Place, timestamp_ns: int) -> DepthImage:
        """Of a camera at the front end of the head."""
        mount, link = (self.lengths[-1], 0.0, 0.0), len(self.lengths) - 1
        ahead = here.rotations[-1][:2, 0]
        in_view = [o for o in self.obstacles if -0.2 < (np.array(o.position_w[:2]) - here.head_w[:2]) @ ahead < 2.5]
        return depth_image(
            in_view,
            here.head_w,
            here.rotations[-1],
            ground=self.ground,
            eye=self.eye,
            timestamp_ns=timestamp_ns,
            link=link,
            position_l=mount,
        )


def random_field(seed: int, count: int = 60) -> list[Obstacle]:
    """Return random obstacles on both sides of the wave: about two thirds cylinders, one third boxes.

    Args:
        seed: Seed of shapes and places.
        count: Number of obstacles; there are fewer if no free places are found.
    """
    random = np.random.default_rng(seed)
    obstacles: list[Obstacle] = []
    for _ in range(MAX_TRIES_PER_OBSTACLE * count):
        if len(obstacles) == count:
            break
        x, y = random.uniform([1.6, -1.0], [6.0, 1.0]).tolist()  # m
        length_m, width_m = random.uniform(0.06, 0.18, 2).tolist()
        radius_m = float(random.uniform(0.03, 0.06))
        is_box = random.random() < BOX_FRACTION
        half_extent_m = math.hypot(length_m, width_m) / 2 if is_box else radius_m
        has_free_place = all(
            outline_distance_m(other, np.array([x, y])) > half_extent_m + MIN_GAP_M for other in obstacles
        )
        is_beside_wave = abs(y) > half_extent_m + WAVE_HALF_WIDTH_M
        if not (has_free_place and is_beside_wave):
            continue
        name = f"{len(obstacles)}"
        yaw_rad = float(random.uniform(0, 3))  # drawn for cylinders, too: the next obstacle depends on it
        if is_box:
            obstacles.append(box(name, x, y, (length_m, width_m), yaw_rad))
        else:
            obstacles.append(cylinder(name, x, y, radius_m))
    return obstacles
