"""The body that emulated drives of any type move: a physics model, motors and heat on one clock that is passed in."""

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from snakesim_drivers.emulation.mounted import Mounted, build_config, build_joints
from snakesim_drivers.motion_capture.emulated_mocap import PoseCamera
from snakesim_drivers.mounting import joint_target
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import on_stop_signal, tune_garbage_collector
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.plugins import PHYSICS_MODELS, find_plugin, plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.backlash import BacklashModel, without_rotors
from snakesim_hal.physics.motors import Motors
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.thermal import Thermal
from snakesim_hal.wire.messages import Mode

HEAT_EVERY = 10  # steps
MAX_AT_ONCE_US = 200_000.0  # after a longer delay of this process the drives skip the rest of it
BOOT_US = 500_000.0  # in which a drive that restarts says nothing; a guess
WEAK_V = 12.0  # of a supply that an injected fault lets fall
POLL_S = 0.001  # of drives in a process of their own
FAULTS = ("mute", "reboot", "overheat", "undervoltage", "duplicate")  # that can be injected into emulated drives


def make_physics_model(config: RunConfig, settings: Any, backend: str) -> PhysicsModel:
    """The physics model that a backend's settings name, moved by motors as they are in truth. Raises ConfigError."""
    factory: Any = find_plugin(PHYSICS_MODELS, settings.physics_model)
    source, where = f"physics_model {settings.physics_model!r}", f"backends.{backend}.physics_model_settings"
    own = plugin_settings(factory, settings.physics_model_settings, source, where)
    truth = build_config(config, settings.mounted)
    backlash_rad = {name: one.backlash_rad for name, one in settings.mounted.items() if one.backlash_rad}
    if not backlash_rad:
        return factory(truth, own)
    joints = build_joints(config.robot, settings.mounted)
    physics_model = factory(without_rotors(truth, joints, backlash_rad), own)
    return BacklashModel(physics_model, joints, backlash_rad, config.seed)


def serve_until_stopped(ready: str, emulator: Callable[[], object], wait: Callable[[float], object]) -> None:
    """Emulated drives in a process of their own, until a stop signal. wait: for frames or bytes, at most so long."""
    running = [True]
    on_stop_signal(running.clear)
    tune_garbage_collector()
    print_line(ready)
    while running:
        emulator()
        wait(POLL_S)


class SharedPhysics:
    """PhysicsModel, motors, heat and camera, on one clock: what all emulated drives of a robot share."""

    def __init__(
        self,
        config: RunConfig,
        physics_model: PhysicsModel,
        mounted: Mapping[str, Mounted],
        send_pose: Callable[[bytes], None] | None,
    ) -> None:
        """mounted: what is in truth not as the file says; send_pose: gets datagrams of motion capture, one a period."""
        self.physics_model, self.joints = physics_model, build_joints(config.robot, mounted)
        self.motors, self.thermal = (
            Motors(build_config(config, mounted).robot, physics_model.step_s),
            Thermal(self.joints),
        )
        self.now_us, self.each_step = 0.0, list[Callable[[float], None]]()
        self.boots_until_us = [0.0] * len(self.joints)
        self.muted: set[int] = set()
        self.weak: set[int] = set()
        self.doubled: set[int] = set()
        self.lock = threading.RLock()
        self._step_us, self._steps, self._skipped_us = physics_model.step_s * 1e6, 0, 0.0
        self._send_pose, self._period_us, self._pose_us = send_pose, config.period_ns / 1000, 0.0
        camera = config.robot.sensors.pose
        self._camera = None
        if camera is not None and send_pose is not None:
            self._camera = PoseCamera(camera, physics_model, (config.seed, len(self.joints)), config.period_ns)

    def lag_us(self, clock_us: float) -> float:
        """How far the physics is behind the clock."""
        return clock_us - self._skipped_us - self.now_us

    def advance_to(self, clock_us: float) -> None:
        """Physics until then."""
        if self.lag_us(clock_us) > MAX_AT_ONCE_US:
            self._skipped_us = clock_us - self.now_us - MAX_AT_ONCE_US
        until_us = clock_us - self._skipped_us
        physics_model, motors = self.physics_model, self.motors
        for _ in range(round(until_us / self._step_us - 0.49) - self._steps):
            physics_model.advance(motors.step(physics_model.angle_rad, physics_model.velocity_rad_s))
            self._steps += 1
            self.now_us = self._steps * self._step_us
            if self._steps % HEAT_EVERY == 0:
                self._warm()
            for each in self.each_step:
                each(self.now_us)
        if self._camera is not None and self._send_pose is not None and self.now_us >= self._pose_us - 1:
            self._pose_us += self._period_us
            if (sample := self._camera.capture(round(self.now_us * 1000))) is not None:
                self._send_pose(msgspec.json.encode(sample))

    def _warm(self) -> None:
        self.thermal.pass_time(HEAT_EVERY * self.physics_model.step_s, self.motors.pop_mean_square_torque())
        if (remaining_fraction := self.thermal.remaining_fraction()) is not None:
            self.motors.derate(remaining_fraction)


