"""The setpoints that a controller requests."""

from dataclasses import dataclass

from snakesim_hal.wire.messages import JointMode


@dataclass(frozen=True)
class RequestedSetpoints:
    """Setpoints of all joints, tail to head, as a controller or a client requests them, before any limit is applied.

    A backend never receives them. The HAL host's limiter turns them into `snakesim_hal.backend.SafeSetpoints`.
    """

    mode: list[JointMode]  # of each joint
    target: list[float]  # rad, rad/s or N·m, depending on the mode
    torque_limit_nm: list[float]  # maximum torque of each joint's motor, at least 0
