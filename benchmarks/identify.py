"""`python -m benchmarks.identify`: `snakesim identify` on emulated drives whose parameters it does not know.

Every trial is a robot of its own, by its number: friction, rotor inertia, response time, torque constant and latency of
each joint are drawn within 30 % of what the file says. The emulated motors and their body are those behind every
backend; noise is the robot file's. Bus and host are left out, so that a hundred trials take minutes.

Then the drives do another motion, and so do simulated ones with the file's and with the found parameters: how far these
are from the drives, in the mean square of angle, speed and torque.
"""

import argparse
import contextlib
import random
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.identify import Identify
from snakesim_hal.arrays import Floats
from snakesim_hal.drivers.mounted import Mounted, as_built
from snakesim_hal.drivers.twin_body import make_plant, twin_body
from snakesim_hal.model.robot import describe
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_hal.wire.messages import JointState, Mode
from snakesim_operator.commissioning.estimate import Value
from snakesim_operator.commissioning.identification import identified

DRAWN = 0.3  # to either side of the file's
LATENCY_S = 0.01
ROBOT = (
    "robot.chain.modules=5",
    "robot.motor.friction_nm=0.15",
    "robot.motor.viscous_nm_s_per_rad=0.1",
    "robot.motor.torque_constant_nm_per_a=0.5",
)
FIELDS = ("friction_nm", "viscous_nm_s_per_rad", "armature_kg_m2", "response_time_s", "torque_constant_nm_per_a")
SIGNALS = ("angle_rad", "velocity_rad_s", "torque_nm")
ANOTHER = (
    "control.swing_rad=0.15",
    "control.swing_s=1.3",
    "control.shake_rad=0.08",
    "control.shake_to_hz=4.0",
    "control.shake_after_s=1.0",
    "duration_s=8",
)
QUIET = tuple(
    f"robot.sensors.joints.{noise}=0" for noise in ("angle_noise_rad", "velocity_noise_rad_s", "torque_noise_nm")
)
GAINS = ("stiffness_nm_per_rad", "damping_nm_s_per_rad")  # of the servo, as its maker says: not drawn


def recorded(config: RunConfig, truth: Mapping[str, Mounted], latency_s: Mapping[str, float]) -> dict[str, Floats]:
    """The columns of a record: the controller on emulated drives. Latencies are whole steps of the plant."""
    plant = make_plant(as_built(config, truth), "can", "mujoco", config.backends["can"]["plant_settings"])
    body, joints = twin_body(config, plant, truth), config.robot.joint_table
    robot = describe(config.robot, backend="twin", period_ns=config.period_ns, lease_ns=config.lease_ns, config_hash="")
    controller = Identify(robot, msgspec.convert(config.control_settings, Identify.Settings))
    noise, sensor = np.random.default_rng(config.seed).standard_normal, config.robot.sensors.joints
    sigma = np.array([sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm])
    period_s, count = config.period_ns * 1e-9, len(joints)
    told = [
        joint.motor.torque_constant_nm_per_a / real.motor.torque_constant_nm_per_a  # of what its current says
        if joint.motor.torque_constant_nm_per_a and real.motor.torque_constant_nm_per_a
        else 1.0
        for joint, real in zip(joints, body.joints, strict=True)
    ]
    steps = round(period_s / plant.step_s)
    late = [round(latency_s[joint.name] / plant.step_s) for joint in joints]
    waiting: dict[int, list[tuple[int, float]]] = defaultdict(list)  # step -> joint and target
    rows: dict[str, list[Any]] = {name: [] for name in ("angle_rad", "velocity_rad_s", "torque_nm", "target")}
    for tick in range(round(config.duration_s * config.rate_hz)):
        state = np.stack((plant.angle_rad, plant.velocity_rad_s, body.motors.torque_nm * told))
        state += sigma[:, None] * noise(state.shape)
        angle, velocity, torque = state.tolist()
        joint_state = JointState(
            tick=tick,
            stamp_ns=tick * config.period_ns,
            angle_rad=angle,
            velocity_rad_s=velocity,
            torque_nm=torque,
            valid=[True] * count,
            age_ns=[0] * count,
        )
        view = View(tick, tick * period_s, period_s, joint_state, None, None)
        target = controller.update(view).set_points.target
        for name, values in zip(rows, (angle, velocity, torque, list(target)), strict=True):
            rows[name].append(values)
        for i in range(count):
            waiting[tick * steps + late[i]].append((i, target[i]))
        for step in range(tick * steps, (tick + 1) * steps):
            for i, target_rad in waiting.pop(step, ()):
                motor, limits = joints[i].motor, joints[i].limits
                gains = motor.stiffness_nm_per_rad, motor.damping_nm_s_per_rad, limits.speed_rad_s
                body.drive(i, Mode.POSITION, target_rad, limits.torque_nm, *gains)
            body.advance_to((step + 1) * plant.step_s * 1e6)
    return {name: np.array(values) for name, values in rows.items()}


