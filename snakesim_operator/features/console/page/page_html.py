"""The texts of the console, as HTML. Everything that comes from the network is escaped. Pure."""

from collections.abc import Iterable
from html import escape

from snakesim_hal.base.terminal import printable
from snakesim_hal.wire.messages import Description, Status
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

SILENT_S = 1.0
LIFECYCLE_COLOURS = {"disarmed": "#6b7683", "armed": "#1a7f4b", "fault": "#b3261e", "estop": "#b3261e"}
STATE_COLOURS = {"Locomoting": "#1a7f4b", "NotLocomoting": "#b26a00", "Idle": "#6b7683", "PowerOff": "#59626d"}
BAD = "#d64541"  # of text, on a light and on a dark page
SIMULATED, EMULATED, REAL, RECORDED = "#0067b0", "#7a3fa8", "#b3261e", "#59626d"

SIGNALS = (
    "<iframe src='/signals?within' title='Signals' loading='lazy' style='border:0;width:100%;height:60vh'></iframe>"
    "<a href='/signals' target='_blank' style='padding:0 .6em;font-size:.85em'>Signals in a page of their own</a>"
)


def plain(text: object) -> str:
    """Text from anywhere, harmless in a page."""
    return escape(printable(str(text)))


def backend_in_words(robot: Description) -> tuple[str, str]:
    """Returns what moves, in large letters, and its color."""
    kind = robot.backend.upper()[:12]
    if not robot.emulated:  # whatever the backend is called
        return f"REAL ROBOT ON {kind}", REAL
    if robot.backend == "sim":
        return "EMULATED BY A SIMULATOR", SIMULATED
    return f"EMULATED ROBOT ON {kind}", EMULATED


def header(snapshot: RobotSnapshot | None, *, recorded: str = "", control: str = "") -> str:
    """The top of the page: which backend, which state, and why. control: who has it."""
    if snapshot is None:
        return _bar("WAITING FOR THE ROBOT", RECORDED, "no host has described itself yet")
    if snapshot.expected:
        return _bar(
            "WAITING FOR THE ROBOT", RECORDED, f"{plain(snapshot.robot.robot)}, drawn as its scenario places it"
        )
    words, color = backend_in_words(snapshot.robot)
    where = f"{plain(snapshot.robot.robot)}{' · ' + plain(snapshot.robot.hardware) if snapshot.robot.hardware else ''}"
    status = snapshot.status
    if recorded:
        words, color, where = f"RECORDING OF: {words}", RECORDED, f"{where} · {plain(recorded)}"
    lines = [_bar(words, color, where)]
    if status is not None and status.paused_by is not None:
        lines.append(_bar("PAUSED", RECORDED, f"by {plain(status.paused_by)}; robot time stands"))
    if len(snapshot.hosts) > 1:
        lines.append(_warning("IMPOSTOR: more than one host publishes a status under this name. Trust none of them."))
    if snapshot.silent_s > SILENT_S:
        lines.append(_warning(f"NO ANSWER for {snapshot.silent_s:.0f} s. What is shown is old."))
    if status is not None:
        lines.append(_state(status.lifecycle.upper(), LIFECYCLE_COLOURS[status.lifecycle], status.why, ".45em"))
    if (said := snapshot.control) is not None:
        lines.append(_state(said.state, STATE_COLOURS[said.state], said.reason, ".35em"))
    if control:
        lines.append(f"<div style='opacity:.75;font-size:.85em;margin-top:.35em'>{plain(control)}</div>")
    return f"<div data-robot style='padding:0 .6em .2em;font-size:.9em;line-height:1.35'>{''.join(lines)}</div>"


def _state(word: str, color: str, why: str, above: str) -> str:
    """A word on a color, and why."""
    return (
        f"<div style='display:flex;gap:.5em;align-items:baseline;margin-top:{above}'>"
        f"<span style='background:{color};color:#fff;border-radius:4px;padding:.05em .5em;font-weight:600;"
        f"white-space:nowrap'>{plain(word)}</span><span>{plain(why)}</span></div>"
    )


def _bar(words: str, color: str, below: str) -> str:
    return (
        f"<div style='background:{color};color:#fff;border-radius:6px;padding:.35em .6em;margin:.3em .6em .3em .3em'>"
        f"<div style='font-size:1.3em;font-weight:700;letter-spacing:.03em'>{plain(words)}</div>"
        f"<div style='opacity:.9'>{below}</div></div>"
    )


def _warning(text: str) -> str:
    return (
        f"<div style='border:2px solid {BAD};color:{BAD};border-radius:6px;padding:.3em .6em;margin-top:.4em;"
        f"font-weight:600'>{plain(text)}</div>"
    )


