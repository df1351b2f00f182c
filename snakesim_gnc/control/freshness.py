"""Whether control's inputs are fresh enough, by their stamps. Pure.

Ages are in robot time, from the time of measurement. The limits are the scenario's `[max_age]`; the
defaults follow from the normal rate of a stream:

joints      as in the limiter: three periods or 30 ms, and the sensor's delay; at most a lease
world       guidance's lag, and three of its turns missed, or 0.2 s
pose,       the sensor's delay, guidance's turn and lag, and three samples missed, or 0.2 s; so of a pose that the
contacts    service `sensor` tells, by its schedule
depth       as the pose, for the newest of all images and ranges, when the map is perceived
trajectory  guidance's turn and lag, navigation's lag, and three of its turns missed, or 0.2 s

A stamp that is further ahead of the clock than its limit is rejected as well: it is of another host, or forged.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.model.scenario import SENSOR, RunConfig, Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.freshness import oldest_state_ns
from snakesim_hal.wire.messages import Description, JointState, Trajectory, World

MISSED = 3
LOOKING = (keys.DEPTH_ALL.rstrip("*"), keys.RANGE_ALL.rstrip("*"))  # sensors that a map is made from
DEPTH = "sensor/depth or sensor/range"
MIN_MARGIN_S = 0.2  # guidance and navigation have no real-time priority: a busy computer delays them


@dataclass(frozen=True)
class Limits:
    """Maximum ages, in s; none for an absent sensor."""

    joints_s: float
    world_s: float
    trajectory_s: float
    sensors_s: dict[str, float]  # by key: inputs of a world model

    @staticmethod
    def of(config: RunConfig, robot: Description) -> "Limits":
        """Those of a run: from its scenario, or the defaults."""
        period_s, own = robot.period_ns * 1e-9, config.max_age
        guidance = config.services.get("guidance", Service())
        navigation = config.services.get("navigation", Service())
        turn_s, lag_s = guidance.decimation * period_s, guidance.latency_ticks * period_s
        plan_s = navigation.decimation * period_s
        planned_s = turn_s + lag_s + navigation.latency_ticks * period_s
        said = {keys.POSE: own.pose_s, keys.CONTACTS: own.contacts_s}
        sensors_s = {
            sensor.key: said[sensor.key] or sensor.delay_s + turn_s + lag_s + _margin_s(1.0 / sensor.rate_hz)
            for sensor in robot.sensors
            if sensor.key in said
        }
        if config.dead_reckons(robot):
            sensors_s.pop(keys.POSE, None)
        elif keys.POSE not in sensors_s and SENSOR in config.services and config.mission.map == "known":
            teller = config.services[SENSOR]  # what it tells is in no description
            told_s = teller.latency_ticks * period_s + _margin_s(teller.decimation * period_s)
            sensors_s[keys.POSE] = own.pose_s or turn_s + lag_s + told_s
        looking = [sensor for sensor in robot.sensors if sensor.key.startswith(LOOKING)]
        if looking and config.mission.map == "perceived":
            ages_s = [sensor.delay_s + turn_s + lag_s + _margin_s(1.0 / sensor.rate_hz) for sensor in looking]
            sensors_s[DEPTH] = own.depth_s or min(ages_s)
        return Limits(
            joints_s=own.joints_s or oldest_state_ns(robot) * 1e-9,
            world_s=own.world_s or lag_s + _margin_s(turn_s),
            trajectory_s=own.trajectory_s or planned_s + _margin_s(plan_s),
            sensors_s=sensors_s,
        )

    def against_joints(self, joints: JointState, now_ns: int) -> str:
        """Why a joint state is rejected; empty when it is fresh. now_ns: robot time."""
        return _off(keys.JOINTS, joints.timestamp_ns, now_ns, self.joints_s)

    def against_world(self, world: World, now_ns: int) -> str:
        """Why a world model is rejected; empty when it is fresh."""
        off = _off(keys.WORLD, world.timestamp_ns, now_ns, self.world_s)
        if off:
            return off
        stamps = {
            keys.POSE: world.pose_timestamp_ns,
            keys.CONTACTS: world.contacts_timestamp_ns,
            DEPTH: world.depth_timestamp_ns,
        }
        found = [_off(key, stamps[key], now_ns, limit_s) for key, limit_s in self.sensors_s.items()]
        return "; ".join(filter(None, found))

    def of_sensors(self, timestamps_ns: Mapping[str, int | None], now_ns: int) -> dict[str, str]:
        """Why samples are rejected, by key. timestamps_ns: of the newest sample of each key that has had one."""
        limits = {key: self.sensors_s[key] for key in timestamps_ns if key in self.sensors_s}
        found = {key: _off(key, timestamps_ns[key], now_ns, limit_s) for key, limit_s in limits.items()}
        return {key: why for key, why in found.items() if why}

    def against_trajectory(self, trajectory: Trajectory, now_ns: int) -> str:
        """Why a trajectory is rejected; empty when it is fresh."""
        if trajectory.timestamp_ns is None:
            return f"{keys.TRAJECTORY} was planned without a world model"
        return _off(keys.TRAJECTORY, trajectory.timestamp_ns, now_ns, self.trajectory_s)


def _margin_s(turn_s: float) -> float:
    return max(MISSED * turn_s, MIN_MARGIN_S)


def _off(key: str, timestamp_ns: int | None, now_ns: int, limit_s: float) -> str:
    if timestamp_ns is None:
        return f"{keys.WORLD} was made without {key}"
    age_s = (now_ns - timestamp_ns) * 1e-9
    if age_s > limit_s:
        return f"{key} is {age_s:.3g} s old, at most {limit_s:.3g} s"
    if age_s < -limit_s:
        return f"{key} is stamped {-age_s:.3g} s ahead of the robot's clock"
    return ""