class EmulatedBody:
    """The body, and motors in it: all, or those of one driver type. Drives are numbered tail to head; idle at first."""

    def __init__(self, motion: SharedPhysics, at: Sequence[int]) -> None:
        """at: the numbers that these drives have in the robot."""
        self._all, self._at = motion, list(at)
        self.physics_model, self.motors, self.thermal, self.lock = (
            motion.physics_model,
            motion.motors,
            motion.thermal,
            motion.lock,
        )
        self.joints = [motion.joints[j] for j in at]

    def select(self, which: Sequence[int]) -> "EmulatedBody":
        """The same body for emulators that are some of its drives, which they number from 0."""
        return EmulatedBody(self._all, [self._at[i] for i in which])

    @property
    def now_us(self) -> float:
        """Since the emulators were started."""
        return self._all.now_us

    def add_step_callback(self, act: Callable[[float], None]) -> None:
        """From now on called with the drives' own time, in us, at each step: watchdogs, and messages that are due."""
        self._all.each_step.append(act)

    def remove_step_callback(self, act: Callable[[float], None]) -> None:
        """No longer."""
        with self.lock:
            self._all.each_step.remove(act)

    def is_late(self, clock_us: float) -> bool:
        """Whether the process of these drives has paused for longer than they catch up with."""
        return self._all.lag_us(clock_us) > MAX_AT_ONCE_US

    def advance_to(self, clock_us: float) -> None:
        """Physics until then. Emulators of several buses hold the `lock` while they act, as those may be in threads."""
        self._all.advance_to(clock_us)

    def drive_motor(
        self, i: int, mode: Mode, target: float, limit_nm: float, stiffness: float, damping: float, speed_rad_s: float
    ) -> None:
        """What a drive demands of its motor; all numbers at its shaft, in SI units."""
        drive = self.joints[i].drive
        gear = drive.gear
        target = joint_target(drive, mode, target)
        kp, kd, speed_rad_s = stiffness * gear**2, damping * gear**2, speed_rad_s / gear
        self.motors.set_demand(self._at[i], mode, target, limit_nm * gear, kp, kd, speed_rad_s)

    def read_shaft(self, i: int) -> tuple[float, float, float]:
        """Angle, velocity and torque of a drive's shaft."""
        drive = self.joints[i].drive
        turns, j = drive.sign * drive.gear, self._at[i]
        angle_rad, velocity_rad_s = float(self.physics_model.angle_rad[j]), float(self.physics_model.velocity_rad_s[j])
        return drive.zero_rad + turns * angle_rad, turns * velocity_rad_s, float(self.motors.torque_nm[j]) / turns

    def read_supply(self, i: int) -> tuple[float, float]:
        """Voltage and current of a drive."""
        supply, j = self.joints[i].supply, self._at[i]
        power_w = self.thermal.power_w(self.motors.torque_nm, self.physics_model.velocity_rad_s)[j]
        voltage_v = WEAK_V if j in self._all.weak else supply.voltage_v
        return voltage_v, supply.idle_a + float(power_w) / voltage_v

    def is_too_hot(self, i: int) -> bool:
        """Whether a drive's winding is at `stop_at_c`."""
        j = self._at[i]
        return bool(self.thermal.winding_c[j] >= self.thermal.stop_at_c[j])

    # --- faults ----------------------------------------------------------------------------------------------

    def is_silent(self, i: int) -> bool:
        """Whether a drive says nothing now."""
        return self._at[i] in self._all.muted or self.is_booting(i)

    def is_booting(self, i: int) -> bool:
        """Whether a drive hears nothing now: it boots."""
        return self.now_us < self._all.boots_until_us[self._at[i]]

    def is_doubled(self, i: int) -> bool:
        """Whether a second drive with the id of this one is on its bus."""
        return self._at[i] in self._all.doubled

    def inject(self, injection: Injection, *, begins: bool) -> int | None:
        """Begin or end a fault of a drive: its number if it restarts now. Raises ConfigError."""
        if injection.target_type != "joint" or injection.kind not in FAULTS:
            raise ConfigError(
                f"fault {str(injection)!r}: emulated drives know {', '.join(FAULTS)}", code="injection/unknown-fault"
            )
        i = injection.number
        if i >= len(self.joints):
            raise ConfigError(
                f"fault {str(injection)!r}: this robot has joint_1 to joint_{len(self.joints)}",
                code="injection/unknown-target",
            )
        motion, j = self._all, self._at[i]
        match injection.kind:
            case "mute":
                (motion.muted.add if begins else motion.muted.discard)(j)
            case "undervoltage":
                (motion.weak.add if begins else motion.weak.discard)(j)
            case "duplicate":
                (motion.doubled.add if begins else motion.doubled.discard)(j)
            case "overheat":
                self.thermal.inject(j, heat=begins, hold=begins and injection.end_s != math.inf)
            case _:
                if begins:
                    self.start_boot(i)
                    return i
        return None

    def start_boot(self, i: int) -> None:
        """A drive restarts now; until it has, it neither hears nor says anything."""
        self._all.boots_until_us[self._at[i]] = self.now_us + BOOT_US

    def read_temperatures(self, i: int) -> tuple[float, float]:
        """Of a drive's winding, and of its electronics."""
        j = self._at[i]
        return float(self.thermal.winding_c[j]), float(self.thermal.board_c()[j])