def state_table(snapshot: RobotSnapshot) -> str:
    """Lease, commands, faults, warnings, health."""
    status = snapshot.status
    rows: list[tuple[str, str]] = []
    if status is not None:
        time_s = "" if snapshot.time_s is None else f"{snapshot.time_s:.2f} s · "
        rows = [
            ("robot time", f"{time_s}tick {status.tick}, {status.clock_mode} at {status.rate_hz:g} Hz"),
            ("lease", f"{plain(status.lease_holder or 'free')} (epoch {status.lease_epoch})"),
            ("alive", plain(", ".join(status.alive) or "none")),
            ("commands", f"{status.commands_accepted} accepted, {status.commands_standby} while disarmed"),
            ("rejected", _counts(status.commands_rejected)),
            ("limited", _counts(status.commands_limited)),
            ("overruns", f"{status.overruns}"),
        ]
        rows += [("speed", _speed(status))] if status.real_time_factor is not None else []
        rows += [("waiting for", plain(", ".join(status.waiting_for)))] if status.waiting_for else []
        rows += [("derated", plain(f"{joint}: {100 * share:.0f} %")) for joint, share in sorted(status.derated.items())]
        rows += [("isolated", plain(", ".join(status.isolated)))] if status.isolated else []
        rows += [("not checked", plain(status.unchecked))] if status.unchecked else []
        rows += [("injected", plain(what)) for what in status.injected]
        rows += [("real time", plain(what)) for what in status.realtime_warnings]
    return table([*rows, *_health(snapshot)]) + faults(status)


def _speed(status: Status) -> str:
    wanted = f", {status.speed:g} wanted" if status.speed != 1.0 else ""
    return f"{status.real_time_factor:.2f} of the wall clock{wanted}"


def faults(status: Status | None) -> str:
    """The faults since the last clear."""
    if status is None or not status.faults:
        return ""
    items = [
        f"<li><b>{plain(fault.what)}</b>{' at ' + plain(fault.joint) if fault.joint else ''}, tick {fault.tick}: "
        f"{plain(fault.cause)}</li>"
        for fault in status.faults
    ]
    more = f"<li>and {status.faults_left_out} more</li>" if status.faults_left_out else ""
    return f"<div style='padding:0 .6em;font-size:.85em;color:{BAD}'>Faults<ul>{''.join(items)}{more}</ul></div>"


def _health(snapshot: RobotSnapshot) -> list[tuple[str, str]]:
    power, joints = snapshot.power, snapshot.robot.joints
    if power is None or not power.motor_c:
        return []
    hottest = max(range(len(joints)), key=lambda i: power.motor_c[i])
    rows = [
        ("hottest motor", f"{plain(joints[hottest].name)}: {power.motor_c[hottest]:.1f} °C"),
        ("boards", f"up to {max(power.board_c):.1f} °C"),
        ("supply", f"{min(power.voltage_v):.1f} V at least, {sum(power.current_a):.2f} A in sum"),
    ]
    wet = [joint.name for joint, leak in zip(joints, power.leak, strict=True) if leak]
    return [*rows, ("WATER", plain(", ".join(wet)))] if wet else rows


def stream_table(snapshot: RobotSnapshot) -> str:
    """Rates and ages of all keys."""
    rows = [
        (plain(key), f"{stream.rate_hz:.0f} Hz" + (f", {stream.age_s * 1e3:.0f} ms old" if stream.age_s else ""))
        for key, stream in sorted(snapshot.streams.items())
    ]
    return table(rows)


def log(lines: Iterable[str]) -> str:
    """The newest lines first."""
    items = "".join(f"<div style='padding:.1em 0'>{plain(line)}</div>" for line in lines)
    return f"<div style='padding:0 .6em;font-size:.82em;max-height:22em;overflow-y:auto'>{items}</div>"


def legend(entries: Iterable[tuple[str, tuple[int, int, int]]]) -> str:
    """What the colors of the scene mean."""
    marks = "".join(
        f"<span style='white-space:nowrap'><span style='color:rgb{color}'>&#9632;</span> {plain(what)}</span> "
        for what, color in entries
    )
    return f"<div style='padding:.2em .6em .9em;font-size:.82em;display:flex;flex-wrap:wrap;gap:.2em 1em'>{marks}</div>"


def _counts(numbers: dict[str, int]) -> str:
    return plain(", ".join(f"{word} {number}" for word, number in sorted(numbers.items())) or "none")


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values, which are HTML."""
    cells = "".join(
        f"<tr><td style='opacity:.7;padding-right:.8em;white-space:nowrap;vertical-align:top'>{name}</td>"
        f"<td style='overflow-wrap:anywhere'>{value}</td></tr>"
        for name, value in rows
    )
    return f"<table style='font-size:.85em;margin:0 .6em;line-height:1.4'>{cells}</table>"
