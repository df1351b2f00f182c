"""`snakesim joints check`: the record of a run of the joint check, judged and printed."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import user_name
from snakesim_hal.base.terminal import say
from snakesim_hal.model.checked import CHECK, PROPERTIES, Checked, JointProperty, mounting_digest
from snakesim_operator.features.commissioning.judge import LEAST_TORQUE_NM, Judged, judged
from snakesim_operator.features.commissioning.measured import COLUMNS, imus_of, measured, ticks_of
from snakesim_operator.features.commissioning.robot_edit import joints_on_drives, must_be_own, write_checked
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD
from snakesim_operator.results.record import RunRecord


@dataclass(frozen=True, kw_only=True)
class CheckRequest:
    """What the operator says besides the run."""

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


def check(run: Path, path: Path | None, request: CheckRequest) -> int:
    """Print a line a joint. Return 0 if every property of every joint was confirmed, otherwise 1. Raises ConfigError.

    Args:
        run: folder of the run.
        path: robot file into which to write that it was checked; None: nothing is written.
        request: what the operator says.
    """
    record = RunRecord.load(run)
    if record.config.controller != CHECK:
        raise ConfigError(
            f"{run}: its controller was {record.config.controller!r}; make a run with `snakesim run joint_check`, or "
            "any other scenario with --controller joint_check"
        )
    columns: dict[str, Floats] = {name: getattr(record, name) for name in COLUMNS}
    measurements = measured(record.config, record.description, ticks_of(record), columns, imus_of(record))
    rows = judged(measurements, straight=request.straight, allowed_backlash_rad=request.allowed_backlash_rad)
    rows = [row.confirmed_by_hand(request.by_hand) for row in rows]
    for line in report_lines(rows):
        say(line)
    if path is not None:
        _write(path, record, rows, request)
    return 0 if all(row.as_told for row in rows) else 1


def report_lines(rows: Sequence[Judged]) -> list[str]:
    """Return a line a joint, then how many are right, then how each unknown property could be confirmed."""
    lines: list[str] = []
    for row in rows:
        moved = "not moved yet  " if row.moved_rad is None else f"moved {row.moved_rad:5.3f} rad"
        turned = "link unknown    " if row.turned is None else f"link {row.turned:+5.2f} of it"
        lines.append(f"{row.joint:10}  {moved}  {turned}  {row.verdict}")
    right = sum(row.as_told for row in rows)
    wrong = sum(bool(row.properties("wrong")) for row in rows)
    unknown = len(rows) - right - wrong
    counts = [f"{right} of {len(rows)} joints are as the robot file says"]
    if wrong:
        counts.append(f"{wrong} wrong")
    if unknown:
        counts.append(f"{unknown} unknown")
    by_hand = sum(any(finding.by_hand for finding in row.findings.values()) for row in rows)
    if by_hand:
        counts.append(f"{by_hand} with properties that you confirmed by hand")
    lines.append("; ".join(counts))
    lines += _ways_to_confirm(rows)
    light = [row.joint for row in rows if row.torque_nm is not None and abs(row.torque_nm) < LEAST_TORQUE_NM]
    if light:
        lines.append(
            f"not judged: the sign of the torque of {_names(light, rows)}: less than {LEAST_TORQUE_NM:g} N·m along its "
            f"motion; no property that has to be confirmed depends on it"
        )
    return lines


def _ways_to_confirm(rows: Sequence[Judged]) -> list[str]:
    """Return a line for each reason why properties are unknown, with the joints that it concerns."""
    concerned: dict[str, dict[str, list[JointProperty]]] = {}  # reason -> joint -> properties
    for row in rows:
        for name in row.properties("unknown"):
            concerned.setdefault(row.findings[name].reason, {}).setdefault(row.joint, []).append(name)
    lines: list[str] = []
    for reason, joints in concerned.items():
        properties = [name for name in PROPERTIES if any(name in names for names in joints.values())]
        lines.append(f"unknown: {', '.join(properties)} of {_names(list(joints), rows)}: {reason}")
    return lines


def _names(joints: Sequence[str], rows: Sequence[Judged]) -> str:
    return "every joint" if len(joints) == len(rows) else ", ".join(joints)


def _write(path: Path, record: RunRecord, rows: Sequence[Judged], request: CheckRequest) -> None:
    """Write that it was checked, by whom, when, on which drives, and what of it by hand. Raises ConfigError."""
    robot = record.description
    joints = record.config.robot.joint_table
    must_be_own(path)
    if robot.emulated:
        raise ConfigError(f"{record.folder}: its drives were emulated, which says nothing of a real robot; not written")
    if mounting_digest(joints_on_drives(path, joints)) != mounting_digest(joints):
        raise ConfigError(f"{path}: says otherwise how the joints are mounted than in {record.folder}; check it again")
    missing = [row.joint for row in rows if not row.as_told]
    if missing:
        say(f"{path}: nothing was written: {', '.join(missing)} are wrong or unknown")
        return
    by_hand: dict[JointProperty, list[str]] = {}
    for name in PROPERTIES:
        confirmed = [row.joint for row in rows if row.findings[name].by_hand]
        if confirmed:
            by_hand[name] = confirmed
    checked = Checked(
        by=user_name(),
        on=date.today().isoformat(),
        joints=mounting_digest(joints),
        backend=robot.backend,
        hardware=robot.hardware,
        serials=[joint.serial for joint in robot.joints] if any(joint.serial for joint in robot.joints) else [],
        confirmed=list(PROPERTIES),
        by_hand=by_hand,
        straight=request.straight,
        allowed_backlash_rad=request.allowed_backlash_rad,
    )
    write_checked(path, checked)
    say(f"{path}: checked by {checked.by} on {checked.on}; restart the host with it, and it is armed as any other")