class DriveEmulator(ABC):
    """Emulated drives of one type on their body. A type implements the abstract methods; i: a drive, tail to head."""

    def __init__(self, body: EmulatedBody, ends: Sequence[Any], clock_ns: Callable[[], int]) -> None:
        """ends: of every joint's bus, which this one closes; clock_ns: the time, since anything."""
        self.body, self._clock_ns, self._start_ns = body, clock_ns, clock_ns()
        self._ends: list[Any] = list({id(end): end for end in ends}.values())  # each once
        body.add_step_callback(self.on_step)

    @abstractmethod
    def restart(self, i: int) -> None:
        """A drive begins anew."""

    @abstractmethod
    def on_step(self, now_us: float) -> None:
        """Time has passed: watchdogs, heat, reports that are due."""

    def catch_up(self) -> None:
        """After a pause of this process, let time pass before anything that was sent since then is heard.

        Real drives do not pause with the computer: their watchdogs expire.
        """
        clock_us = self._clock_us()
        if self.body.is_late(clock_us):
            self.body.advance_to(clock_us)

    def pass_time(self) -> None:
        """Let time pass up to now."""
        self.body.advance_to(self._clock_us())

    def _clock_us(self) -> float:
        return (self._clock_ns() - self._start_ns) / 1000

    def inject(self, injection: Injection, *, begins: bool) -> None:
        """Begin or end a fault of a drive."""
        with self.body.lock:
            restarts = self.body.inject(injection, begins=begins)
            if restarts is not None:
                self.restart(restarts)

    def close(self) -> None:
        """Leave the buses."""
        self.body.remove_step_callback(self.on_step)
        for end in self._ends:
            end.close()
