"""Decides by their timestamps whether the inputs of control are fresh enough.

Ages are in robot time, from the time of measurement. The limits are the scenario's `[max_age]`. The defaults follow
from the normal rate of a stream. "Missed" are the longer of three missed samples and 0.2 s:

joints      as in the command limiter: three periods or 30 ms, and the sensor's delay; at most one lease
world       guidance's latency, and missed cycles of guidance
pose,       the sensor's delay, guidance's cycle and latency, and missed samples; likewise for a pose that the
contacts    service `sensor` publishes, by its schedule
depth       as for the pose, for the newest of all images and ranges, if the map is perceived
trajectory  guidance's cycle and latency, navigation's latency, and missed cycles of navigation

A timestamp that is further ahead of the clock than its limit is rejected as well: it is another host's, or forged.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.model.scenario import SENSOR, RunConfig, ServiceSchedule
from snakesim_hal.wire import keys
from snakesim_hal.wire.freshness import max_state_age_ns
from snakesim_hal.wire.messages import JointState, RobotDescription, Trajectory, WorldModel

# In a row that are tolerated; the fourth means that the publisher has stopped.
MAX_MISSED_SAMPLES = 3
# Guidance and navigation have no real-time priority: a busy computer delays them.
MIN_MARGIN_S = 0.2

# Sensors that a map is made from: the beginnings of their keys, and their name in messages.
DEPTH_PREFIXES = (keys.DEPTH_ALL.rstrip("*"), keys.RANGE_ALL.rstrip("*"))
DEPTH_SENSORS = "sensor/depth or sensor/range"


@dataclass(frozen=True)
class AgeLimits:
    """Maximum ages of the inputs of control."""

    joints_s: float
    world_s: float
    trajectory_s: float
    # By key: the sensors that a world model is made from; none for an absent sensor.
    sensors_s: dict[str, float]

    @staticmethod
    def from_config(config: RunConfig, robot: RobotDescription) -> "AgeLimits":
        """Compute the age limits of a run: those in its scenario, or else defaults from the rates of the streams."""
        max_age = config.max_age
        period_s = robot.period_ns * 1e-9
        guidance = config.services.get("guidance", ServiceSchedule())
        navigation = config.services.get("navigation", ServiceSchedule())
        guidance_cycle_s = guidance.decimation * period_s
        guidance_latency_s = guidance.latency_ticks * period_s
        navigation_cycle_s = navigation.decimation * period_s
        plan_age_s = guidance_cycle_s + guidance_latency_s + navigation.latency_ticks * period_s
        return AgeLimits(
            joints_s=max_age.joints_s or max_state_age_ns(robot) * 1e-9,
            world_s=max_age.world_s
            or guidance_latency_s + _compute_silence_margin_s(guidance_cycle_s),
            trajectory_s=max_age.trajectory_s
            or plan_age_s + _compute_silence_margin_s(navigation_cycle_s),
            sensors_s=_compute_sensor_limits_s(config, robot, guidance_cycle_s, guidance_latency_s),
        )

    def check_joints(self, joints: JointState, now_ns: int) -> str:
        """Return why a joint state is rejected at a robot time; empty if it is fresh."""
        return _check_age(keys.JOINTS, joints.timestamp_ns, now_ns, self.joints_s)

    def check_world(self, world: WorldModel, now_ns: int) -> str:
        """Return why a world model is rejected at a robot time; empty if it and the samples in it are fresh."""
        world_reason = _check_age(keys.WORLD, world.timestamp_ns, now_ns, self.world_s)
        if world_reason:
            return world_reason
        timestamps_ns = {
            keys.POSE: world.pose_timestamp_ns,
            keys.CONTACTS: world.contacts_timestamp_ns,
            DEPTH_SENSORS: world.depth_timestamp_ns,
        }
        reasons = [
            _check_age(key, timestamps_ns[key], now_ns, max_age_s)
            for key, max_age_s in self.sensors_s.items()
        ]
        return "; ".join(filter(None, reasons))

    def check_sensors(self, timestamps_ns: Mapping[str, int | None], now_ns: int) -> dict[str, str]:
        """Find the sensor samples that are too old for the controller.

        Args:
            timestamps_ns: Timestamp of the newest sample by key, for every key that has had one.
            now_ns: Robot time.

        Returns:
            The reason for each rejected sample, by key; fresh samples are left out.
        """
        rejected: dict[str, str] = {}
        for key, timestamp_ns in timestamps_ns.items():
            if key not in self.sensors_s:
                continue
            rejection = _check_age(key, timestamp_ns, now_ns, self.sensors_s[key])
            if rejection:
                rejected[key] = rejection
        return rejected

    def check_trajectory(self, trajectory: Trajectory, now_ns: int) -> str:
        """Return why a trajectory is rejected at a robot time; empty if it is fresh."""
        if trajectory.timestamp_ns is None:
            return f"{keys.TRAJECTORY} was planned without a world model"
        return _check_age(keys.TRAJECTORY, trajectory.timestamp_ns, now_ns, self.trajectory_s)


def _compute_sensor_limits_s(
    config: RunConfig, robot: RobotDescription, guidance_cycle_s: float, guidance_latency_s: float
) -> dict[str, float]:
    """Compute the maximum age of the pose, contact and depth samples that a world model is made from.

    A sample waits for the next cycle of guidance, and the world model is published after guidance's latency. Limits in
    the configuration override these defaults.

    Args:
        config: Configuration of the run.
        robot: Description of the robot, with its sensors.
        guidance_cycle_s: Period of guidance.
        guidance_latency_s: Time from a cycle of guidance to the publication of its world model.

    Returns:
        Maximum age in s by key. A sensor that is absent has no entry. DEPTH_SENSORS is the key for all depth sensors.
    """
    max_age = config.max_age
    configured_s = {keys.POSE: max_age.pose_s, keys.CONTACTS: max_age.contacts_s}
    limits_s: dict[str, float] = {}
    for sensor in robot.sensors:
        if sensor.key in configured_s:
            default_s = (
                sensor.delay_s
                + guidance_cycle_s
                + guidance_latency_s
                + _compute_silence_margin_s(1.0 / sensor.rate_hz)
            )
            limits_s[sensor.key] = configured_s[sensor.key] or default_s

    if config.uses_dead_reckoning(robot):
        limits_s.pop(keys.POSE, None)
    elif keys.POSE not in limits_s and SENSOR in config.services and config.mission.map == "known":
        # The robot's description does not list what this service publishes.
        publisher = config.services[SENSOR]
        period_s = robot.period_ns * 1e-9
        publication_delay_s = publisher.latency_ticks * period_s + _compute_silence_margin_s(
            publisher.decimation * period_s
        )
        limits_s[keys.POSE] = (
            max_age.pose_s or guidance_cycle_s + guidance_latency_s + publication_delay_s
        )

    if config.mission.map == "perceived":
        depth_sensors = [
            sensor for sensor in robot.sensors if sensor.key.startswith(DEPTH_PREFIXES)
        ]
        if depth_sensors:
            ages_s = [
                sensor.delay_s
                + guidance_cycle_s
                + guidance_latency_s
                + _compute_silence_margin_s(1.0 / sensor.rate_hz)
                for sensor in depth_sensors
            ]
            limits_s[DEPTH_SENSORS] = max_age.depth_s or min(ages_s)
    return limits_s


def _compute_silence_margin_s(cycle_s: float) -> float:
    """Return the time in s for which a publisher with this cycle may be silent beyond its normal delays."""
    return max(MAX_MISSED_SAMPLES * cycle_s, MIN_MARGIN_S)


def _check_age(key: str, timestamp_ns: int | None, now_ns: int, max_age_s: float) -> str:
    """Return why a sample is rejected because of its age; an empty text if its age is within the limit.

    Args:
        key: Key of the sample's stream.
        timestamp_ns: Timestamp of the sample; None if the world model was made without such a sample.
        now_ns: Robot time.
        max_age_s: Maximum age.
    """
    if timestamp_ns is None:
        return f"{keys.WORLD} was made without {key}"
    age_s = (now_ns - timestamp_ns) * 1e-9
    if age_s > max_age_s:
        return f"{key} is {age_s:.3g} s old, at most {max_age_s:.3g} s"
    if age_s < -max_age_s:
        return f"{key} is stamped {-age_s:.3g} s ahead of the robot's clock"
    return ""
