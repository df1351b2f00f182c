"""All sensors of the robot, tick by tick."""

from collections import Counter, deque
from concurrent.futures import Future

import msgspec
import mujoco
import numpy as np

from snakesim_hal.backend import Samples
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.sensors import AnyMounted, AnySensor, Mounted
from snakesim_hal.physics.thermal import Thermal
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Message
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.sensors.joints import JointReader
from snakesim_sim_backend.sensors.registry import SYNCHRONOUS, mounted_reader, own_noise
from snakesim_sim_backend.sensors.scope import BodyScope, Reader, Scope
from snakesim_sim_backend.sensors.snapshots import Snapshots
from snakesim_sim_backend.sensors.timing import DelayLine, SamplingSchedule, ticks_of


class Sensors:
    """Every sensor has its rate, delay and noise: the same seed and commands give the same bytes.

    The sensors of the body share a noise generator. Each one that looks around has its own, so that it changes nothing
    for the others.
    """

    def __init__(
        self,
        sim: SimModel,
        data: mujoco.MjData,
        config: RunConfig,
        motors: Motors,
        physics: Physics,
        windings: Thermal,
    ) -> None:
        """Raises ConfigError when a sensor cannot be made."""
        scope = BodyScope(config, sim, data, np.random.default_rng(config.seed), motors, physics, windings)
        has = config.robot.sensors
        self._joints = JointReader(data, has.joints, motors, scope.noise.standard_normal, config.period_ns)
        self.late: Counter[str] = Counter()  # samples that were dropped because they were not ready in time, by key
        self._reported: Counter[str] = Counter()  # how many of them have been reported
        self._others: list[tuple[str, SynchronousSensor | ThreadedSensor]] = []
        self._snapshots = Snapshots(sim.model) if next(has.mounted(), None) else None
        for key, sensor in has.published():
            if isinstance(sensor, Mounted):
                channel = self._threaded(key, sensor, scope)
            else:
                message = keys.message_at(key)
                assert message is not None, key
                channel = SynchronousSensor(SYNCHRONOUS[message](sensor, scope), sensor, config)
            self._others.append((key, channel))

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Every sensor that is due. Ticks must come in order, each once."""
        others: dict[str, Message] = {}
        for key, channel in self._others:
            arrived = channel.arriving(tick, timestamp_ns)
            if arrived is not None:
                others[key] = arrived
        return Samples(self._joints.read(tick, timestamp_ns), others)

    def lateness(self) -> list[str]:
        """What to report of dropped samples since the last call: the first one, and each doubling."""
        lines: list[str] = []
        for key, count in self.late.items():
            if count >= max(2 * self._reported[key], 1):
                self._reported[key] = count
                lines.append(f"{key}: {count} samples so far were not ready in time, and were dropped")
        return lines

    def close(self) -> None:
        """Stop looking."""
        if self._snapshots is not None:
            self._snapshots.close()

    def _threaded(self, key: str, sensor: AnyMounted, scope: Scope) -> "ThreadedSensor":
        snapshots = self._snapshots
        assert snapshots is not None
        own = Scope(scope.config, scope.sim, snapshots.data, own_noise(key, scope.config.seed))
        reader = snapshots.do(lambda: mounted_reader(key, sensor, own))
        return ThreadedSensor(key, reader, sensor, scope, snapshots, self.late)


class SynchronousSensor:
    """A sensor that is read at once."""

    def __init__(self, reader: Reader, sensor: AnySensor, config: RunConfig) -> None:
        self._read = reader.read
        self._due = SamplingSchedule(sensor.rate_hz, config.rate_hz, config.period_ns)
        self._line = DelayLine(ticks_of(sensor.delay_s, config.period_ns))

    def arriving(self, tick: int, timestamp_ns: int) -> Message | None:
        """Take a sample if due, and return the one that arrives at this tick."""
        taken = self._read(tick, timestamp_ns) if self._due.at(timestamp_ns) else None
        return self._line.pass_on(tick, taken)


class ThreadedSensor:
    """A sensor that takes long: its samples are made in another thread, and arrive a tick later at the earliest.

    In real time a sample that is not ready when it should arrive is dropped and counted. Otherwise it is waited for,
    so that every run of a seed gets the same.
    """

    def __init__(
        self, key: str, reader: Reader, sensor: Mounted, scope: Scope, snapshots: Snapshots, late: Counter[str]
    ) -> None:
        config = scope.config
        self._key, self._read, self._snapshots, self._late = key, reader.read, snapshots, late
        self._qpos = scope.data.qpos
        self._waits = config.clock_mode != "realtime"
        self._due = SamplingSchedule(sensor.rate_hz, config.rate_hz, config.period_ns)
        self._delay_ticks = max(ticks_of(sensor.delay_s, config.period_ns), 1)
        self._under_way: deque[tuple[int, Future[Message]]] = deque()  # with the tick of arrival

    def arriving(self, tick: int, timestamp_ns: int) -> Message | None:
        """Take a sample if due, and return the one that arrives at this tick."""
        if self._due.at(timestamp_ns):
            sample = self._snapshots.begin(self._read, tick, timestamp_ns, self._qpos)
            self._under_way.append((tick + self._delay_ticks, sample))
        if not self._under_way or self._under_way[0][0] > tick:
            return None
        _, sample = self._under_way.popleft()
        if self._waits or sample.done():
            return msgspec.structs.replace(sample.result(), tick=tick)
        sample.cancel()
        self._late[self._key] += 1
        return None
