"""The comparison as text, for a terminal."""

from typing import Any

import numpy as np

from snakesim_operator.results.compare.difference import Difference, Gap, order_in_words
from snakesim_operator.results.compare.settings import Setting, drive_identities
from snakesim_operator.results.compare.verdict import SAME, relation, sentences
from snakesim_operator.results.metrics.propulsion import Propulsion

NAME_WIDTH = 24
VALUE_WIDTH = 22
MAX_SETTINGS_SHOWN = 16
MAX_HAND_OVERS_SHOWN = 8


def table(difference: Difference) -> list[str]:
    """Return the comparison of two runs as lines of text for a terminal.

    Args:
        difference: The comparison of the runs A and B.

    Returns:
        Sections with an empty line between them: the runs, the settings that differ, how far they came, the differences
        of angles, speeds and torques, a row for each joint, and sentences that sum up.
    """
    common_s = difference.aligned.time_s[-1]
    gap_heading = f"  {'B - A':<{NAME_WIDTH}}{'RMS':<{VALUE_WIDTH}}{'worst':<{VALUE_WIDTH}}where and when"
    lines = [_row("", "A", "B"), *_compared(difference)]
    lines += ["", *_settings(difference.settings)]
    if difference.drives:
        lines.append(difference.drives)
    lines += ["", f"over {common_s:.2f} s from the first arming, {difference.aligned.how}"]
    lines += _distance(difference)
    lines += _hand_overs(difference)
    lines += ["", gap_heading]
    lines += [_gap(gap, difference.joints) for gap in difference.gaps]
    lines += _torques_and_tracking(difference)
    lines += ["", *_by_joint(difference)]
    lines += ["", *sentences(difference)]
    return [line.rstrip() for line in lines]


def for_scripts(difference: Difference) -> dict[str, Any]:
    """Return the numbers of a comparison of two runs as plain values that JSON can hold.

    Args:
        difference: The comparison of the runs A and B.

    Returns:
        The values by name. A value that is unknown is None.
    """
    joint_names = difference.joints
    moved = None
    advance = difference.advance
    if advance is not None:
        moved = {"a": advance.a_m, "b": advance.b_m, "percent": advance.percent}
    divergence = None
    first_divergence = difference.divergence
    if first_divergence is not None:
        divergence = {"joint": joint_names[first_divergence.joint], "time_s": first_divergence.time_s}
    settings = {setting.key: {"a": setting.a, "b": setting.b} for setting in difference.settings}
    return {
        "identical": difference.identical,
        "missing": {"a": difference.a.missing, "b": difference.b.missing},
        "command_digest": {"a": difference.a.host.command_digest, "b": difference.b.host.command_digest},
        "settings": settings,
        "drives": drive_identities(difference.a, difference.b),
        "time_s": float(difference.aligned.time_s[-1]),
        "moved_m": moved,
        "gaps": [_gap_values(gap, joint_names) for gap in difference.gaps],
        "by_joint": _joint_values(difference),
        "divergence": divergence,
        "hand_overs": {
            "a": _hand_over_values(difference.hand_overs.a, joint_names),
            "b": _hand_over_values(difference.hand_overs.b, joint_names),
        },
    }


def _gap_values(gap: Gap, joints: list[str]) -> dict[str, Any]:
    worst = gap.worst
    return {
        "what": gap.what,
        "unit": gap.unit,
        "rms": gap.rms,
        "worst": None if worst is None else worst.difference,
        "joint": None if worst is None else joints[worst.joint],
        "time_s": None if worst is None else worst.time_s,
    }


def _joint_values(difference: Difference) -> dict[str, dict[str, float | None]]:
    """Return for each joint how B's angle follows A's."""
    values: dict[str, dict[str, float | None]] = {}
    for name, rms, fit in zip(difference.joints, difference.angle.joint_rms, difference.following, strict=True):
        values[name] = {
            "angle_rms_rad": None if np.isnan(rms) else float(rms),
            "lag_s": None if fit is None else fit.lag_s,
            "gain": None if fit is None else fit.gain,
            "left_rad": None if fit is None else fit.left,
        }
    return values


def _hand_over_values(periods: list[Propulsion], joints: list[str]) -> list[dict[str, Any]]:
    return [{"joint": joints[period.joint], "time_s": period.start_s} for period in periods]


def _row(name: str, a: str, b: str, note: str = "") -> str:
    return f"  {name:<{NAME_WIDTH}}{a:<{VALUE_WIDTH}}{b:<{VALUE_WIDTH}}{note}"


def _compared(difference: Difference) -> list[str]:
    """Return the rows by which people tell the runs apart."""
    lines: list[str] = []
    for setting in difference.compared:
        note = "differs" if setting.a != setting.b else ""
        lines.append(_row(setting.key, _shorten(setting.a), _shorten(setting.b), note))
    host_a = difference.a.host
    host_b = difference.b.host
    lines.append(_row("faults", str(len(host_a.faults)), str(len(host_b.faults))))
    for name, record in (("A", difference.a), ("B", difference.b)):
        lines += [f"  not known of {name}: {sentence}" for sentence in record.missing]
    digest_a = host_a.command_digest[:16]
    digest_b = host_b.command_digest[:16]
    lines.append(_row("command digest", digest_a, digest_b, "the same" if digest_a == digest_b else ""))
    return lines


