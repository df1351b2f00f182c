"""A table of what the file says of each joint and its drive of itself, and whether anybody has checked them. Pure.

Everything that comes from the network is escaped.
"""

from collections.abc import Sequence

from snakesim_hal.model.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import JointDescription
from snakesim_operator.features.console.page.page_html import BAD, escape_text
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

Range = tuple[float, float]


def commissioning_html(snapshot: RobotSnapshot, config: RunConfig | None, moved: Sequence[Range] = ()) -> str:
    """config: with which the host was started, None: not known; moved: from where to where, so far, tail to head."""
    rows = "".join(_row(snapshot, i, config, moved) for i in range(len(snapshot.robot.joints)))
    head = "".join(f"<th style='text-align:left;padding-right:.8em'>{word}</th>" for word in ("", "now", "limits, rad"))
    more = "<th style='text-align:left;padding-right:.8em'>sign</th><th style='text-align:left'>zero, rad</th>"
    return (
        f"<div style='padding:0 .6em .4em;font-size:.85em'>{_checked(snapshot, config)}"
        f"<table style='border-spacing:0;width:100%'><tr style='opacity:.7'>{head}{more}</tr>{rows}</table></div>"
    )


def _checked(snapshot: RobotSnapshot, config: RunConfig | None) -> str:
    robot, status = snapshot.robot, snapshot.status
    if robot.emulated:
        return "<div>nothing real moves: its joints need no check</div>"
    if status is not None and status.unchecked:
        return f"<div style='color:{BAD}'>not checked: {escape_text(status.unchecked)}</div>"
    if config is None or status is None:
        return "<div>whether it was checked is not known: its host has not said how it is set up</div>"
    checked = config.robot.checked
    if checked is None:
        return "<div>not checked yet: this run is the start check</div>"
    parts = [f"{name} of {', '.join(joints)}" for name, joints in checked.by_hand.items()]
    by_hand = f"; by hand: {'; '.join(parts)}" if parts else ""
    on = f"{checked.backend} {checked.hardware}".strip()
    return f"<div>{escape_text(f'checked by {checked.by} on {checked.on}, on {on}{by_hand}')}</div>"


def _row(snapshot: RobotSnapshot, i: int, config: RunConfig | None, moved: Sequence[Range]) -> str:
    described, joints = snapshot.robot.joints[i], snapshot.joints
    now = "unknown" if joints is None or not joints.valid[i] else f"{joints.angle_rad[i]:+.3f}"
    limits = f"{described.angle_min_rad:+.2f} to {described.angle_max_rad:+.2f}"
    built = None if config is None else config.robot.joint_table[i]
    sign, zero = ("?", "?") if built is None else (f"{built.drive.sign:+d}", f"{built.drive.zero_rad:+.4f}")
    cells = "".join(f"<td style='padding-right:.8em'>{cell}</td>" for cell in (now, limits, sign, zero))
    name = f"<td style='padding-right:.8em;white-space:nowrap;font-weight:600'>{escape_text(described.name)}</td>"
    seen = f"<div>moved from {moved[i][0]:+.3f} to {moved[i][1]:+.3f} rad</div>" if moved else ""
    drive = escape_text(_drive(described, built))
    below = f"<td></td><td colspan='4' style='opacity:.7;padding-bottom:.25em'>{drive}{seen}</td>"
    return f"<tr>{name}{cells}</tr><tr>{below}</tr>"


def _drive(described: JointDescription, built: Joint | None) -> str:
    where: list[str] = []
    if built is not None:
        where = [f"id {built.id}", *([f"on {built.drive.port}"] if built.drive.port else [])]
        where += [built.drive.driver] if built.drive.driver else []
    serial = f"serial {described.serial}" if described.serial else "no serial number"
    return ", ".join(
        [described.axis, *where, serial, *([f"firmware {described.firmware}"] if described.firmware else [])]
    )
