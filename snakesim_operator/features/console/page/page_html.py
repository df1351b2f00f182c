"""The texts of the page, as HTML. Pure; everything that comes from the network is escaped."""

from collections.abc import Iterable
from html import escape

from snakesim_hal.base.terminal import escape_invisible
from snakesim_hal.wire.messages import RobotDescription, RobotStatus
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

MAX_SILENCE_S = 1.0  # a host publishes its status more often, so a longer silence is an alarm
MAX_BACKEND_CHARACTERS = 12  # of a backend's name, so that it cannot fill the bar

# Colors that can be read on a light and on a dark page.
BAD = "#d64541"  # of text about a fault or an alarm
LIFECYCLE_COLORS = {
    "disarmed": "#6b7683",
    "armed": "#1a7f4b",
    "fault": "#b3261e",
    "estop": "#b3261e",
}
CONTROL_STATE_COLORS = {
    "Locomoting": "#1a7f4b",
    "NotLocomoting": "#b26a00",
    "Idle": "#6b7683",
    "PowerOff": "#59626d",
}
# Colors of the bar that shows what moves.
SIMULATED_COLOR = "#0067b0"
EMULATED_COLOR = "#7a3fa8"
REAL_COLOR = "#b3261e"
RECORDED_COLOR = "#59626d"  # also while nothing moves

SIGNALS = (
    "<iframe src='signals?within' title='Signals' loading='lazy' style='border:0;width:100%;height:60vh'></iframe>"
    "<a href='signals' target='_blank' style='padding:0 .6em;font-size:.85em'>Signals in a page of their own</a>"
)


def escape_text(text: object) -> str:
    """Return text from any source such that it is harmless in a page."""
    return escape(escape_invisible(str(text)))


def choose_backend_label(robot: RobotDescription) -> tuple[str, str]:
    """Return the label for what moves, a real, emulated or simulated robot, and the label's color."""
    backend_name = robot.backend.upper()[:MAX_BACKEND_CHARACTERS]
    if not robot.emulated:  # whatever the backend is called
        return f"REAL ROBOT ON {backend_name}", REAL_COLOR
    if robot.backend == "sim":
        return "EMULATED BY A SIMULATOR", SIMULATED_COLOR
    return f"EMULATED ROBOT ON {backend_name}", EMULATED_COLOR


def format_header(snapshot: RobotSnapshot | None, *, recorded: str = "", control: str = "") -> str:
    """Format the header of the page as HTML: which backend, which state, and the reason for the state.

    Args:
        snapshot: The newest snapshot of the robot; None while no robot is known.
        recorded: Name of the recording that is shown; empty for a live robot.
        control: Text that names the viewer in control; empty to leave it out.
    """
    if snapshot is None:
        return _format_bar(
            "WAITING FOR THE ROBOT", RECORDED_COLOR, "no host has described itself yet"
        )
    if snapshot.expected:
        name = escape_text(snapshot.robot.robot)
        return _format_bar(
            "WAITING FOR THE ROBOT", RECORDED_COLOR, f"{name}, drawn as its scenario places it"
        )
    html_lines = [_format_backend_bar(snapshot.robot, recorded), *_list_alarms(snapshot)]
    status = snapshot.status
    if status is not None:
        html_lines.append(
            _format_state(
                status.lifecycle.upper(), LIFECYCLE_COLORS[status.lifecycle], status.reason, ".45em"
            )
        )
    control_state = snapshot.control
    if control_state is not None:
        state_color = CONTROL_STATE_COLORS[control_state.state]
        html_lines.append(
            _format_state(control_state.state, state_color, control_state.reason, ".35em")
        )
    if control:
        html_lines.append(
            f"<div style='opacity:.75;font-size:.85em;margin-top:.35em'>{escape_text(control)}</div>"
        )
    return f"<div data-robot style='padding:0 .6em .2em;font-size:.9em;line-height:1.35'>{''.join(html_lines)}</div>"


