"""All sensors of the robot, tick by tick."""

from collections import Counter, deque
from concurrent.futures import Future

import msgspec
import mujoco
import numpy as np

from snakesim_hal.backend import Samples
from snakesim_hal.model.robot_file.sensors import AnyMounted, AnySensor, MountedSensor
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire.messages import Message
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.sensors.joints import JointReader
from snakesim_sim_backend.sensors.registry import (
    make_body_reader,
    make_mounted_reader,
    make_sensor_rng,
)
from snakesim_sim_backend.sensors.scope import BodyScope, SensorReader, SensorScope
from snakesim_sim_backend.sensors.snapshots import SnapshotThread
from snakesim_sim_backend.sensors.timing import DelayLine, SamplingSchedule, round_to_ticks


class SensorSuite:
    """Every sensor has its rate, delay and noise: the same seed and commands give the same bytes.

    The sensors of the body share a noise generator. Each one that looks around has its own, so that it changes nothing
    for the others.
    """

    def __init__(
        self,
        sim: SimModel,
        data: mujoco.MjData,
        config: RunConfig,
        motors: ModelMotors,
        physics: PhysicsStepper,
        windings: ThermalModel,
    ) -> None:
        """Create the readers of all sensors in the robot file.

        Sensors of the body are read in the tick itself. Mounted sensors, such as cameras, are read in threads from
        snapshots of the state.

        Args:
            sim: Compiled model, with the indices of links and obstacles.
            data: State of the simulation.
            config: Configuration of the run, with the robot's sensors and the seed of their noise.
            motors: Motors, whose torques and currents are measured.
            physics: Physics with the forces of contacts.
            windings: Temperatures of the motors' windings.

        Raises:
            ConfigError: A sensor cannot be made.
        """
        sensors = config.robot.sensors
        scope = BodyScope(
            config, sim, data, np.random.default_rng(config.seed), motors, physics, windings
        )
        self._joints = JointReader(
            data, sensors.joints, motors, scope.noise.standard_normal, config.period_ns
        )
        self._channels: list[tuple[str, SynchronousSensor | ThreadedSensor]] = []

        # Samples that were dropped because they were not ready in time, and how many of them were reported, by key.
        self.dropped_counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()

        self._snapshots: SnapshotThread | None = None
        if any(True for _ in sensors.iterate_mounted()):
            self._snapshots = SnapshotThread(sim.model)
        for key, sensor in sensors.iterate_published():
            if isinstance(sensor, MountedSensor):
                channel = self._make_threaded_sensor(key, sensor, scope)
            else:
                channel = SynchronousSensor(make_body_reader(sensor, scope), sensor, config)
            self._channels.append((key, channel))

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the samples that are delivered at this tick. Ticks must come in order, each once."""
        sample_by_key: dict[str, Message] = {}
        for key, channel in self._channels:
            sample = channel.sample(tick, timestamp_ns)
            if sample is not None:
                sample_by_key[key] = sample
        return Samples(self._joints.read(tick, timestamp_ns), sample_by_key)

    def describe_dropped_samples(self) -> list[str]:
        """Return a text for each sensor whose number of dropped samples has doubled since its last text."""
        lines: list[str] = []
        for key, count in self.dropped_counts.items():
            if count >= max(2 * self._reported[key], 1):
                self._reported[key] = count
                lines.append(
                    f"{key}: {count} samples so far were not ready in time, and were dropped"
                )
        return lines

    def close(self) -> None:
        """Stop the thread that makes samples."""
        if self._snapshots is not None:
            self._snapshots.close()

    def _make_threaded_sensor(
        self, key: str, sensor: AnyMounted, scope: SensorScope
    ) -> "ThreadedSensor":
        """Make a sensor whose samples another thread makes. Its reader is made in that thread, too, for OpenGL."""
        snapshots = self._snapshots
        assert snapshots is not None
        own_scope = SensorScope(
            scope.config, scope.sim, snapshots.data, make_sensor_rng(key, scope.config.seed)
        )
        reader = snapshots.run(lambda: make_mounted_reader(key, sensor, own_scope))
        return ThreadedSensor(key, reader, sensor, scope, snapshots, self.dropped_counts)


class SynchronousSensor:
    """A sensor that is read within the tick."""

    def __init__(self, reader: SensorReader, sensor: AnySensor, config: RunConfig) -> None:
        self._read = reader.read
        self._schedule = SamplingSchedule(sensor.rate_hz, config.rate_hz, config.period_ns)
        self._delay_line = DelayLine(round_to_ticks(sensor.delay_s, config.period_ns))

    def sample(self, tick: int, timestamp_ns: int) -> Message | None:
        """Make a sample if one is due, and return the one that is delivered at this tick."""
        sample = None
        if self._schedule.is_due(timestamp_ns):
            sample = self._read(tick, timestamp_ns)
        return self._delay_line.delay(tick, sample)


class ThreadedSensor:
    """A slow sensor: another thread makes its samples, and they are delivered a tick later at the earliest.

    In real time a sample that is not ready at its delivery is dropped and counted. In the other clock modes the tick
    waits for it, so that every run of a seed gets the same samples.
    """

    def __init__(
        self,
        key: str,
        reader: SensorReader,
        sensor: MountedSensor,
        scope: SensorScope,
        snapshots: SnapshotThread,
        late: Counter[str],
    ) -> None:
        config = scope.config
        self._key = key
        self._read = reader.read
        self._snapshots = snapshots
        self._late = late
        self._qpos = scope.data.qpos
        self._waits_for_samples = config.clock_mode != "realtime"
        self._schedule = SamplingSchedule(sensor.rate_hz, config.rate_hz, config.period_ns)
        self._delay_ticks = max(round_to_ticks(sensor.delay_s, config.period_ns), 1)
        self._waiting: deque[tuple[int, Future[Message]]] = deque()  # with the tick of delivery

    def sample(self, tick: int, timestamp_ns: int) -> Message | None:
        """Begin a sample if one is due, and return the one that is delivered at this tick."""
        if self._schedule.is_due(timestamp_ns):
            pending_sample = self._snapshots.start_sample(
                self._read, tick, timestamp_ns, self._qpos
            )
            self._waiting.append((tick + self._delay_ticks, pending_sample))
        if not self._waiting:
            return None
        delivery_tick, oldest = self._waiting[0]
        if delivery_tick > tick:
            return None
        self._waiting.popleft()
        if self._waits_for_samples or oldest.done():
            return msgspec.structs.replace(oldest.result(), tick=tick)
        oldest.cancel()
        self._late[self._key] += 1
        return None
