"""What all emulated drives of a robot share: physics model, motors, heat and camera, on one clock that is passed in."""

import math
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import msgspec

from snakesim_drivers.emulation.mounted import (
    MountedDrive,
    build_actual_config,
    build_actual_joints,
    compute_torque_ratios,
)
from snakesim_drivers.motion_capture.emulated_mocap import PoseCamera
from snakesim_hal.model.plugins import (
    PHYSICS_MODELS,
    decode_plugin_settings,
    load_plugin,
    require_base_class,
)
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.loose_gear import (
    LooseGearModel,
    Looseness,
    move_rotor_inertia_to_motor_side,
)
from snakesim_hal.physics.motors import PowerStages
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.sticking_encoder import StickingEncoderModel
from snakesim_hal.physics.thermal import ThermalModel

# Physics steps from one step of the windings' heat to the next: they heat up slowly.
THERMAL_DECIMATION = 10
MAX_CATCH_UP_US = 200_000.0  # after a longer delay of this process the drives skip the rest of it
# A step is simulated as soon as all of it but so much has passed: clocks are rounded.
STEP_COUNT_TOLERANCE = 0.49
# A pose is captured so long before it is due at the earliest: clocks are rounded.
POSE_TIME_TOLERANCE_US = 1.0


class PhysicsSettings(Protocol):
    """The settings of a backend that concern the physics of its emulated drives."""

    @property
    def physics_model(self) -> str:
        """Name of the physics model: an entry point in the group `snakesim.physics_models`."""
        ...

    @property
    def physics_model_settings(self) -> dict[str, Any]:
        """Settings of the physics model, as the scenario has them."""
        ...

    @property
    def mounted(self) -> Mapping[str, MountedDrive]:
        """How drives are mounted in truth, where that differs from the robot file; by the joint's name."""
        ...


def make_physics_model(config: RunConfig, settings: PhysicsSettings, backend: str) -> PhysicsModel:
    """Create the physics model of the robot that emulated drives move, as the robot is really built.

    The settings `mounted` name errors of assembly, such as a wrong sign or backlash, that the controller does not know.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        settings: Settings of the backend, which name the physics model.
        backend: Name of the backend, used in error messages.

    Returns:
        The model, with the loose gears and the dead zones of encoders that the settings name.

    Raises:
        ConfigError: There is no such physics model, or it does not accept its settings.
    """
    model_type = load_plugin(PHYSICS_MODELS, settings.physics_model)
    label = f"physics_model {settings.physics_model!r}"
    require_base_class(model_type, PhysicsModel, label)
    section = f"backends.{backend}.physics_model_settings"
    model_settings = decode_plugin_settings(
        model_type, settings.physics_model_settings, label, section
    )
    # As really built, unlike what the controller assumes.
    actual_config = build_actual_config(config, settings.mounted)
    joints = build_actual_joints(config.robot, settings.mounted)
    looseness = _collect_loose_gears(settings.mounted)
    if looseness:
        links_config = move_rotor_inertia_to_motor_side(actual_config, joints, looseness)
        links_model = model_type(links_config, model_settings)
        model: PhysicsModel = LooseGearModel(links_model, joints, looseness, config.seed)
    else:
        model = model_type(actual_config, model_settings)
    dead_zone_rad = {
        name: mounted.encoder_dead_zone_rad
        for name, mounted in settings.mounted.items()
        if mounted.encoder_dead_zone_rad
    }
    if dead_zone_rad:
        return StickingEncoderModel(model, joints, dead_zone_rad)
    return model


def _collect_loose_gears(mounted: Mapping[str, MountedDrive]) -> dict[str, Looseness]:
    """Return how loose each gear with backlash or a slipping coupling is, by the name of its joint."""
    looseness: dict[str, Looseness] = {}
    for name, drive in mounted.items():
        backlash_rad = drive.backlash_rad or 0.0
        slip_torque_nm = math.inf if drive.coupling_slip_nm is None else drive.coupling_slip_nm
        if backlash_rad > 0.0 or slip_torque_nm < math.inf:
            looseness[name] = Looseness(backlash_rad=backlash_rad, slip_torque_nm=slip_torque_nm)
    return looseness


