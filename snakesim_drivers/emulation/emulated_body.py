"""The body that emulated drives of any type move: shafts, supply, heat and injected faults, in SI units."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from snakesim_drivers.emulation.shaft_demand import set_shaft_demand
from snakesim_drivers.emulation.shared_physics import MAX_CATCH_UP_US, SharedPhysics
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

BOOT_US = 500_000.0  # in which a drive that restarts neither receives nor sends; a guess
UNDERVOLTAGE_V = 12.0  # of a supply that an injected fault lets fall
# That can be injected into emulated drives.
FAULTS = "mute", "reboot", "overheat", "undervoltage", "duplicate"


class ShaftState(NamedTuple):
    """What a drive measures at its shaft."""

    angle_rad: float
    velocity_rad_s: float
    torque_nm: float


class EmulatedBody:
    """The body of a robot, as the emulated drives of all or some of its joints move it.

    In all methods `i` is the index of a drive among these, from tail to head. All values are those at its shaft.
    Torques are those that the drive computes from its current. They differ from the real ones if the torque constant
    in the robot file is wrong.
    """

    def __init__(self, shared: SharedPhysics, joint_indices: Sequence[int]) -> None:
        """Select the drives of some joints. Motors are passive at first.

        Args:
            shared: Physics of the whole robot.
            joint_indices: Indices of these joints in the robot, from tail to head.
        """
        self._shared = shared
        self._joint_indices = list(joint_indices)
        self.physics_model = shared.physics_model
        self.motors = shared.motors
        self.thermal = shared.thermal
        self.lock = shared.lock
        self.joints: list[Joint] = [shared.joints[j] for j in joint_indices]

    def select(self, drives: Sequence[int]) -> "EmulatedBody":
        """Return the same body for some of these drives, which are numbered from 0 there."""
        return EmulatedBody(self._shared, [self._joint_indices[i] for i in drives])

    # --- time -------------------------------------------------------------------------------------------------

    @property
    def now_us(self) -> float:
        """The drives' own time since the emulators were started."""
        return self._shared.now_us

    def add_step_callback(self, callback: Callable[[float], None]) -> None:
        """Call a function after each step of the physics, with the drives' own time in us."""
        self._shared.step_callbacks.append(callback)

    def remove_step_callback(self, callback: Callable[[float], None]) -> None:
        """End the calls that `add_step_callback` has begun."""
        with self.lock:
            self._shared.step_callbacks.remove(callback)

    def is_late(self, clock_us: float) -> bool:
        """Return whether the process of these drives has paused for longer than they catch up with."""
        return self._shared.measure_lag_us(clock_us) > MAX_CATCH_UP_US

    def advance_to(self, clock_us: float) -> None:
        """Simulate up to a time of the clock. The caller holds `lock`."""
        self._shared.advance_to(clock_us)

    # --- motor and sensors ------------------------------------------------------------------------------------

    def drive_motor(
        self,
        i: int,
        mode: JointMode,
        target: float,
        limit_nm: float,
        stiffness: float,
        damping: float,
        speed_rad_s: float,
    ) -> None:
        """Set the setpoint, gains and limits of a drive's motor, all at the drive's shaft, until the next call.

        Args:
            i: Index of the drive, from 0 at the tail.
            mode: Control mode of the motor.
            target: Setpoint in rad, rad/s or N·m, by the mode.
            limit_nm: Torque limit.
            stiffness: Gain of position mode in N·m/rad.
            damping: Gain of position and velocity mode in N·m·s/rad.
            speed_rad_s: Speed limit.
        """
        j = self._joint_indices[i]
        set_shaft_demand(
            self.motors,
            j,
            self.joints[i].drive,
            self._shared.torque_ratios[j],
            mode=mode,
            target=target,
            torque_limit_nm=limit_nm,
            stiffness=stiffness,
            damping=damping,
            speed_limit_rad_s=speed_rad_s,
        )

    def read_shaft(self, i: int) -> ShaftState:
        """Return what a drive measures at its shaft, without noise."""
        drive = self.joints[i].drive
        ratio = drive.sign * drive.gear
        j = self._joint_indices[i]
        angle_rad = float(self.physics_model.angle_rad[j])
        velocity_rad_s = float(self.physics_model.velocity_rad_s[j])
        torque_nm = float(self.motors.torque_nm[j]) / self._shared.torque_ratios[j]
        return ShaftState(
            drive.zero_rad + ratio * angle_rad, ratio * velocity_rad_s, torque_nm / ratio
        )

    def read_joint_angle_rad(self, i: int) -> float:
        """Return the true angle of a drive's joint, however the drive is mounted."""
        return float(self.physics_model.angle_rad[self._joint_indices[i]])

    def read_supply(self, i: int) -> tuple[float, float]:
        """Return the voltage in V and the current in A of a drive's supply."""
        supply = self.joints[i].supply
        j = self._joint_indices[i]
        power_w = self.thermal.compute_power_w(
            self.motors.torque_nm, self.physics_model.velocity_rad_s
        )[j]
        voltage_v = UNDERVOLTAGE_V if j in self._shared.undervoltage_joints else supply.voltage_v
        return voltage_v, supply.idle_a + float(power_w) / voltage_v

    def read_temperatures(self, i: int) -> tuple[float, float]:
        """Return the temperatures of a drive's winding and of its electronics in °C."""
        j = self._joint_indices[i]
        return float(self.thermal.winding_temperature_c[j]), float(
            self.thermal.compute_board_temperatures_c()[j]
        )

    def is_too_hot(self, i: int) -> bool:
        """Return whether a drive's winding has reached `stop_at_c`."""
        j = self._joint_indices[i]
        return bool(self.thermal.winding_temperature_c[j] >= self.thermal.stop_at_c[j])

    # --- faults -----------------------------------------------------------------------------------------------

    def is_silent(self, i: int) -> bool:
        """Return whether a drive sends nothing now."""
        return self._joint_indices[i] in self._shared.muted or self.is_booting(i)

    def is_booting(self, i: int) -> bool:
        """Return whether a drive restarts, and neither receives nor sends."""
        return self.now_us < self._shared.boot_end_us[self._joint_indices[i]]

    def is_duplicated(self, i: int) -> bool:
        """Return whether a second drive with the id of this one is on its bus."""
        return self._joint_indices[i] in self._shared.duplicated

    def start_boot(self, i: int) -> None:
        """Start to reboot a drive, which neither receives nor sends for `BOOT_US`."""
        self._shared.boot_end_us[self._joint_indices[i]] = self.now_us + BOOT_US

    def inject(self, injection: FaultInjection, *, begins: bool) -> int | None:
        """Start or end an injected fault of a drive.

        Args:
            injection: The fault, with the number of the drive among these as its target.
            begins: True to start the fault, False to end it.

        Returns:
            Index of the drive if the fault lets it restart now; otherwise None.

        Raises:
            ConfigError: There is no such fault, or no such joint.
        """
        if injection.target_type != "joint" or injection.kind not in FAULTS:
            raise ConfigError(
                f"fault {str(injection)!r}: emulated drives know {', '.join(FAULTS)}",
                code="injection/unknown-fault",
            )
        i = injection.target_index
        if i >= len(self.joints):
            raise ConfigError(
                f"fault {str(injection)!r}: this robot has joint_1 to joint_{len(self.joints)}",
                code="injection/unknown-target",
            )
        j = self._joint_indices[i]
        match injection.kind:
            case "mute":
                _set_membership(self._shared.muted, j, is_member=begins)
            case "undervoltage":
                _set_membership(self._shared.undervoltage_joints, j, is_member=begins)
            case "duplicate":
                _set_membership(self._shared.duplicated, j, is_member=begins)
            case "overheat":
                has_end = injection.end_s != math.inf
                self.thermal.inject_heat(j, heat=begins, hold=begins and has_end)
            case _:  # "reboot", which ends by itself
                if begins:
                    self.start_boot(i)
                    return i
        return None


def _set_membership(members: set[int], j: int, *, is_member: bool) -> None:
    if is_member:
        members.add(j)
    else:
        members.discard(j)
