"""Emulated robots with a hidden fault, and what the start check finds of it.

Every trial is a robot of its own, by its number, which is its seed: the joint, the size of its fault, the friction of
the floor, and how straight a person laid the robot. A robot has the same number, joint and fault for all drive types.
"""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from snakesim_hal.model.robot_file.checked import JointProperty
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, Imu
from snakesim_operator.features.commissioning.joint_check.gear_rules import (
    CONFIRM_GEAR_BY_HAND,
    IS_LOOSE,
    NO_BACKLASH,
)
from snakesim_operator.features.commissioning.joint_check.joint_verdict import JointVerdict
from snakesim_operator.features.commissioning.joint_check.judge import judge_joints
from snakesim_operator.features.commissioning.joint_check.measurements import (
    CheckMeasurements,
    collect_measurements,
)

JOINT_COUNT = 5
SECONDS_PER_JOINT = 3.4  # of the joint check, at most
ALL_JOINTS_MOVED = (
    "every joint was moved"  # reason that the controller of the check gives at its end
)
FINAL_REST_S = 0.5  # after the last motion, before the run ends
# A process that is paused for long must not count as a part of the run that computes without end.
TURN_LIMIT_S = 24 * 3600.0

LAID_RAD = 0.03  # how straight a person lays a robot, at each joint
OFFSET_RAD = 0.15
GEARS = (0.5, 2 / 3, 0.8, 1.25, 1.5, 2.0)
BACKLASHES_RAD = (0.0175, 0.025, 0.035, 0.045)  # 1 to 2.6 degrees
DEAD_ZONES_RAD = (0.01, 0.015, 0.025, 0.035)  # 0.6 to 2 degrees
# Below the load of a joint between others on a slippery floor; a coupling that slips at more may not slip in the check.
SLIP_TORQUES_NM = (0.005, 0.04)  # lowest and highest
# Of the weights that a person lays on the links: lowest and highest, divided by their nominal mass.
WEIGHT_FACTORS = (0.8, 1.2)
NONE = "none"
# Hidden fault -> the property that should be found wrong, and words of its verdict.
FAULTS: Mapping[str, tuple[JointProperty, str]] = {
    "sign": ("sign", "the other way"),
    "order": ("order", "swapped"),
    "zero": ("zero", "zero is off"),
    "gear": ("gear", "as far as its drive measures"),
    "backlash": ("gear", "backlash of"),
    "dead zone": ("drive", "dead zone"),
    "coupling": ("gear", "its coupling slips"),
    "dead motor": ("drive", "did not move"),
}
# Of these, only emulated joint modules have a setting.
FAULTS_OF_JOINT_MODULES = ("order", "dead motor")
JOINT_MODULES = "can"  # the only backend whose drives report IMUs

# "either": the check reports a loose gear or coupling, and cannot tell which.
# "unnoticed": it confirmed the property, or reported that it found no backlash above an angle. All hidden backlash is
# larger than any such angle.
Outcome = Literal["named", "either", "misnamed", "unknown", "unnoticed"]


@dataclass(frozen=True)
class LinkWeights:
    """Nominal masses of the weights that a person lays on the links of a robot, in kg; 0 for none."""

    ends_kg: float = 0.0  # on each of the first and the last link
    others_kg: float = 0.0  # on each link between them


NO_WEIGHTS = LinkWeights()


