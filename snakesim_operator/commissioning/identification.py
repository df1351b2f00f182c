"""From the record of a run of the controller `identify` to what each joint is. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.commissioning.estimate import (
    Friction,
    Moved,
    Servo,
    Value,
    bandwidth_hz,
    curvature,
    friction,
    servo,
    slope,
    windowed,
)
from snakesim_operator.commissioning.hanging import load_nm

WIDEST = 0.3  # half an interval, of its value: a torque constant that is less sure is unknown


@dataclass(frozen=True)
class Identified:
    """One joint; what could not be found is not in `fields`, and `unknown` says why."""

    joint: str
    fields: dict[str, Value]  # of the robot file
    unknown: list[str]
    latency_s: Value | None = None
    bandwidth_hz: float | None = None
    friction: Friction | None = None
    servo: Servo | None = None

    @property
    def fits(self) -> float | None:
        """Share of the torque's variance that is explained: by the balance or the servo, the lesser."""
        if self.friction is None or self.servo is None:
            return None
        return min(self.friction.explained, self.servo.explained)


def identified(config: RunConfig, columns: Mapping[str, Floats]) -> list[Identified]:
    """Every joint, tail to head. columns: `angle_rad`, `velocity_rad_s`, `torque_nm`, `target`, a row a tick."""
    period_s = config.period_ns * 1e-9
    angle, velocity = columns["angle_rad"], columns["velocity_rad_s"]
    motions = windowed(velocity), slope(velocity, period_s)
    by_angle = slope(angle, period_s), curvature(angle, period_s)
    load, load_by_angle = (load_nm(config.robot, windowed(angle), *of) for of in (motions, by_angle))
    found: list[Identified] = []
    for i, joint in enumerate(config.robot.joint_table):
        if "torque" not in joint.drive.measures:
            found.append(Identified(joint.name, {}, ["everything: it does not measure torque"]))
            continue
        moved = Moved(
            period_s,
            angle[:, i],
            velocity[:, i],
            columns["torque_nm"][:, i],
            columns["target"][:, i],
            joint.limits.torque_nm,
        )
        try:
            constant = joint.motor.torque_constant_nm_per_a
            found.append(_joint(joint.name, moved, load[:, i], load_by_angle[:, i], constant))
        except ValueError as error:
            found.append(Identified(joint.name, {}, [f"everything: {error}"]))
    return found


def _joint(name: str, moved: Moved, load: Floats, load_by_angle: Floats, constant: float | None) -> Identified:
    unknown: list[str] = []
    response = servo(moved)
    balance = friction(moved, response.between_nm, load, load_by_angle, scaled=constant is not None)
    if constant is None:
        unknown.append("torque constant: the file has none, so its torque is taken as it is measured")
    elif not balance.torque_scale.within < WIDEST * balance.torque_scale.value:
        unknown.append("torque constant: what it carries is too light to tell; its torque is taken as it is measured")
        balance, constant = friction(moved, response.between_nm, load, load_by_angle, scaled=False), None
    return Identified(
        name,
        _fields(balance, response, constant),
        unknown,
        response.latency_s,
        bandwidth_hz(moved),
        balance,
        response,
    )


def _fields(balance: Friction, response: Servo, constant: float | None) -> dict[str, Value]:
    scale = balance.torque_scale
    fields = {
        "friction_nm": balance.dry_nm,
        "viscous_nm_s_per_rad": balance.viscous_nm_s_per_rad,
        "armature_kg_m2": balance.armature_kg_m2,
        "stiffness_nm_per_rad": _product(response.stiffness_nm_per_rad, scale),
        "damping_nm_s_per_rad": _product(response.damping_nm_s_per_rad, scale),
        "response_time_s": response.response_time_s,
    }
    if constant is not None:
        fields["torque_constant_nm_per_a"] = scale.scaled(constant)
    return fields


def _product(one: Value, other: Value) -> Value:
    """Of two that are estimated apart."""
    within = ((one.within * other.value) ** 2 + (one.value * other.within) ** 2) ** 0.5
    return Value(one.value * other.value, within)