def _format_backend_bar(robot: RobotDescription, recorded: str) -> str:
    """Return the bar that distinguishes a real robot from an emulated one, and a recording from a live robot."""
    label, color = choose_backend_label(robot)
    robot_text = escape_text(robot.robot)
    if robot.hardware:
        robot_text += f" · {escape_text(robot.hardware)}"
    if recorded:
        label = f"RECORDING OF: {label}"
        color = RECORDED_COLOR
        robot_text += f" · {escape_text(recorded)}"
    return _format_bar(label, color, robot_text)


def _list_alarms(snapshot: RobotSnapshot) -> list[str]:
    """Return what a viewer must know before trusting the rest of the page."""
    lines: list[str] = []
    status = snapshot.status
    if status is not None and status.paused_by is not None:
        lines.append(
            _format_bar(
                "PAUSED",
                RECORDED_COLOR,
                f"by {escape_text(status.paused_by)}; robot time is paused",
            )
        )
    if len(snapshot.hosts) > 1:
        lines.append(
            _format_warning(
                "IMPOSTOR: more than one host publishes a status under this name. Trust none of them."
            )
        )
    if snapshot.time_since_status_s > MAX_SILENCE_S:
        lines.append(
            _format_warning(
                f"NO ANSWER for {snapshot.time_since_status_s:.0f} s. What is shown is old."
            )
        )
    return lines


def _format_state(word: str, color: str, reason: str, margin_top: str) -> str:
    """Format a state as a word on a color, with the reason next to it. `margin_top` is a CSS length."""
    return (
        f"<div style='display:flex;gap:.5em;align-items:baseline;margin-top:{margin_top}'>"
        f"<span style='background:{color};color:#fff;border-radius:4px;padding:.05em .5em;font-weight:600;"
        f"white-space:nowrap'>{escape_text(word)}</span><span>{escape_text(reason)}</span></div>"
    )


def _format_bar(words: str, color: str, below: str) -> str:
    """Return words in large letters on a color, with smaller HTML below them."""
    return (
        f"<div style='background:{color};color:#fff;border-radius:6px;padding:.35em .6em;margin:.3em .6em .3em .3em'>"
        f"<div style='font-size:1.3em;font-weight:700;letter-spacing:.03em'>{escape_text(words)}</div>"
        f"<div style='opacity:.9'>{below}</div></div>"
    )


def _format_warning(text: str) -> str:
    return (
        f"<div style='border:2px solid {BAD};color:{BAD};border-radius:6px;padding:.3em .6em;margin-top:.4em;"
        f"font-weight:600'>{escape_text(text)}</div>"
    )


def format_state_table(snapshot: RobotSnapshot) -> str:
    """Return a table of lease, commands, warnings and health, and the list of faults below it."""
    rows: list[tuple[str, str]] = []
    if snapshot.status is not None:
        rows += _list_status_rows(snapshot.status, snapshot.time_s)
        rows += _list_warning_rows(snapshot.status)
    rows += _list_health_rows(snapshot)
    return format_table(rows) + format_faults(snapshot.status)


def _list_status_rows(status: RobotStatus, time_s: float | None) -> list[tuple[str, str]]:
    """Return the rows that every status has."""
    robot_time = "" if time_s is None else f"{time_s:.2f} s · "
    return [
        (
            "robot time",
            f"{robot_time}tick {status.tick}, {status.clock_mode} at {status.rate_hz:g} Hz",
        ),
        ("lease", f"{escape_text(status.lease_holder or 'free')} (epoch {status.lease_epoch})"),
        ("alive", escape_text(", ".join(status.alive) or "none")),
        (
            "commands",
            f"{status.commands_accepted} accepted, {status.commands_standby} while disarmed",
        ),
        ("rejected", _format_counts(status.commands_rejected)),
        ("limited", _format_counts(status.commands_limited)),
        ("overruns", f"{status.overruns}"),
    ]


def _list_warning_rows(status: RobotStatus) -> list[tuple[str, str]]:
    """Return the rows that are shown only when they have something to report."""
    rows: list[tuple[str, str]] = []
    if status.real_time_factor is not None:
        rows.append(("speed", _format_speed(status)))
    if status.waiting_for:
        rows.append(("waiting for", escape_text(", ".join(status.waiting_for))))
    for joint, fraction in sorted(status.derated.items()):
        rows.append(("derated", escape_text(f"{joint}: {100 * fraction:.0f} %")))
    if status.isolated:
        rows.append(("isolated", escape_text(", ".join(status.isolated))))
    if status.unchecked:
        rows.append(("not checked", escape_text(status.unchecked)))
    rows += [("injected", escape_text(fault)) for fault in status.injected]
    rows += [("real time", escape_text(warning)) for warning in status.realtime_warnings]
    return rows