@dataclass(frozen=True)
class CheckTrial:
    """One robot, and what was found of it."""

    backend: str
    number: int  # of the robot, which is its seed
    fault: str
    settings: Sequence[
        str
    ]  # of the emulated drives that make the fault, such as "joint_1.backlash_rad=0.025"
    joints: Sequence[int]  # that have the fault
    weights: LinkWeights  # that lay on the links
    measurements: CheckMeasurements
    rows: Sequence[JointVerdict]

    @property
    def outcome(self) -> Outcome | None:
        """What the check reported of the joints with the fault; None if there is no fault."""
        if not self.joints:
            return None
        for joint in self.joints:
            outcome = self._judge_outcome(self.rows[joint])
            if outcome != "named":
                return outcome
        return "named"

    def _judge_outcome(self, row: JointVerdict) -> Outcome:
        """Return what the check reported of one joint with the fault."""
        name, words = FAULTS[self.fault]
        finding = row.findings[name]
        if finding.state == "wrong" and finding.reason.startswith(IS_LOOSE):
            return "either"
        if finding.state == "wrong" and words in finding.reason:
            return "named"
        if row.list_properties("wrong"):
            return "misnamed"
        if finding.state == "unknown" and NO_BACKLASH not in finding.reason:
            return "unknown"
        return "unnoticed"

    @property
    def found(self) -> bool:
        """Whether the right property of every joint with the fault was found wrong, by the right name."""
        return self.outcome == "named"

    @property
    def is_at_end(self) -> bool:
        """Whether a joint with the fault is the first or the last one of the robot."""
        return any(joint in (0, len(self.rows) - 1) for joint in self.joints)

    @property
    def reported(self) -> list[str]:
        """What the check reported of each joint with the fault, and why the property with the fault is unknown."""
        texts: list[str] = []
        for joint in self.joints:
            row = self.rows[joint]
            finding = row.findings[FAULTS[self.fault][0]]
            reason = ""
            if finding.state == "unknown":
                reason = f" ({finding.reason.removesuffix(f': {CONFIRM_GEAR_BY_HAND}')})"
            texts.append(f"{row.joint}: {row.summary}{reason}")
        return texts

    @property
    def sound_rows(self) -> list[JointVerdict]:
        """Verdicts on the joints without the fault."""
        return [row for joint, row in enumerate(self.rows) if joint not in self.joints]

    @property
    def tight_count(self) -> int:
        """Number of sound joints whose gear was confirmed, or in which the torque excludes backlash."""
        gears = [row.findings["gear"] for row in self.sound_rows]
        return sum(gear.state == "confirmed" or gear.excludes_backlash for gear in gears)

    @property
    def blamed(self) -> list[str]:
        """Sound joints of which something is wrong."""
        return [
            f"{row.joint}: {row.summary}" for row in self.sound_rows if row.list_properties("wrong")
        ]

    @property
    def unsure(self) -> list[str]:
        """Sound joints of which something is unknown."""
        return [
            f"{row.joint}: {row.summary}"
            for row in self.sound_rows
            if row.list_properties("unknown")
        ]


def check_trial(
    number: int,
    fault: str,
    *sets: str,
    backend: str = JOINT_MODULES,
    joint_count: int = JOINT_COUNT,
    weights: LinkWeights = NO_WEIGHTS,
) -> CheckTrial:
    """Check a robot with a hidden fault.

    Args:
        number: Number of the robot, which is its seed.
        fault: The fault, of `FAULTS` or `NONE`.
        *sets: As `--set` of a run.
        backend: Backend of the run, which is the type of its drives.
        joint_count: Number of joints.
        weights: Weights on the links.
    """
    pick = random.Random(number)
    zeros = [pick.uniform(-LAID_RAD, LAID_RAD) for _ in range(joint_count)]
    joint, other = pick.sample(range(joint_count), 2)
    settings: list[str] = []
    match fault:
        case "sign":
            settings = [f"joint_{joint + 1}.sign=-1"]
        case "order":
            settings = [f"joint_{joint + 1}.id={other + 1}", f"joint_{other + 1}.id={joint + 1}"]
        case "zero":
            zeros[joint] += pick.choice((-OFFSET_RAD, OFFSET_RAD))
        case "gear":
            settings = [f"joint_{joint + 1}.gear={pick.choice(GEARS)}"]
        case "backlash":
            settings = [f"joint_{joint + 1}.backlash_rad={pick.choice(BACKLASHES_RAD)}"]
        case "dead zone":
            dead_zone_rad = pick.choice(DEAD_ZONES_RAD)
            settings = [f"joint_{joint + 1}.encoder_dead_zone_rad={dead_zone_rad}"]
        case "coupling":
            settings = [f"joint_{joint + 1}.coupling_slip_nm={pick.uniform(*SLIP_TORQUES_NM)}"]
        case "dead motor":
            settings = [f"joint_{joint + 1}.connected=false"]
        case _:
            pass
    truth = [*settings, *(f"joint_{i + 1}.zero_rad={zero}" for i, zero in enumerate(zeros))]
    run = [
        f"seed={number}",
        f"scene.ground.friction={pick.uniform(0.2, 0.8)}",
        f"robot.chain.modules={joint_count}",
    ]
    if weights != NO_WEIGHTS:
        run.append(_describe_weighted_links(joint_count, weights, pick))
    seconds = SECONDS_PER_JOINT * joint_count
    run += [f"duration_s={seconds}", *(f"backends.{backend}.mounted.{text}" for text in truth)]
    with_fault = {NONE: [], "order": [joint, other]}.get(fault, [joint])
    measurements = run_start_check(f"backend={backend}", *sets, *run)
    # The robot file of the person does not contain the weights.
    link_masses_kg = _load_robot(joint_count).link_masses_kg
    measurements = replace(measurements, link_masses_kg=link_masses_kg)
    return judge_trial(backend, number, fault, settings, with_fault, weights, measurements)


