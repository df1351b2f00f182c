"""The simulator in this process: with everything published, its physics alone, and MuJoCo alone."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.model.plugins import decode_plugin_settings
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import Publisher
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.keys import CLOCK, JOINTS
from snakesim_hal.wire.messages import JointCommand, JointMode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_testing.hal.small_robots import make_clock, make_joint_command
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.whole_run import run_controller as run_in_process

TICKS_A_BLOCK = 50  # measured in one go, before the next kind of measurement has its turn
# What decides the forces of MuJoCo itself: everything except the memory of our laws.
STATE_WITHOUT_LAWS = int(mujoco.mjtState.mjSTATE_INTEGRATION) & ~int(
    mujoco.mjtState.mjSTATE_PLUGIN | mujoco.mjtState.mjSTATE_USERDATA
)
LONG_NUMBER = 10**6  # a tick and sequence number of a run of some hours: it takes more bytes than 0


def load_config(*sets: str) -> RunConfig:
    """Load the scenario that is measured, changed by texts as of `--set`."""
    return load_scenario("triplet", [parse_set_option(text) for text in sets]).config


def open_simulator(config: RunConfig, laws: LawsVersion | None = None) -> SimBackend:
    """Open the simulator as the host opens it, or with a certain version of the laws."""
    settings = decode_plugin_settings(
        SimBackend, config.backends.get("sim", {}), "benchmarks", "backends.sim"
    )
    return SimBackend(config, settings, laws=laws)


class SamplePublisher:
    """Publishes samples and the clock as the host does, and does nothing else."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Publisher[JointCommand]] = {}

    def publish(self, tick: int, samples: Samples) -> None:
        """Publish every sample and the clock."""
        newest = dict.fromkeys(samples.by_key, tick)
        now = make_clock(tick, arm_session=1, clock_mode="free", newest=newest)
        for key, message in ((JOINTS, samples.joints), *samples.by_key.items(), (CLOCK, now)):
            if key not in self._publishers:
                self._publishers[key] = self._session.declare_publisher(key, type(message))  # pyright: ignore
            self._publishers[key].put(message)  # pyright: ignore


class BareSimulation:
    """Repeats a motion on the same model, by the physics alone."""

    def __init__(self, config: RunConfig, laws: LawsVersion | None = None) -> None:
        self._backend = open_simulator(config, laws)

    def measure_physics_us(self, setpoints: Sequence[SafeSetpoints]) -> float:
        """Return the mean CPU time of a control period over these setpoints, without the handing over of setpoints."""
        physics = self._backend.physics
        steps = self._backend.sim.steps_per_tick
        spent_s = 0.0
        for tick_setpoints in setpoints:
            self._backend.enact(tick_setpoints, "armed")
            began_s = time.thread_time()
            physics.step(steps)
            spent_s += time.thread_time() - began_s
        return spent_s / len(setpoints) * 1e6


class BareMujoco:
    """Repeats a motion, and measures `mj_step` from its states in a model without our laws."""

    def __init__(self, config: RunConfig) -> None:
        self._moving = open_simulator(config)
        # Its model has no plugins, so `mj_step` computes no laws.
        self._bare = open_simulator(config, "python")
        self._state = np.empty(mujoco.mj_stateSize(self._bare.sim.model, STATE_WITHOUT_LAWS))

    def measure_us(self, setpoints: Sequence[SafeSetpoints]) -> float:
        """Return the mean CPU time of `mj_step` for a control period over these setpoints."""
        moving = self._moving
        bare = self._bare
        steps = bare.sim.steps_per_tick
        spent_s = 0.0
        for tick_setpoints in setpoints:
            moving.enact(tick_setpoints, "armed")
            bare.enact(tick_setpoints, "armed")
            mujoco.mj_getState(moving.sim.model, moving.data, self._state, STATE_WITHOUT_LAWS)
            mujoco.mj_setState(bare.sim.model, bare.data, self._state, STATE_WITHOUT_LAWS)
            began_s = time.thread_time()
            mujoco.mj_step(bare.sim.model, bare.data, steps)
            spent_s += time.thread_time() - began_s
            moving.physics.step(steps)
        return spent_s / len(setpoints) * 1e6


