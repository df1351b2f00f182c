"""`snakesim robot check`: judges a run of the joint check, prints the verdicts, and marks the robot as checked."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.checked import CHECK, PROPERTIES, JointProperty, StartCheckRecord, mounting_digest
from snakesim_hal.wire.messages import Description
from snakesim_operator.features.commissioning.judge import MIN_TORQUE_NM, JointVerdict, judge_joints
from snakesim_operator.features.commissioning.measured import COLUMNS, collect_measurements, read_imus, tick_numbers
from snakesim_operator.features.commissioning.robot_edit import joints_on_drives, must_be_own, write_checked
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD
from snakesim_operator.results.run_log import RunRecord


@dataclass(frozen=True, kw_only=True)
class CheckRequest:
    """What a person states besides the run."""

    straight: bool = False  # the robot lay straight at the start
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


def check(run: Path, robot_file: Path | None, request: CheckRequest, *, as_json: bool = False) -> int:
    """Judge a run of the joint check, and print a line a joint.

    Args:
        run: folder of the run.
        robot_file: file into which to write that the robot was checked; None: nothing is written.
        request: what a person states.
        as_json: whether to print one JSON object instead of a line a joint.

    Returns:
        0 if every property of every joint was confirmed, otherwise 1.

    Raises:
        ConfigError: the run is of another controller, or the file cannot be written.
    """
    record = RunRecord.load(run)
    if record.config.controller != CHECK:
        raise ConfigError(
            f"{run}: its controller was {record.config.controller!r}; make a run with `snakesim run joint_check`, or "
            "any other scenario with --controller joint_check",
            code="commissioning/not-possible",
        )
    columns: dict[str, Floats] = {name: getattr(record, name) for name in COLUMNS}
    measurements = collect_measurements(
        record.config, record.description, tick_numbers(record), columns, read_imus(record)
    )
    rows = judge_joints(measurements, straight=request.straight, allowed_backlash_rad=request.allowed_backlash_rad)
    rows = [row.confirmed_by_hand(request.by_hand) for row in rows]
    if as_json:
        print_json({"joints": rows})
    else:
        for line in report_lines(rows):
            print_line(line)
    if robot_file is not None:
        _write_result(robot_file, record, rows, request)
    return 0 if all(row.all_confirmed for row in rows) else 1


def report_lines(rows: Sequence[JointVerdict]) -> list[str]:
    """Return a line a joint, then how many are right, then how each unknown property could be confirmed."""
    lines = [_joint_line(row) for row in rows]
    lines.append(_count_line(rows))
    lines += _ways_to_confirm(rows)
    light = [row.joint for row in rows if row.torque_nm is not None and abs(row.torque_nm) < MIN_TORQUE_NM]
    if light:
        lines.append(
            f"not judged: the sign of the torque of {_join_names(light, rows)}: less than {MIN_TORQUE_NM:g} N·m along "
            f"its motion; no property that has to be confirmed depends on it"
        )
    return lines


def _joint_line(row: JointVerdict) -> str:
    moved = "not moved yet  "
    if row.moved_rad is not None:
        moved = f"moved {row.moved_rad:5.3f} rad"
    turned = "link unknown    "
    if row.turned is not None:
        turned = f"link {row.turned:+5.2f} of it"
    return f"{row.joint:10}  {moved}  {turned}  {row.summary}"


def _count_line(rows: Sequence[JointVerdict]) -> str:
    """Return how many joints are right, wrong, unknown, and confirmed by hand."""
    right = sum(row.all_confirmed for row in rows)
    wrong = sum(bool(row.properties("wrong")) for row in rows)
    unknown = len(rows) - right - wrong
    by_hand = sum(any(finding.by_hand for finding in row.findings.values()) for row in rows)
    counts = [f"{right} of {len(rows)} joints match the robot file"]
    if wrong:
        counts.append(f"{wrong} wrong")
    if unknown:
        counts.append(f"{unknown} unknown")
    if by_hand:
        counts.append(f"{by_hand} with properties that you confirmed by hand")
    return "; ".join(counts)


def _ways_to_confirm(rows: Sequence[JointVerdict]) -> list[str]:
    """Return a line for each reason why properties are unknown, with the joints that it concerns."""
    concerned: dict[str, dict[str, list[JointProperty]]] = {}  # reason -> joint -> properties
    for row in rows:
        for name in row.properties("unknown"):
            properties_of_joint = concerned.setdefault(row.findings[name].reason, {})
            properties_of_joint.setdefault(row.joint, []).append(name)
    lines: list[str] = []
    for reason, joints in concerned.items():
        properties = [name for name in PROPERTIES if any(name in names for names in joints.values())]
        lines.append(f"unknown: {', '.join(properties)} of {_join_names(list(joints), rows)}: {reason}")
    return lines


def _join_names(joints: Sequence[str], rows: Sequence[JointVerdict]) -> str:
    if len(joints) == len(rows):
        return "every joint"
    return ", ".join(joints)


def _write_result(path: Path, record: RunRecord, rows: Sequence[JointVerdict], request: CheckRequest) -> None:
    """Write into a robot file that the robot was checked, if every property of every joint was confirmed.

    Args:
        path: The robot file.
        record: The run of the joint check.
        rows: The verdict on each joint.
        request: What a person states about the robot.

    Raises:
        ConfigError: The drives were emulated, or the file is not that of the checked robot.
    """
    robot = record.description
    joints = record.config.robot.joint_table
    must_be_own(path)
    if robot.emulated:
        raise ConfigError(
            f"{record.folder}: its drives were emulated, so the check is not valid for a real robot; not written",
            code="commissioning/not-possible",
        )
    if mounting_digest(joints_on_drives(path, joints)) != mounting_digest(joints):
        raise ConfigError(
            f"{path}: the mounting of the joints differs from that in {record.folder}; check the robot again",
            code="commissioning/not-possible",
        )
    unconfirmed = [row.joint for row in rows if not row.all_confirmed]
    if unconfirmed:
        print_line(f"{path}: nothing was written: {', '.join(unconfirmed)} are wrong or unknown")
        return
    checked = StartCheckRecord(
        by=get_user_name(),
        on=date.today().isoformat(),
        joints=mounting_digest(joints),
        backend=robot.backend,
        hardware=robot.hardware,
        serials=_serial_numbers(robot),
        confirmed=list(PROPERTIES),
        by_hand=_joints_confirmed_by_hand(rows),
        straight=request.straight,
        allowed_backlash_rad=request.allowed_backlash_rad,
    )
    write_checked(path, checked)
    print_line(
        f"{path}: checked by {checked.by} on {checked.on}; restart the host with it, and it is armed as any other"
    )


def _serial_numbers(robot: Description) -> list[str]:
    """Return the serial number of every drive; none if no drive has one."""
    serials = [joint.serial for joint in robot.joints]
    return serials if any(serials) else []


def _joints_confirmed_by_hand(rows: Sequence[JointVerdict]) -> dict[JointProperty, list[str]]:
    """Return the joints whose property a person confirmed, for each property with such joints."""
    joints_of: dict[JointProperty, list[str]] = {}
    for name in PROPERTIES:
        joints = [row.joint for row in rows if row.findings[name].by_hand]
        if joints:
            joints_of[name] = joints
    return joints_of