@dataclass
class Trial:
    """Joint, field, truth, and what was found; how far simulated drives are from the real ones, by (way, signal)."""

    rows: list[tuple[str, str, float, Value | None]]
    off: dict[tuple[str, str], float]


def trial(number: int, *sets: str) -> Trial:
    """A robot by its number. sets: as `--set`."""
    pick = random.Random(number)
    config = load("identify", [parse_set(text) for text in (*ROBOT, f"seed={number + 1}", *sets)]).config
    told = {joint.name: joint.motor for joint in config.robot.joint_table}
    truth = {
        name: Mounted(**{field: getattr(motor, field) * pick.uniform(1 - DRAWN, 1 + DRAWN) for field in FIELDS})
        for name, motor in told.items()
    }
    latency_s = {name: round(LATENCY_S * pick.uniform(1 - DRAWN, 1 + DRAWN), 3) for name in told}
    found = identified(config, recorded(config, truth, latency_s))
    rows: list[tuple[str, str, float, Value | None]] = []
    for one in found:
        for source, fields in ((truth[one.joint], FIELDS), (told[one.joint], GAINS)):
            rows += [(one.joint, field, getattr(source, field), one.fields.get(field)) for field in fields]
        rows.append((one.joint, "latency_s", latency_s[one.joint], one.latency_s))
    another = load("identify", [parse_set(text) for text in (*ROBOT, *ANOTHER, *QUIET, *sets)]).config
    real = recorded(another, truth, latency_s)
    values: dict[str, Mounted] = {}
    for one in found:
        known: dict[str, Any] = {name: one.fields[name].value for name in FIELDS if name in one.fields}
        values[one.joint] = Mounted(**known)
    late_s = {one.joint: LATENCY_S if one.latency_s is None else one.latency_s.value for one in found}
    nominal_s = dict.fromkeys(told, LATENCY_S)
    ways = {"file": ({}, nominal_s), "found": (values, nominal_s), "found, with its latency": (values, late_s)}
    off: dict[tuple[str, str], float] = {}
    for way, simulated in ways.items():
        moved = recorded(another, *simulated)
        for name in SIGNALS:
            off[way, name] = float(np.sqrt(np.mean((moved[name] - real[name]) ** 2)))
    return Trial(rows, off)


def main() -> int:
    """Print a row a parameter; of fewer trials after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=100, help="default: 100")
    parser.add_argument("--first", type=int, default=0, help="number of the first one, which is its seed (default: 0)")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="PATH=VALUE", help="as of a run")
    parser.add_argument("--joints", action="store_true", help="a line for each joint, too")
    arguments = parser.parse_args()
    rows: list[tuple[str, str, float, Value | None]] = []
    off: list[dict[tuple[str, str], float]] = []
    with contextlib.suppress(KeyboardInterrupt):
        for number in range(arguments.first, arguments.first + arguments.trials):
            now = trial(number, *arguments.sets)
            rows += now.rows
            off.append(now.off)
            for joint, field, truth, value in now.rows if arguments.joints else ():
                said = "unknown" if value is None else f"{value.value:.5f} within {value.within:.5f}"
                print(f"{number} {joint} {field}: {truth:.5f}, found {said}", flush=True)
    print(f"{len(off)} robots, seeds {arguments.first} to {arguments.first + len(off) - 1}")
    print("| parameter | joints | unknown | within 10 % | median error | intervals that cover | median half-width |")
    print("|---|---|---|---|---|---|---|")
    for field in dict.fromkeys(row[1] for row in rows):
        every = [(truth, value) for _, of, truth, value in rows if of == field]
        known = [(truth, value) for truth, value in every if value is not None]
        wrong = np.array([abs(value.value / truth - 1) for truth, value in known] or [np.nan])
        covered = np.mean([value.covers(truth) for truth, value in known] or [np.nan])
        wide = np.median([value.within / truth for truth, value in known] or [np.nan])
        print(
            f"| `{field}` | {len(every)} | {len(every) - len(known)} | {100 * np.mean(wrong <= 0.1):.0f} % | "
            f"{100 * np.median(wrong):.1f} % | {100 * covered:.0f} % | {100 * wide:.1f} % |"
        )
    print("| simulated with, another motion | angle, mrad | speed, mrad/s | torque, mN·m |")
    print("|---|---|---|---|")
    for way in dict.fromkeys(way for one in off for way, _ in one):
        medians = (1000 * np.median([one[way, name] for one in off]) for name in SIGNALS)
        print(f"| {way} | {' | '.join(f'{median:.3g}' for median in medians)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
