"""From the record of a run of the controller `identify` to what each joint is. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Drive
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.features.commissioning.estimate import (
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
from snakesim_operator.features.commissioning.followed_links import find_unfollowed
from snakesim_operator.features.commissioning.hanging import load_nm

WIDEST = 0.3  # half an interval, of its value: a torque constant that is less sure is unknown
FITS = 0.8  # share of the torque that must be explained, or the robot did not hang as it is supposed to
LIGHT = "what it carries is too light to tell"
BALANCED = {  # fields that the torque balance tells -> their names
    "friction_nm": "dry friction",
    "viscous_nm_s_per_rad": "viscous friction",
    "armature_kg_m2": "rotor inertia",
}
MISFIT = "the links do not move as the encoders say, or not under the torques that they need"


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
    complete: bool = True  # every value was found that the robot file asks for

    @property
    def fits(self) -> float | None:
        """Share of the torque's variance that is explained: by the balance or the servo, the lesser."""
        if self.friction is None or self.servo is None:
            return None
        return min(self.friction.explained, self.servo.explained)

    @property
    def fails(self) -> bool:
        """Whether it does not move as the model of a hanging robot does, so that its neighbors are not sure either."""
        return self.fits is None or self.fits < FITS

    def withheld(self, why: str) -> "Identified":
        """Return the same without values: they would not be right."""
        return replace(self, fields={}, unknown=[f"everything: {why}"], complete=False)


def identified(
    config: RunConfig, columns: Mapping[str, Floats], link_rate_rad_s: Floats | None = None
) -> list[Identified]:
    """Return what every joint is, tail to head.

    Args:
        config: of the run.
        columns: `angle_rad`, `velocity_rad_s`, `torque_nm`, `target`, a row a tick.
        link_rate_rad_s: by the gyros of the links, (n, links, 3), NaN where none reported; None: there are none.
    """
    period_s = config.period_ns * 1e-9
    angle, velocity = columns["angle_rad"], columns["velocity_rad_s"]
    motions = windowed(velocity), slope(velocity, period_s)
    by_angle = slope(angle, period_s), curvature(angle, period_s)
    load, load_by_angle = (load_nm(config.robot, windowed(angle), *of) for of in (motions, by_angle))
    found: list[Identified] = []
    for i, joint in enumerate(config.robot.joint_table):
        if "torque" not in joint.drive.measures:
            found.append(Identified(joint.name, {}, ["everything: it does not measure torque"], complete=False))
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
            found.append(Identified(joint.name, {}, [f"everything: {error}"], complete=False))
    failing = {i: found[i].joint for i, joint in enumerate(config.robot.joint_table) if _fails(found[i], joint.drive)}
    if link_rate_rad_s is not None:
        unfollowed = find_unfollowed(config.robot, period_s, angle, velocity, link_rate_rad_s)
        if unfollowed is not None:
            failing[unfollowed.joint] = found[unfollowed.joint].joint
            found[unfollowed.joint] = found[unfollowed.joint].withheld(unfollowed.reason)
    return [_beside(one, i, failing) for i, one in enumerate(found)]


def _fails(one: Identified, drive: Drive) -> bool:
    """Return whether a joint was judged, and does not move as it should."""
    return "torque" in drive.measures and one.fails


def _beside(one: Identified, joint: int, failing: Mapping[int, str]) -> Identified:
    """Withhold the values of a joint next to one that fails: they were found with the motion of that one's links."""
    if joint in failing:
        return one
    beside = [failing[neighbor] for neighbor in (joint - 1, joint + 1) if neighbor in failing]
    if not beside:
        return one
    return one.withheld(f"{' and '.join(beside)} beside it fails; correct that first, and identify again")


def _joint(name: str, moved: Moved, load: Floats, load_by_angle: Floats, constant: float | None) -> Identified:
    """Identify one joint. Raises ValueError when too little moved."""
    unknown: list[str] = []
    misfit: list[str] = []  # what is unknown because the torque does not fit the motion
    complete = True
    response = servo(moved)
    balance = friction(moved, response.between_nm, load, load_by_angle, scaled=constant is not None)
    if constant is None:
        unknown.append("torque constant: the file has none, so its torque is taken as it is measured")
    elif not balance.torque_scale.within < WIDEST * balance.torque_scale.value:
        if balance.misfit > 0:
            misfit.append("torque constant")
        else:
            unknown.append(f"torque constant: {LIGHT}; its torque is taken as it is measured")
        complete = False
        constant = None
        balance = friction(moved, response.between_nm, load, load_by_angle, scaled=False)
    fields = _fields(balance, response, constant)
    for field, label in BALANCED.items():
        value = fields[field]
        # Without a misfit the interval is that of noise, and a friction near 0 may be as uncertain as it is small.
        if balance.misfit > 0 and not value.within < WIDEST * abs(value.value):
            del fields[field]
            misfit.append(label)
            complete = False
    if misfit:
        unknown.append(f"{', '.join(misfit)}: {MISFIT}")
    return Identified(
        joint=name,
        fields=fields,
        unknown=unknown,
        latency_s=response.latency_s,
        bandwidth_hz=bandwidth_hz(moved),
        friction=balance,
        servo=response,
        complete=complete,
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
