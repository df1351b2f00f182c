"""A physics model of which some encoders have a dead zone, for emulated drives.

The angle of such an encoder sticks while the shaft moves by less than the dead zone, and then jumps to the shaft. The
drive controls its motor by this angle. Its velocity is that of the shaft, as from a speed observer or a second sensor.
A drive that derives its velocity from the same encoder is *not* simulated: it would shake.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.wrapped_model import WrappedModel


class StickingEncoderModel(WrappedModel):
    """Wraps another physics model. Its joint angles are those that encoders measure."""

    def __init__(
        self,
        physics_model: PhysicsModel,
        joints: Sequence[Joint],
        dead_zone_rad: Mapping[str, float],
    ) -> None:
        """Start with every encoder at the angle of its shaft, at rest.

        Args:
            physics_model: Model whose joints are measured.
            joints: Every joint, tail to head.
            dead_zone_rad: Dead zone of an encoder by joint name. Joints that are missing have none.
        """
        super().__init__(physics_model)
        sticking_joints = [i for i, joint in enumerate(joints) if joint.name in dead_zone_rad]
        self._sticking_joints = np.array(sticking_joints, dtype=np.intp)
        self._dead_zone_rad: Floats = np.array(
            [dead_zone_rad[joints[i].name] for i in sticking_joints]
        )
        self._measured_angle_rad: Floats = physics_model.angle_rad[self._sticking_joints].copy()

    def advance(self, torque_nm: Floats) -> None:
        """Advance by `step_s` under these motor torques, then read the encoders."""
        super().advance(torque_nm)
        shaft_rad = self._physics_model.angle_rad[self._sticking_joints]
        change_rad = shaft_rad - self._measured_angle_rad
        has_left_zone = np.abs(change_rad) >= self._dead_zone_rad
        self._measured_angle_rad = np.where(has_left_zone, shaft_rad, self._measured_angle_rad)

    @property
    def angle_rad(self) -> Floats:
        """Return the joint angles that the encoders measure, (n_joints,)."""
        angle_rad = self._physics_model.angle_rad.copy()
        angle_rad[self._sticking_joints] = self._measured_angle_rad
        return angle_rad