def _settings(settings: list[Setting]) -> list[str]:
    """Return the rows of the settings that differ."""
    if not settings:
        return ["no setting differs"]
    verb = "setting differs" if len(settings) == 1 else "settings differ"
    lines = [f"{len(settings)} {verb}"]
    shown = settings[:MAX_SETTINGS_SHOWN]
    width = max(len(setting.key) for setting in shown)
    for setting in shown:
        lines.append(f"  {setting.key:<{width}}  {_shorten(setting.a)} -> {_shorten(setting.b)}")
    if len(settings) > MAX_SETTINGS_SHOWN:
        lines.append(f"  and {len(settings) - MAX_SETTINGS_SHOWN} more, which the page lists")
    return lines


def _distance(difference: Difference) -> list[str]:
    advance = difference.advance
    if advance is None:
        return [_row("moved", "unknown", "unknown", "no measure that both have")]
    note = relation(advance)
    if note != SAME:
        note = f"{advance.difference_m:+.3f} m, {note}"
    return [_row("moved", f"{advance.a_m:.3f} m", f"{advance.b_m:.3f} m", note), f"    ({advance.what})"]


def _hand_overs(difference: Difference) -> list[str]:
    """Return the rows about the order in which joints propelled the robot.

    A hand-over is the time at which a joint begins to propel instead of the one before. For each hand-over to the same
    joint in both runs, a row gives the joint, the time in A, the time in B, and the delay of B, which is negative if B
    was earlier. If the order of the joints differs after these, two more rows name the joints that followed.
    """
    hand_overs = difference.hand_overs
    joint_names = difference.joints
    if hand_overs.unknown:
        return [f"  {'propulsion joints':<{NAME_WIDTH}}{hand_overs.unknown}"]
    if not hand_overs.a and not hand_overs.b:
        return ["  no joint propelled in either"]

    lines = [_row("propulsion joints", f"{len(hand_overs.a)} in a row", f"{len(hand_overs.b)} in a row")]
    for i, delay_s in enumerate(hand_overs.delays_s[:MAX_HAND_OVERS_SHOWN]):
        in_a = hand_overs.a[i]
        in_b = hand_overs.b[i]
        name = f"  {joint_names[in_a.joint]}"
        lines.append(_row(name, f"{in_a.start_s:.2f} s", f"{in_b.start_s:.2f} s", f"{delay_s:+.2f} s"))
    hidden_count = hand_overs.common_count - MAX_HAND_OVERS_SHOWN
    if hidden_count > 0:
        lines.append(f"    and {hidden_count} more that agree; the last is {hand_overs.delays_s[-1]:+.2f} s")
    if not hand_overs.same_order:
        rest_a = hand_overs.a[hand_overs.common_count :]
        rest_b = hand_overs.b[hand_overs.common_count :]
        lines.append(f"    from there on A: {order_in_words(joint_names, rest_a)}")
        lines.append(f"    from there on B: {order_in_words(joint_names, rest_b)}")
    return lines


def _gap(gap: Gap, joints: list[str]) -> str:
    if gap.rms is None or gap.worst is None:
        return f"  {gap.what:<{NAME_WIDTH}}unknown"
    worst = gap.worst
    if gap.same:
        return f"  {gap.what:<{NAME_WIDTH}}the same for every joint at every time"
    if not worst.difference:
        return f"  {gap.what:<{NAME_WIDTH}}the same where it is known"
    where = f"{joints[worst.joint]} at {worst.time_s:.2f} s, A {worst.a:+.3f}, B {worst.b:+.3f}"
    rms = f"{gap.rms:.4f} {gap.unit}"
    most = f"{worst.difference:+.4f} {gap.unit}"
    return f"  {gap.what:<{NAME_WIDTH}}{rms:<{VALUE_WIDTH}}{most:<{VALUE_WIDTH}}{where}"


def _by_joint(difference: Difference) -> list[str]:
    """Return the rows that show how B's angle follows A's, joint by joint."""
    joint_head = f"{'angle by joint':<{NAME_WIDTH}}"
    value_heads = f"{'RMS of B - A':<{VALUE_WIDTH}}{'B later by':<{VALUE_WIDTH}}"
    lines = [f"  {joint_head}{value_heads}gain, and RMS left"]
    for name, rms, fit in zip(difference.joints, difference.angle.joint_rms, difference.following, strict=True):
        apart = "unknown" if np.isnan(rms) else f"{rms:.5f} rad"
        lag = "unknown"
        rest = ""
        if fit is not None:
            lag = f"{1000 * fit.lag_s:+.2f} ms"
            rest = f"{fit.gain:.4f}, {fit.left:.5f} rad"
        lines.append(f"  {name:<{NAME_WIDTH}}{apart:<{VALUE_WIDTH}}{lag:<{VALUE_WIDTH}}{rest}")
    return lines


def _torques_and_tracking(difference: Difference) -> list[str]:
    lines: list[str] = []
    if difference.torque.correlation is not None:
        lines.append(f"  torques correlate by {difference.torque.correlation:.3f}")
    tracking = [f"{error:.4f} rad" if error is not None else "unknown" for error in difference.tracking_rad]
    lines.append(f"  angle off its own target, RMS in position mode: A {tracking[0]}, B {tracking[1]}")
    if difference.other_mode:
        lines.append(
            f"  joints in another mode: {100 * difference.other_mode:.1f} % of the time; targets are not compared there"
        )
    return lines


def _shorten(value: str) -> str:
    return value if len(value) < VALUE_WIDTH else value[: VALUE_WIDTH - 4] + "..."