def record_motion(config: RunConfig) -> tuple[list[SafeSetpoints], float]:
    """Run the scenario in this process.

    Returns:
        The setpoints of every tick, and the mean time of the controller alone, in µs.
    """
    whole_run = run_in_process(config)
    record = whole_run.record
    limits_nm = [joint.torque_limit_nm for joint in record.description.joints]
    setpoints: list[SafeSetpoints] = []
    for mode_codes, target in zip(record.mode.tolist(), record.target.tolist(), strict=True):
        modes = [JointMode(code) for code in mode_codes]
        setpoints.append(SafeSetpoints(modes, target, limits_nm))
    controller_us = sum(whole_run.update_us) / len(whole_run.update_us)
    return setpoints, controller_us


@dataclass
class TickCpuTimes:
    """Mean CPU times of a tick in µs, one entry for each block of ticks."""

    published_us: list[float] = field(default_factory=list[float])  # with all sensors published
    own_us: list[float] = field(default_factory=list[float])  # the same without the physics
    physics_us: list[float] = field(default_factory=list[float])  # of the physics alone
    # Of the physics with the Python version of the laws.
    python_us: list[float] = field(default_factory=list[float])
    mujoco_us: list[float] = field(default_factory=list[float])  # of `mj_step` alone


def measure_tick_times(config: RunConfig) -> TickCpuTimes:
    """Measure the ticks of the same motion: published, physics alone, with the Python laws, and MuJoCo alone."""
    full = open_simulator(config)
    physics = BareSimulation(config)
    python = BareSimulation(config, "python")
    bare_mujoco = BareMujoco(config)
    setpoints, _ = record_motion(config)
    times = TickCpuTimes()
    endpoint = find_free_endpoint()  # published messages really go over the network
    with (
        open_session(ConnectionSettings(endpoint, "bench", True)) as session,
        open_session(ConnectionSettings(endpoint, "bench")) as other,
    ):
        first = full.sample(0, 0)
        readers = [
            other.declare_reader(key, type(message))
            for key, message in ((JOINTS, first.joints), *first.by_key.items())
        ]
        publisher = SamplePublisher(session)
        tick = 0
        for start in range(0, len(setpoints) - TICKS_A_BLOCK + 1, TICKS_A_BLOCK):
            block = setpoints[start : start + TICKS_A_BLOCK]
            began_s = time.thread_time()
            for tick_setpoints in block:
                tick += 1
                publisher.publish(tick, full.sample(tick, tick * config.period_ns))
                full.enact(tick_setpoints, "armed")
                full.advance()
            published_us = (time.thread_time() - began_s) / TICKS_A_BLOCK * 1e6
            physics_us = physics.measure_physics_us(block)
            times.published_us.append(published_us)
            times.physics_us.append(physics_us)
            times.own_us.append(published_us - physics_us)
            times.python_us.append(python.measure_physics_us(block))
            times.mujoco_us.append(bare_mujoco.measure_us(block))
        assert all(reader.drain() for reader in readers), "a published message did not arrive"
    full.close()
    return times


def encode_tick(config: RunConfig) -> tuple[bytes, bytes]:
    """Return the bytes of the whole state of one tick, and those of one command, as they are sent."""
    backend = open_simulator(config)
    samples = backend.sample(0, 0)
    robot = backend.describe()
    backend.close()
    limits_nm = [joint.torque_limit_nm for joint in robot.joints]
    hold_command = make_joint_command(
        robot,
        samples.joints.angle_rad,
        tick=LONG_NUMBER,
        sequence=LONG_NUMBER,
        torque_limit_nm=limits_nm,
    )
    state = encode(samples.joints) + b"".join(
        encode(message) for message in samples.by_key.values()
    )
    return state, encode(hold_command)
