"""`snakesim robot check`: judges a run of the joint check, prints the verdicts, and marks the robot as checked."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.robot_file.checked import (
    PROPERTIES,
    START_CHECK_CONTROLLER,
    JointProperty,
    compute_mounting_digest,
)
from snakesim_operator.features.commissioning.joint_check.joint_verdict import JointVerdict
from snakesim_operator.features.commissioning.joint_check.judge import judge_joints
from snakesim_operator.features.commissioning.joint_check.measurements import (
    SIGNAL_NAMES,
    collect_measurements,
    compute_tick_numbers,
    read_imus,
)
from snakesim_operator.features.commissioning.joint_check.property_rules import MIN_TORQUE_NM
from snakesim_operator.features.commissioning.robot_edit import (
    make_check_record,
    read_joints_with_drive_modes,
    require_own_robot_file,
    write_check_record,
)
from snakesim_operator.features.commissioning.shape.record import (
    ShapeEvidence,
    read_shape_evidence,
)
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True, kw_only=True)
class CheckStatement:
    """What a person states about the robot that was checked, in addition to the run."""

    straight: bool = False  # the robot lay straight at the start
    end_weights_kg: float = 0.0  # a weight of this mass lay on the first and on the last link
    direction_by_hand: bool = False  # a person confirmed order and sign where the check could not
    gear_by_hand: bool = False  # likewise the gear
    allowed_backlash_rad: float = ALLOWED_BACKLASH_RAD

    @property
    def by_hand(self) -> list[JointProperty]:
        """Return the properties that a person confirmed."""
        properties: list[JointProperty] = []
        if self.direction_by_hand:
            properties.extend(("order", "sign"))
        if self.gear_by_hand:
            properties.append("gear")
        return properties


def report_joint_check(
    run: Path, robot_file: Path | None, statement: CheckStatement, *, as_json: bool = False
) -> int:
    """Judge the joints in a run of the joint check, print the verdicts, and mark the robot file as checked.

    Args:
        run: Path of the run folder.
        robot_file: Robot file that is marked as checked if all is confirmed; None if no file is to be written.
        statement: Statements of a person about the robot, such as that it lay straight.
        as_json: Whether to print one JSON object instead of one line for each joint.

    Returns:
        The exit code: 0 if every property of every joint was confirmed, otherwise 1.

    Raises:
        ConfigError: The run is of another controller, or the file cannot be written.
    """
    record = RunRecord.load(run)
    if record.config.controller != START_CHECK_CONTROLLER:
        raise ConfigError(
            f"{run}: its controller was {record.config.controller!r}; make a run with `snakesim run joint_check`, or "
            "any other scenario with --controller joint_check",
            code="commissioning/not-possible",
        )
    columns: dict[str, Floats] = {name: getattr(record, name) for name in SIGNAL_NAMES}
    ticks = compute_tick_numbers(record.time_s, record.config.rate_hz)
    measurements = collect_measurements(
        record.config, record.description, ticks, columns, read_imus(record)
    )
    verdicts = judge_joints(
        measurements,
        was_laid_straight=statement.straight,
        end_weights_kg=statement.end_weights_kg,
        allowed_backlash_rad=statement.allowed_backlash_rad,
    )
    verdicts = [verdict.confirm_by_hand(statement.by_hand) for verdict in verdicts]
    shape_evidence = ShapeEvidence()
    if robot_file is not None:
        # What drawn shapes confirmed needs no IMU. It counts as long as neither file nor drives have changed.
        shape_evidence = read_shape_evidence(
            robot_file, record.config.robot.joint_table, record.description
        )
    verdicts = [
        verdict.confirm_by_shape(
            shape_evidence.properties, was_shaken=verdict.joint in shape_evidence.shaken_joints
        )
        for verdict in verdicts
    ]
    if as_json:
        print_json({"joints": verdicts})
    else:
        for line in format_report(verdicts):
            print_line(line)
    if robot_file is not None:
        _write_check_record(robot_file, record, verdicts, statement, shape_evidence.shaken_joints)
    return 0 if all(verdict.all_confirmed for verdict in verdicts) else 1


def format_report(verdicts: Sequence[JointVerdict]) -> list[str]:
    """Return the verdict on each joint, one a line, the counts, and how each unknown property could be confirmed."""
    lines = [_format_verdict(verdict) for verdict in verdicts]
    lines.append(_format_counts(verdicts))
    lines += _format_unknown_properties(verdicts)
    light_joints = [
        verdict.joint
        for verdict in verdicts
        if verdict.torque_nm is not None and abs(verdict.torque_nm) < MIN_TORQUE_NM
    ]
    if light_joints:
        names = _join_joint_names(light_joints, verdicts)
        lines.append(
            f"not judged: the sign of the torque of {names}: less than {MIN_TORQUE_NM:g} N·m along "
            f"its motion; no property that has to be confirmed depends on it"
        )
    return lines


def _format_verdict(verdict: JointVerdict) -> str:
    moved = "not moved yet  "
    if verdict.moved_rad is not None:
        moved = f"moved {verdict.moved_rad:5.3f} rad"
    turned = "link unknown    "
    if verdict.turned is not None:
        turned = f"link {verdict.turned:+5.2f} of it"
    return f"{verdict.joint:10}  {moved}  {turned}  {verdict.summary}"


def _format_counts(verdicts: Sequence[JointVerdict]) -> str:
    """Return a line that counts the joints that are right, wrong, unknown, and confirmed by hand."""
    right = sum(verdict.all_confirmed for verdict in verdicts)
    wrong = sum(bool(verdict.list_properties("wrong")) for verdict in verdicts)
    unknown = len(verdicts) - right - wrong
    by_hand = sum(
        any(finding.by_hand for finding in verdict.findings.values()) for verdict in verdicts
    )
    counts = [f"{right} of {len(verdicts)} joints match the robot file"]
    if wrong:
        counts.append(f"{wrong} wrong")
    if unknown:
        counts.append(f"{unknown} unknown")
    if by_hand:
        counts.append(f"{by_hand} with properties that you confirmed by hand")
    by_shape = sum(
        any(finding.by_shape for finding in verdict.findings.values()) for verdict in verdicts
    )
    if by_shape:
        counts.append(f"{by_shape} with properties that drawn shapes confirmed")
    return "; ".join(counts)


def _format_unknown_properties(verdicts: Sequence[JointVerdict]) -> list[str]:
    """Return a line for each reason why properties are unknown, with the joints that it concerns."""
    # Reason -> joint -> properties.
    properties_by_reason: dict[str, dict[str, list[JointProperty]]] = {}
    for verdict in verdicts:
        for name in verdict.list_properties("unknown"):
            properties_by_joint = properties_by_reason.setdefault(verdict.findings[name].reason, {})
            properties_by_joint.setdefault(verdict.joint, []).append(name)
    lines: list[str] = []
    for reason, joints in properties_by_reason.items():
        properties = [
            name for name in PROPERTIES if any(name in names for names in joints.values())
        ]
        lines.append(
            f"unknown: {', '.join(properties)} of {_join_joint_names(list(joints), verdicts)}: {reason}"
        )
    return lines


def _join_joint_names(joints: Sequence[str], verdicts: Sequence[JointVerdict]) -> str:
    if len(joints) == len(verdicts):
        return "every joint"
    return ", ".join(joints)


def _write_check_record(
    path: Path,
    record: RunRecord,
    verdicts: Sequence[JointVerdict],
    statement: CheckStatement,
    shaken_joints: Sequence[str],
) -> None:
    """Mark a robot file as checked, if every property of every joint was confirmed; otherwise print why not.

    Args:
        path: Path of the robot file.
        record: The run of the joint check.
        verdicts: The verdict on each joint.
        statement: Statements of a person about the robot.
        shaken_joints: Joints whose link a person shook before, and found tight.

    Raises:
        ConfigError: The drives were emulated, or the file is not that of the checked robot.
    """
    robot = record.description
    joints = record.config.robot.joint_table
    require_own_robot_file(path)
    if robot.emulated:
        raise ConfigError(
            f"{record.path}: its drives were emulated, so the check is not valid for a real robot; not written",
            code="commissioning/not-possible",
        )
    if compute_mounting_digest(
        read_joints_with_drive_modes(path, joints)
    ) != compute_mounting_digest(joints):
        raise ConfigError(
            f"{path}: the mounting of the joints differs from that in {record.path}; check the robot again",
            code="commissioning/not-possible",
        )
    unconfirmed = [verdict.joint for verdict in verdicts if not verdict.all_confirmed]
    if unconfirmed:
        print_line(f"{path}: nothing was written: {', '.join(unconfirmed)} are wrong or unknown")
        return
    checked = msgspec.structs.replace(
        make_check_record(joints, robot, PROPERTIES),
        by_hand=_group_joints_confirmed_by_hand(verdicts),
        by_shape=_list_properties_confirmed_by_shape(verdicts),
        shaken=list(shaken_joints),
        straight=statement.straight,
        allowed_backlash_rad=statement.allowed_backlash_rad,
    )
    write_check_record(path, checked)
    print_line(
        f"{path}: checked by {checked.by} on {checked.on}; restart the host with it, and it is armed as any other"
    )


def _list_properties_confirmed_by_shape(verdicts: Sequence[JointVerdict]) -> list[JointProperty]:
    """Return the properties that drawn shapes confirmed, of any joint: they have confirmed them of every joint."""
    return [
        name for name in PROPERTIES if any(verdict.findings[name].by_shape for verdict in verdicts)
    ]


def _group_joints_confirmed_by_hand(
    verdicts: Sequence[JointVerdict],
) -> dict[JointProperty, list[str]]:
    """Return the joints whose property a person confirmed, for each property with such joints."""
    joints_by_property: dict[JointProperty, list[str]] = {}
    for name in PROPERTIES:
        joints = [verdict.joint for verdict in verdicts if verdict.findings[name].by_hand]
        if joints:
            joints_by_property[name] = joints
    return joints_by_property