def _describe_weighted_links(joint_count: int, weights: LinkWeights, pick: random.Random) -> str:
    """Return the `--set` option of the links of a robot, whose masses contain the weights that lie on them."""
    robot = _load_robot(joint_count)
    links: list[str] = []
    for i, (length_m, mass_kg) in enumerate(
        zip(robot.link_lengths_m, robot.link_masses_kg, strict=True)
    ):
        weight_kg = weights.ends_kg if i in (0, joint_count) else weights.others_kg
        weight_kg *= pick.uniform(*WEIGHT_FACTORS)
        links.append(f"{{length_m={length_m}, mass_kg={mass_kg + weight_kg}}}")
    return f"robot.links=[{', '.join(links)}]"


def _load_robot(joint_count: int) -> RobotFile:
    """Return the robot of the trials, without weights."""
    settings = [parse_set_option(f"robot.chain.modules={joint_count}")]
    return load_scenario("joint_check", settings).config.robot


def judge_trial(
    backend: str,
    number: int,
    fault: str,
    settings: Sequence[str],
    joints: Sequence[int],
    weights: LinkWeights,
    measurements: CheckMeasurements,
) -> CheckTrial:
    """Judge the measurements of one robot, which the person laid straight. The arguments: see `CheckTrial`."""
    rows = judge_joints(measurements, was_laid_straight=True, end_weights_kg=weights.ends_kg)
    return CheckTrial(backend, number, fault, settings, joints, weights, measurements, rows)


def run_start_check(*sets: str) -> CheckMeasurements:
    """Run the joint check in this process until every joint was moved. `sets`: as `--set` of a run."""
    config = load_scenario("joint_check", [parse_set_option(text) for text in sets]).config
    imus: list[Imu] = []
    remaining_ticks: int | None = None  # None while joints are still moved
    with InProcessRun(config, turn_limit_s=TURN_LIMIT_S) as run:
        session = run.network.create_session()
        imu_reader = session.declare_reader(keys.IMU, Imu)
        state_reader = session.declare_reader(keys.CONTROL_STATE, ControlState)
        box = run.host.black_box
        rows = b""
        for _ in run.iterate_ticks():
            imus += imu_reader.drain()
            rows += box.read_rows(len(rows) // box.layout.row_bytes)[1]
            states = state_reader.drain()
            if remaining_ticks is None and any(s.reason == ALL_JOINTS_MOVED for s in states):
                remaining_ticks = round(FINAL_REST_S * config.rate_hz)
            if remaining_ticks is not None:
                remaining_ticks -= 1
                if remaining_ticks == 0:
                    run.stop()
        columns = box.layout.decode_rows(rows)
        robot = run.host.description
        config = run.config
    ticks = columns.pop("tick").tolist()
    return collect_measurements(config, robot, ticks, columns, imus)


def list_possible_faults(backend: str) -> list[str]:
    """Return the faults that drives of a backend can have, and `NONE`."""
    kinds = [*FAULTS, NONE]
    if backend != JOINT_MODULES:
        kinds = [kind for kind in kinds if kind not in FAULTS_OF_JOINT_MODULES]
    return kinds
