"""A table of the joints: the values of the robot file for each joint, and whether the joints were checked.

Also what each drive reports about itself. Pure; everything that comes from the network is escaped.
"""

from collections.abc import Sequence

from snakesim_hal.model.robot_file.checked import StartCheckRecord
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import JointDescription
from snakesim_operator.features.console.page.page_html import BAD, escape_text
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

AngleRange = tuple[float, float]  # lower and upper end, rad

COLUMN_HEADINGS = ("", "now", "limits, rad", "sign", "zero, rad")

# Styles of the elements of the table.
FRAME_STYLE = "padding:0 .6em .4em;font-size:.85em"
HEADER_STYLE = "text-align:left;padding-right:.8em"


def format_joint_table(
    snapshot: RobotSnapshot, config: RunConfig | None, moved_ranges: Sequence[AngleRange] = ()
) -> str:
    """Return the table of joints as HTML: angle, limits, sign and zero of each joint.

    Above the table, one line shows whether and how the joints were checked.

    Args:
        snapshot: The newest snapshot of the robot.
        config: Configuration with which the host was started; None if it is not known.
        moved_ranges: The range in which each joint was moved by hand so far, tail to head; empty if not measured.
    """
    rows: list[str] = []
    for joint_index in range(len(snapshot.robot.joints)):
        configured_joint = None if config is None else config.robot.joint_table[joint_index]
        moved_range = moved_ranges[joint_index] if moved_ranges else None
        rows.append(_format_joint_rows(snapshot, joint_index, configured_joint, moved_range))
    header_cells = "".join(
        f"<th style='{HEADER_STYLE}'>{heading}</th>" for heading in COLUMN_HEADINGS
    )
    return (
        f"<div style='{FRAME_STYLE}'>{_format_check_line(snapshot, config)}"
        f"<table style='border-spacing:0;width:100%'><tr style='opacity:.7'>{header_cells}</tr>{''.join(rows)}"
        f"</table></div>"
    )


def _format_check_line(snapshot: RobotSnapshot, config: RunConfig | None) -> str:
    """Format one line of HTML about the start check: whether the joints were checked, by whom and how.

    The first case that applies wins: the report of the host counts more than the robot file, because the host
    compares the file with the drives.

    Args:
        snapshot: The newest snapshot of the robot, with its status.
        config: Configuration with which the host was started; None if it is not known.
    """
    status = snapshot.status
    if snapshot.robot.emulated:
        return "<div>nothing real moves: its joints need no check</div>"
    if status is not None and status.unchecked:
        return f"<div style='color:{BAD}'>not checked: {escape_text(status.unchecked)}</div>"
    if config is None or status is None:
        return "<div>whether it was checked is not known: its host has not published its configuration</div>"
    start_check = config.robot.checked
    if start_check is None:
        return "<div>not checked yet: this run is the start check</div>"
    return f"<div>{escape_text(_describe_start_check(start_check))}</div>"


def _describe_start_check(start_check: StartCheckRecord) -> str:
    """Return who did the start check of a robot, when and on what hardware, and what was checked by hand."""
    hardware = f"{start_check.backend} {start_check.hardware}".strip()
    text = f"checked by {start_check.by} on {start_check.on}, on {hardware}"
    if start_check.by_hand:
        parts = [f"{name} of {', '.join(joints)}" for name, joints in start_check.by_hand.items()]
        text += f"; by hand: {'; '.join(parts)}"
    return text


def _format_joint_rows(
    snapshot: RobotSnapshot,
    joint_index: int,
    configured_joint: Joint | None,
    moved_range: AngleRange | None,
) -> str:
    """Format two rows of the table for a joint as HTML: its values, and its drive below them.

    Args:
        snapshot: The newest snapshot of the robot.
        joint_index: Index of the joint, from the tail.
        configured_joint: The joint in the configuration of the run; None if it is not known.
        moved_range: The range in rad in which it was moved by hand so far; None if it was not measured.
    """
    described_joint = snapshot.robot.joints[joint_index]
    sign = "?" if configured_joint is None else f"{configured_joint.drive.sign:+d}"
    zero = "?" if configured_joint is None else f"{configured_joint.drive.zero_rad:+.4f}"
    limits = f"{described_joint.angle_min_rad:+.2f} to {described_joint.angle_max_rad:+.2f}"
    cell_texts = (_format_angle(snapshot, joint_index), limits, sign, zero)
    cells = "".join(f"<td style='padding-right:.8em'>{text}</td>" for text in cell_texts)
    joint_name = escape_text(described_joint.name)
    name_cell = (
        f"<td style='padding-right:.8em;white-space:nowrap;font-weight:600'>{joint_name}</td>"
    )
    drive = escape_text(_describe_drive(described_joint, configured_joint))
    moved = ""
    if moved_range is not None:
        lower_rad, upper_rad = moved_range
        moved = f"<div>moved from {lower_rad:+.3f} to {upper_rad:+.3f} rad</div>"
    drive_cells = (
        f"<td></td><td colspan='4' style='opacity:.7;padding-bottom:.25em'>{drive}{moved}</td>"
    )
    return f"<tr>{name_cell}{cells}</tr><tr>{drive_cells}</tr>"


def _format_angle(snapshot: RobotSnapshot, joint_index: int) -> str:
    joints = snapshot.joints
    if joints is None or not joints.valid[joint_index]:
        return "unknown"
    return f"{joints.angle_rad[joint_index]:+.3f}"


def _describe_drive(described: JointDescription, built: Joint | None) -> str:
    """Return axis, address, driver type, serial number and firmware of a joint's drive, as far as they are known."""
    parts: list[str] = [described.axis]
    if built is not None:
        parts.append(f"id {built.id}")
        if built.drive.port:
            parts.append(f"on {built.drive.port}")
        if built.drive.driver:
            parts.append(built.drive.driver)
    parts.append(f"serial {described.serial}" if described.serial else "no serial number")
    if described.firmware:
        parts.append(f"firmware {described.firmware}")
    return ", ".join(parts)
