"""Makes world models of surveyed obstacles, from the newest sensor samples."""

from collections.abc import Sequence

from snakesim_gnc.guidance.contacts.estimated_contacts import (
    ContactEstimator,
    EstimatedContacts,
    can_estimate_contacts,
    mark_estimated,
)
from snakesim_gnc.guidance.pose.dead_reckoned_pose import DeadReckonedPose
from snakesim_gnc.guidance.surveyed_world import SurveyedWorld
from snakesim_gnc.guidance.world_source import WorldSource, make_start_pose
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.scenario import RunConfig, get_noisy_obstacle_map
from snakesim_hal.network.client import HostClient
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Clock,
    Contacts,
    Imu,
    JointState,
    KnownObstacle,
    Pose,
    RobotDescription,
    WorldModel,
)


class SurveyedSource(WorldSource):
    """Uses the scene's map. Dead reckoning replaces a missing pose sensor, an estimate missing contact sensors."""

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the sensors, and read the surveyed obstacles of the scene.

        Args:
            client: Connection to the robot.
            config: Configuration of the run, with the scene and the robot's sensors.
        """
        sensors = config.robot.sensors
        self._client = client
        self._config = config
        self._surveyed_obstacles: Sequence[KnownObstacle] = get_noisy_obstacle_map(config)

        # Subscriptions.
        self._joint_feed = client.subscribe(keys.JOINTS, JointState)
        self._contact_feed = client.subscribe(keys.CONTACTS, Contacts) if sensors.contacts else None
        self._pose_feed = client.subscribe(keys.POSE, Pose)
        self._imu_feed = client.subscribe(keys.IMU, Imu) if sensors.imu else None

        # Models of the robot.
        self._model: SurveyedWorld | None = None
        # For a robot without a pose sensor.
        self._dead_reckoned_pose: DeadReckonedPose | None = None
        self._estimator: ContactEstimator | None = None  # for a robot without contact sensors

    def configure(self, robot: RobotDescription) -> None:
        """Create the models for this robot."""
        self._model = SurveyedWorld(robot, self._surveyed_obstacles)
        self._dead_reckoned_pose = None
        if self._config.uses_dead_reckoning(robot):
            self._dead_reckoned_pose = DeadReckonedPose(
                robot, make_start_pose(self._config), self._surveyed_obstacles
            )
            print_stderr(
                "no pose sensor: the pose is estimated by dead reckoning from the start, with joints, contacts and map"
            )
        self._estimator = None
        has_contact_sensor = any(sensor.key == keys.CONTACTS for sensor in robot.sensors)
        if not has_contact_sensor and can_estimate_contacts(robot):
            self._estimator = ContactEstimator(robot)
            print_stderr(
                "no contact sensors: contacts are estimated from the torques of the joints"
            )

    def make_world(self, clock: Clock) -> WorldModel | None:
        """Return the world model of surveyed obstacles, from the newest samples.

        Without a contact sensor, contacts are estimated. Without a pose sensor, the pose comes from dead reckoning. The
        world model contains where they come from.

        Args:
            clock: The current tick.

        Returns:
            The world model, or None if the joint state or the sample of the pose sensor is missing.
        """
        read = self._client.read
        joints = read(self._joint_feed)
        pose = None
        if self._dead_reckoned_pose is None:
            pose = read(self._pose_feed)
            if pose is None:
                return None
        if self._model is None or joints is None:
            return None
        contacts = read(self._contact_feed) if self._contact_feed else None
        estimated_contacts = None
        if contacts is None:
            estimated_contacts = self._estimate_contacts(joints, pose)
            if estimated_contacts is not None:
                contacts = estimated_contacts.contacts
        if self._dead_reckoned_pose is not None:
            pose = self._dead_reckoned_pose.update(
                joints, contacts, are_contacts_estimated=estimated_contacts is not None
            )
        assert pose is not None  # measured, or by dead reckoning
        world = self._model.update(clock.tick, clock.timestamp_ns, joints, contacts, pose)
        if estimated_contacts is not None:
            world = mark_estimated(world, estimated_contacts)
        if self._dead_reckoned_pose is not None:
            world = self._dead_reckoned_pose.mark_dead_reckoned(world)
        return world

    def _estimate_contacts(self, joints: JointState, pose: Pose | None) -> EstimatedContacts | None:
        if self._estimator is None:
            return None
        # With dead reckoning no IMU is used at all, see `dead_reckoned_pose`.
        imu = (
            self._client.read(self._imu_feed)
            if self._imu_feed and self._dead_reckoned_pose is None
            else None
        )
        return self._estimator.estimate_contacts(joints, imu, pose)
