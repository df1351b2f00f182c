"""The simulator in this process: with everything published, its physics alone, and MuJoCo alone."""

import time
from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.model.plugins import plugin_settings
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_hal.network.session import Link, Publisher, Session, open_session
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.keys import CLOCK, JOINTS
from snakesim_hal.wire.messages import JointCommand, Mode
from snakesim_sim_backend.backend import SimBackend
from snakesim_testing.hal.small_robots import clock, command
from snakesim_testing.harness.endpoint import free_endpoint
from snakesim_testing.runs.whole_run import run as run_in_process

TICKS_A_BLOCK = 50


def config_of(*sets: str) -> RunConfig:
    """The scenario that is measured, with `--set` texts."""
    return load("triplet", [parse_set(text) for text in sets]).config


def open_simulator(config: RunConfig) -> SimBackend:
    """As the host opens it."""
    settings = plugin_settings(SimBackend, config.backends.get("sim", {}), "benchmarks", "backends.sim")
    return SimBackend(config, settings)


class Publishing:
    """What the host does with samples, and nothing else."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Publisher[JointCommand]] = {}

    def put(self, tick: int, samples: Samples) -> None:
        """Publish every sample and the clock."""
        now = clock(tick, arm_session=1, clock_mode="free", newest=dict.fromkeys(samples.others, tick))
        for key, message in ((JOINTS, samples.joints), *samples.others.items(), (CLOCK, now)):
            if key not in self._publishers:
                self._publishers[key] = self._session.publisher(key, type(message))  # pyright: ignore
            self._publishers[key].put(message)  # pyright: ignore


class BareLoop:
    """The same motion on the same model, computed by the physics alone."""

    def __init__(self, config: RunConfig) -> None:
        self._backend = open_simulator(config)

    def tick_us(self, points: Sequence[SafeSetpoints]) -> float:
        """Mean time of a control period over these setpoints; handing them over is not counted."""
        physics, steps = self._backend.physics, self._backend.sim.steps_per_tick
        spent = 0.0
        for now in points:
            self._backend.enact(now, "armed")
            begin = time.perf_counter()
            physics.step(steps)
            spent += time.perf_counter() - begin
        return spent / len(points) * 1e6

    def mujoco_us(self, points: Sequence[SafeSetpoints]) -> float:
        """The same for `mj_step`, from the states of that motion: without ground and friction, which are ours."""
        model, data, steps = self._backend.sim.model, self._backend.data, self._backend.sim.steps_per_tick
        whole = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(model, whole))
        spent = 0.0
        for now in points:
            self._backend.enact(now, "armed")
            mujoco.mj_getState(model, data, state, whole)
            begin = time.perf_counter()
            for _ in range(steps):
                mujoco.mj_step(model, data)
            spent += time.perf_counter() - begin
            mujoco.mj_setState(model, data, state, whole)
            self._backend.physics.step(steps)
        return spent / len(points) * 1e6


def motion(config: RunConfig) -> tuple[list[SafeSetpoints], float]:
    """Every setpoint of a run of the scenario, and the mean µs of the controller alone; all in this process."""
    whole = run_in_process(config)
    limits = [joint.torque_limit_nm for joint in whole.record.description.joints]
    points = [
        SafeSetpoints([Mode(code) for code in mode], target, limits)
        for mode, target in zip(whole.record.mode.tolist(), whole.record.target.tolist(), strict=True)
    ]
    return points, sum(whole.update_us) / len(whole.update_us)


def sensing(config: RunConfig) -> tuple[list[float], list[float], list[float]]:
    """Per block, the time of a tick (in µs) with all sensors published, of its physics alone, and of MuJoCo alone."""
    full, physics, beneath = open_simulator(config), BareLoop(config), BareLoop(config)
    points, _ = motion(config)
    published: list[float] = []
    alone: list[float] = []
    mujoco_alone: list[float] = []
    endpoint = free_endpoint()  # what is published really goes over the wire
    with open_session(Link(endpoint, "bench", True)) as session, open_session(Link(endpoint, "bench")) as other:
        first = full.sample(0, 0)
        readers = [other.reader(key, type(message)) for key, message in ((JOINTS, first.joints), *first.others.items())]
        publishing = Publishing(session)
        tick = 0
        for start in range(0, len(points) - TICKS_A_BLOCK + 1, TICKS_A_BLOCK):
            block = points[start : start + TICKS_A_BLOCK]
            begin = time.perf_counter()
            for now in block:
                tick += 1
                publishing.put(tick, full.sample(tick, tick * config.period_ns))
                full.enact(now, "armed")
                full.advance()
            published.append((time.perf_counter() - begin) / TICKS_A_BLOCK * 1e6)
            alone.append(physics.tick_us(block))
            mujoco_alone.append(beneath.mujoco_us(block))
        assert all(reader.drain() for reader in readers), "nobody heard what was published"
    full.close()
    return published, alone, mujoco_alone


def wire_bytes(config: RunConfig) -> tuple[bytes, bytes]:
    """All state of one tick, and one command, as they stand on the wire."""
    backend = open_simulator(config)
    samples, robot = backend.sample(0, 0), backend.describe()
    backend.close()
    limits_nm = [joint.torque_limit_nm for joint in robot.joints]
    held = command(robot, samples.joints.angle_rad, tick=10**6, sequence=10**6, torque_limit_nm=limits_nm)
    state = encode(samples.joints) + b"".join(encode(message) for message in samples.others.values())
    return state, encode(held)