def _format_speed(status: RobotStatus) -> str:
    wanted = f", {status.speed:g} wanted" if status.speed != 1.0 else ""
    return f"{status.real_time_factor:.2f} of the wall clock{wanted}"


def format_faults(status: RobotStatus | None) -> str:
    """Return the faults since the last reset as a list; empty when there are none."""
    if status is None or not status.faults:
        return ""
    items: list[str] = []
    for fault in status.faults:
        place = f" at {escape_text(fault.joint)}" if fault.joint else ""
        cause = escape_text(fault.cause)
        items.append(
            f"<li><b>{escape_text(fault.what)}</b>{place}, tick {fault.tick}: {cause}</li>"
        )
    if status.faults_left_out:
        items.append(f"<li>and {status.faults_left_out} more</li>")
    style = f"padding:0 .6em;font-size:.85em;color:{BAD}"
    return f"<div style='{style}'>Faults<ul>{''.join(items)}</ul></div>"


def _list_health_rows(snapshot: RobotSnapshot) -> list[tuple[str, str]]:
    """Return the rows about temperatures, supply and leaks."""
    power = snapshot.power
    joints = snapshot.robot.joints
    if power is None or not power.motor_c:
        return []
    hottest = max(range(len(joints)), key=lambda joint_index: power.motor_c[joint_index])
    rows = [
        ("hottest motor", f"{escape_text(joints[hottest].name)}: {power.motor_c[hottest]:.1f} °C"),
        ("boards", f"up to {max(power.board_c):.1f} °C"),
        ("supply", f"{min(power.voltage_v):.1f} V at least, {sum(power.current_a):.2f} A in sum"),
    ]
    wet = [joint.name for joint, has_leak in zip(joints, power.leak, strict=True) if has_leak]
    if wet:
        rows.append(("WATER", escape_text(", ".join(wet))))
    return rows


def format_stream_table(snapshot: RobotSnapshot) -> str:
    """Return a table of the rate and the age of each key."""
    rows: list[tuple[str, str]] = []
    for key, stream in sorted(snapshot.streams.items()):
        text = f"{stream.rate_hz:.0f} Hz"
        if stream.age_s:
            text += f", {stream.age_s * 1e3:.0f} ms old"
        rows.append((escape_text(key), text))
    return format_table(rows)


def format_log(lines: Iterable[str]) -> str:
    """Return the lines of the log as HTML, in the order given."""
    items = "".join(f"<div style='padding:.1em 0'>{escape_text(line)}</div>" for line in lines)
    return (
        f"<div style='padding:0 .6em;font-size:.82em;max-height:22em;overflow-y:auto'>{items}</div>"
    )


def format_legend(entries: Iterable[tuple[str, tuple[int, int, int]]]) -> str:
    """Return the legend of the scene's colors."""
    marks = "".join(
        f"<span style='white-space:nowrap'><span style='color:rgb{color}'>&#9632;</span> {escape_text(what)}</span> "
        for what, color in entries
    )
    return f"<div style='padding:.2em .6em .9em;font-size:.82em;display:flex;flex-wrap:wrap;gap:.2em 1em'>{marks}</div>"


def _format_counts(counts: dict[str, int]) -> str:
    """Return how often each reason occurred."""
    parts = [f"{reason} {count}" for reason, count in sorted(counts.items())]
    return escape_text(", ".join(parts) or "none")


def format_table(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and values; both are HTML already."""
    cells = "".join(
        f"<tr><td style='opacity:.7;padding-right:.8em;white-space:nowrap;vertical-align:top'>{name}</td>"
        f"<td style='overflow-wrap:anywhere'>{value}</td></tr>"
        for name, value in rows
    )
    return f"<table style='font-size:.85em;margin:0 .6em;line-height:1.4'>{cells}</table>"
