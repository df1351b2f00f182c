"""What emulated drives of any family move: a plant under their motors, with heat, on one clock. Time is passed in."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from snakesim_hal.drivers.mocap_twin import PoseCamera
from snakesim_hal.drivers.mounted import Mounted, as_built, built
from snakesim_hal.drivers.mounting import joint_target
from snakesim_hal.errors import ConfigError
from snakesim_hal.injection import Injection
from snakesim_hal.model.plugins import PLANTS, find_plugin, plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.motors import Motors
from snakesim_hal.physics.plant import Plant
from snakesim_hal.physics.thermal import Thermal
from snakesim_hal.wire.messages import Mode

HEAT_EVERY = 10  # steps
MAX_AT_ONCE_US = 200_000.0  # after a longer delay of this process the drives skip the rest of it
BOOT_US = 500_000.0  # in which a drive that restarts says nothing; a guess
WEAK_V = 12.0  # of a supply that an injected fault lets fall
FAULTS = ("mute", "reboot", "overheat", "undervoltage")  # that can be injected into emulated drives


def make_plant(config: RunConfig, backend: str, name: str, settings: dict[str, Any]) -> Plant:
    """The plant that a backend's settings name. Raises ConfigError."""
    factory: Any = find_plugin(PLANTS, name)
    where = f"backends.{backend}.plant_settings"
    return factory(config, plugin_settings(factory, settings, f"plant {name!r}", where))


class TwinBody:
    """The body, and the motors in it. Drives are numbered as joints, tail to head; all are idle at first."""

    def __init__(
        self,
        config: RunConfig,
        plant: Plant,
        mounted: Mapping[str, Mounted],
        send_pose: Callable[[bytes], None] | None = None,
    ) -> None:
        """mounted: what is in truth not as the file says; send_pose: gets datagrams of motion capture, one a period."""
        self.plant, self.joints = plant, built(config.robot, mounted)
        self.motors, self.thermal = Motors(as_built(config, mounted).robot, plant.step_s), Thermal(self.joints)
        self.now_us = 0.0  # since the twins were started
        self._boots_until_us = [0.0] * len(self.joints)
        self._muted: set[int] = set()
        self._weak: set[int] = set()
        self._step_us, self._steps, self._skipped_us = plant.step_s * 1e6, 0, 0.0
        self._send_pose, self._period_us, self._pose_us = send_pose, config.period_ns / 1000, 0.0
        camera = config.robot.sensors.pose
        self._camera = None
        if camera is not None and send_pose is not None:
            self._camera = PoseCamera(camera, plant, (config.seed, len(self.joints)), config.period_ns)

    def advance_to(self, clock_us: float, each_step: Callable[[float], None]) -> None:
        """Physics until then. each_step: the drives' own time, in us: watchdogs, and messages that are due."""
        if clock_us - self._skipped_us - self.now_us > MAX_AT_ONCE_US:
            self._skipped_us = clock_us - self.now_us - MAX_AT_ONCE_US
        until_us = clock_us - self._skipped_us
        plant, motors = self.plant, self.motors
        for _ in range(round(until_us / self._step_us - 0.49) - self._steps):
            plant.advance(motors.step(plant.angle_rad, plant.velocity_rad_s))
            self._steps += 1
            self.now_us = self._steps * self._step_us
            if self._steps % HEAT_EVERY == 0:
                self._warm()
            each_step(self.now_us)
        if self._camera is not None and self._send_pose is not None and self.now_us >= self._pose_us - 1:
            self._pose_us += self._period_us
            if (sample := self._camera.look(round(self.now_us * 1000))) is not None:
                self._send_pose(msgspec.json.encode(sample))

    def drive(
        self, i: int, mode: Mode, target: float, limit_nm: float, stiffness: float, damping: float, speed_rad_s: float
    ) -> None:
        """What a drive demands of its motor; all numbers at its shaft, in SI units."""
        drive = self.joints[i].drive
        gear = drive.gear
        target = joint_target(drive, mode, target)
        self.motors.drive(i, mode, target, limit_nm * gear, stiffness * gear**2, damping * gear**2, speed_rad_s / gear)

    def shaft(self, i: int) -> tuple[float, float, float]:
        """Angle, velocity and torque of a drive's shaft."""
        drive = self.joints[i].drive
        turns = drive.sign * drive.gear
        angle_rad, velocity_rad_s = float(self.plant.angle_rad[i]), float(self.plant.velocity_rad_s[i])
        return drive.zero_rad + turns * angle_rad, turns * velocity_rad_s, float(self.motors.torque_nm[i]) / turns

    def supply(self, i: int) -> tuple[float, float]:
        """Voltage and current of a drive."""
        supply = self.joints[i].supply
        power_w = self.thermal.power_w(self.motors.torque_nm, self.plant.velocity_rad_s)[i]
        voltage_v = WEAK_V if i in self._weak else supply.voltage_v
        return voltage_v, supply.idle_a + float(power_w) / voltage_v

    def too_hot(self, i: int) -> bool:
        """Whether a drive's winding is at `stop_at_c`."""
        return bool(self.thermal.winding_c[i] >= self.thermal.stop_at_c[i])

    # --- faults ----------------------------------------------------------------------------------------------

    def silent(self, i: int) -> bool:
        """Whether a drive says nothing now."""
        return i in self._muted or self.now_us < self._boots_until_us[i]

    def deaf(self, i: int) -> bool:
        """Whether a drive hears nothing now: it boots."""
        return self.now_us < self._boots_until_us[i]

    def inject(self, injection: Injection, *, begins: bool) -> int | None:
        """Begin or end a fault of a drive: its number if it restarts now. Raises ConfigError."""
        if injection.target_type != "joint" or injection.kind not in FAULTS:
            raise ConfigError(f"fault {str(injection)!r}: emulated drives know {', '.join(FAULTS)}")
        i = injection.number
        if i >= len(self.joints):
            raise ConfigError(f"fault {str(injection)!r}: this robot has joint_1 to joint_{len(self.joints)}")
        match injection.kind:
            case "mute":
                (self._muted.add if begins else self._muted.discard)(i)
            case "undervoltage":
                (self._weak.add if begins else self._weak.discard)(i)
            case "overheat":
                self.thermal.inject(i, heat=begins, hold=begins and injection.end_s != math.inf)
            case _:
                if begins:
                    self.boot(i)
                    return i
        return None

    def boot(self, i: int) -> None:
        """A drive restarts now; until it has, it neither hears nor says anything."""
        self._boots_until_us[i] = self.now_us + BOOT_US

    def temperatures(self, i: int) -> tuple[float, float]:
        """Of a drive's winding, and of its electronics."""
        return float(self.thermal.winding_c[i]), float(self.thermal.board_c()[i])

    def _warm(self) -> None:
        self.thermal.pass_time(HEAT_EVERY * self.plant.step_s, self.motors.take_heat())
        if (share_left := self.thermal.share_left()) is not None:
            self.motors.derate(share_left)