class SharedPhysics:
    """The physics of a robot, with the injected faults of its emulated drives. Indices are those of the robot."""

    def __init__(
        self,
        config: RunConfig,
        physics_model: PhysicsModel,
        mounted: Mapping[str, MountedDrive],
        send_pose: Callable[[bytes], None] | None,
    ) -> None:
        """Create the physics at time 0, with all motors passive.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            physics_model: Physics model that the motors move.
            mounted: Differences between the real mounting of drives and the robot file, by the name of the joint.
            send_pose: Function that sends a datagram of motion capture, in every control period; None if there is no
                motion capture.
        """
        # Physics.
        self.physics_model = physics_model
        self.joints = build_actual_joints(config.robot, mounted)
        self.motors = PowerStages(build_actual_config(config, mounted).robot, physics_model.step_s)
        # Real torque of each drive divided by the torque that it computes from its current.
        self.torque_ratios = compute_torque_ratios(config.robot, mounted)
        self.thermal = ThermalModel(self.joints)

        # Time.
        self.now_us = 0.0  # since the start
        self.step_callbacks: list[Callable[[float], None]] = []
        self._step_us = physics_model.step_s * 1e6
        self._step_count = 0
        self._skipped_us = 0.0  # by which the clock is ahead of the physics

        # Injected faults.
        self.boot_end_us = [0.0] * len(self.joints)
        self.muted: set[int] = set()
        self.undervoltage_joints: set[int] = set()
        self.duplicated: set[int] = set()

        # Held by emulators while they act, because those of several buses may be in threads.
        self.lock = threading.RLock()

        # Motion capture.
        self._send_pose_datagram = send_pose
        self._period_us = config.period_ns / 1000
        self._next_pose_us = 0.0
        self._camera: PoseCamera | None = None
        pose_sensor = config.robot.sensors.pose
        if pose_sensor is not None and send_pose is not None:
            seed = (config.seed, len(self.joints))
            self._camera = PoseCamera(pose_sensor, physics_model, seed, config.period_ns)

    def measure_lag_us(self, clock_us: float) -> float:
        """Return how far the physics is behind the clock."""
        return clock_us - self._skipped_us - self.now_us

    def advance_to(self, clock_us: float) -> None:
        """Simulate up to a time of the clock, and capture a pose if one is due.

        After a long delay of this process, a part of the delay is skipped.

        Args:
            clock_us: Time since the emulators were started.
        """
        if self.measure_lag_us(clock_us) > MAX_CATCH_UP_US:
            self._skipped_us = clock_us - self.now_us - MAX_CATCH_UP_US
        until_us = clock_us - self._skipped_us
        due_step_count = round(until_us / self._step_us - STEP_COUNT_TOLERANCE)
        for _ in range(due_step_count - self._step_count):
            self._step()
        self._capture_pose()

    def _step(self) -> None:
        """Advance motors, physics model and temperatures by one step, and call all step callbacks."""
        model = self.physics_model
        model.advance(self.motors.compute_torques(model.angle_rad, model.velocity_rad_s))
        self._step_count += 1
        self.now_us = self._step_count * self._step_us
        if self._step_count % THERMAL_DECIMATION == 0:
            self._update_motor_temperatures()
        for callback in self.step_callbacks:
            callback(self.now_us)

    def _update_motor_temperatures(self) -> None:
        """Heat the windings by the losses of the last steps, and derate hot motors."""
        duration_s = THERMAL_DECIMATION * self.physics_model.step_s
        self.thermal.advance_temperatures(duration_s, self.motors.pop_mean_square_torque())
        remaining_fraction = self.thermal.compute_remaining_fractions()
        if remaining_fraction is not None:
            self.motors.apply_derating(remaining_fraction)

    def _capture_pose(self) -> None:
        """Capture and send a pose if one is due."""
        if self._camera is None or self._send_pose_datagram is None:
            return
        if self.now_us < self._next_pose_us - POSE_TIME_TOLERANCE_US:
            return
        self._next_pose_us += self._period_us
        sample = self._camera.capture(round(self.now_us * 1000))
        if sample is not None:
            self._send_pose_datagram(msgspec.json.encode(sample))
