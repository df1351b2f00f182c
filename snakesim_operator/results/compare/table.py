"""Formats the comparison of two runs as text for a terminal, and as plain values for JSON."""

from typing import Any

import numpy as np

from snakesim_operator.results.compare.difference import (
    QuantityDifference,
    RunDifference,
    format_joint_order,
)
from snakesim_operator.results.compare.settings import SettingDifference, find_drive_differences
from snakesim_operator.results.compare.verdict import (
    SAME_TEXT,
    describe_difference,
    describe_relative_distance,
)
from snakesim_operator.results.metrics.propulsion import PropulsionInterval

NAME_WIDTH = 24
VALUE_WIDTH = 22
MAX_SETTINGS_SHOWN = 16
MAX_HAND_OVERS_SHOWN = 8


def format_comparison(difference: RunDifference) -> list[str]:
    """Format the comparison of two runs as lines of text for a terminal.

    Args:
        difference: The comparison of the runs A and B.

    Returns:
        Sections with an empty line between them: the runs, the settings that differ, the distances, the hand-overs
        between controllers, the differences of angles, speeds and torques, a row for each joint, and a
        summary in sentences.
    """
    common_s = difference.aligned.time_s[-1]
    difference_heading = (
        f"  {'B - A':<{NAME_WIDTH}}{'RMS':<{VALUE_WIDTH}}{'worst':<{VALUE_WIDTH}}where and when"
    )
    lines = [_format_row("", "A", "B"), *_format_identifying_settings(difference)]
    lines += ["", *_format_differing_settings(difference.differing_settings)]
    if difference.drive_difference:
        lines.append(difference.drive_difference)
    lines += [
        "",
        f"over {common_s:.2f} s from the first arming, {difference.aligned.sampling_description}",
    ]
    lines += _format_distance(difference)
    lines += _format_controller_handovers(difference)
    lines += ["", difference_heading]
    lines += [
        _format_quantity_difference(quantity_difference, difference.joints)
        for quantity_difference in difference.quantities
    ]
    lines += _format_torques_and_tracking(difference)
    lines += ["", *_format_joint_rows(difference)]
    lines += ["", *describe_difference(difference)]
    return [line.rstrip() for line in lines]


def make_json_values(difference: RunDifference) -> dict[str, Any]:
    """Convert the comparison of two runs to plain values that can be encoded as JSON.

    Args:
        difference: The comparison of the runs A and B.

    Returns:
        The values by name. An unknown value is None.
    """
    joint_names = difference.joints
    moved = None
    advance = difference.advance
    if advance is not None:
        moved = {"a": advance.a_m, "b": advance.b_m, "percent": advance.percent}
    divergence = None
    first_divergence = difference.divergence
    if first_divergence is not None:
        divergence = {
            "joint": joint_names[first_divergence.joint],
            "time_s": first_divergence.time_s,
        }
    settings = {
        setting.key: {"a": setting.a, "b": setting.b} for setting in difference.differing_settings
    }
    return {
        "identical": difference.is_identical,
        "missing": {"a": difference.a.missing, "b": difference.b.missing},
        "command_digest": {
            "a": difference.a.host.command_digest,
            "b": difference.b.host.command_digest,
        },
        "settings": settings,
        "drives": find_drive_differences(difference.a, difference.b),
        "time_s": float(difference.aligned.time_s[-1]),
        "moved_m": moved,
        "gaps": [_make_quantity_values(gap, joint_names) for gap in difference.quantities],
        "by_joint": _make_joint_values(difference),
        "divergence": divergence,
        "hand_overs": {
            "a": _make_hand_over_values(difference.hand_overs.a, joint_names),
            "b": _make_hand_over_values(difference.hand_overs.b, joint_names),
        },
    }


def _make_quantity_values(gap: QuantityDifference, joints: list[str]) -> dict[str, Any]:
    worst = gap.max_difference
    return {
        "what": gap.quantity,
        "unit": gap.unit,
        "rms": gap.rms,
        "worst": None if worst is None else worst.difference,
        "joint": None if worst is None else joints[worst.joint],
        "time_s": None if worst is None else worst.time_s,
    }


def _make_joint_values(difference: RunDifference) -> dict[str, dict[str, float | None]]:
    """Return lag, gain and RMS of the angle of each joint by name, as plain values."""
    values: dict[str, dict[str, float | None]] = {}
    for name, rms, fit in zip(
        difference.joints,
        difference.angle.rms_by_joint,
        difference.lag_and_gain_by_joint,
        strict=True,
    ):
        values[name] = {
            "angle_rms_rad": None if np.isnan(rms) else float(rms),
            "lag_s": None if fit is None else fit.lag_s,
            "gain": None if fit is None else fit.gain,
            "left_rad": None if fit is None else fit.residual_rms,
        }
    return values


def _make_hand_over_values(
    periods: list[PropulsionInterval], joints: list[str]
) -> list[dict[str, Any]]:
    return [{"joint": joints[period.joint_index], "time_s": period.start_s} for period in periods]


def _format_row(name: str, a: str, b: str, note: str = "") -> str:
    return f"  {name:<{NAME_WIDTH}}{a:<{VALUE_WIDTH}}{b:<{VALUE_WIDTH}}{note}"


def _format_identifying_settings(difference: RunDifference) -> list[str]:
    """Format the rows that identify both runs: main settings, faults, missing data and command digest."""
    lines: list[str] = []
    for setting in difference.identifying_settings:
        note = "differs" if setting.a != setting.b else ""
        lines.append(_format_row(setting.key, _shorten(setting.a), _shorten(setting.b), note))
    host_a = difference.a.host
    host_b = difference.b.host
    lines.append(_format_row("faults", str(len(host_a.faults)), str(len(host_b.faults))))
    for name, record in (("A", difference.a), ("B", difference.b)):
        lines += [f"  not known of {name}: {sentence}" for sentence in record.missing]
    digest_a = host_a.command_digest[:16]
    digest_b = host_b.command_digest[:16]
    lines.append(
        _format_row(
            "command digest", digest_a, digest_b, "the same" if digest_a == digest_b else ""
        )
    )
    return lines


def _format_differing_settings(settings: list[SettingDifference]) -> list[str]:
    """Format the rows of the settings that differ, at most MAX_SETTINGS_SHOWN of them."""
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


def _format_distance(difference: RunDifference) -> list[str]:
    advance = difference.advance
    if advance is None:
        return [_format_row("moved", "unknown", "unknown", "no measure that both have")]
    note = describe_relative_distance(advance)
    if note != SAME_TEXT:
        note = f"{advance.difference_m:+.3f} m, {note}"
    return [
        _format_row("moved", f"{advance.a_m:.3f} m", f"{advance.b_m:.3f} m", note),
        f"    ({advance.measure})",
    ]


def _format_controller_handovers(difference: RunDifference) -> list[str]:
    """Format the rows about the order in which joints propelled the robot.

    A hand-over is the time at which a joint begins to propel instead of the one before. For each hand-over to the same
    joint in both runs, a row gives the joint, the time in A, the time in B, and the delay of B, which is negative if B
    was earlier. If the order of the joints differs after these, two more rows name the joints that followed.
    """
    hand_overs = difference.hand_overs
    joint_names = difference.joints
    if hand_overs.unknown_reason:
        return [f"  {'propulsion joints':<{NAME_WIDTH}}{hand_overs.unknown_reason}"]
    if not hand_overs.a and not hand_overs.b:
        return ["  no joint propelled in either"]

    lines = [
        _format_row(
            "propulsion joints", f"{len(hand_overs.a)} in a row", f"{len(hand_overs.b)} in a row"
        )
    ]
    for i, delay_s in enumerate(hand_overs.delays_s[:MAX_HAND_OVERS_SHOWN]):
        in_a = hand_overs.a[i]
        in_b = hand_overs.b[i]
        name = f"  {joint_names[in_a.joint_index]}"
        lines.append(
            _format_row(name, f"{in_a.start_s:.2f} s", f"{in_b.start_s:.2f} s", f"{delay_s:+.2f} s")
        )
    hidden_count = hand_overs.common_count - MAX_HAND_OVERS_SHOWN
    if hidden_count > 0:
        lines.append(
            f"    and {hidden_count} more that agree; the last is {hand_overs.delays_s[-1]:+.2f} s"
        )
    if not hand_overs.has_same_order:
        rest_a = hand_overs.a[hand_overs.common_count :]
        rest_b = hand_overs.b[hand_overs.common_count :]
        lines.append(f"    from there on A: {format_joint_order(joint_names, rest_a)}")
        lines.append(f"    from there on B: {format_joint_order(joint_names, rest_b)}")
    return lines


def _format_quantity_difference(gap: QuantityDifference, joints: list[str]) -> str:
    if gap.rms is None or gap.max_difference is None:
        return f"  {gap.quantity:<{NAME_WIDTH}}unknown"
    worst = gap.max_difference
    if gap.is_same:
        return f"  {gap.quantity:<{NAME_WIDTH}}the same for every joint at every time"
    if not worst.difference:
        return f"  {gap.quantity:<{NAME_WIDTH}}the same where it is known"
    location = f"{joints[worst.joint]} at {worst.time_s:.2f} s, A {worst.a:+.3f}, B {worst.b:+.3f}"
    rms = f"{gap.rms:.4f} {gap.unit}"
    max_difference = f"{worst.difference:+.4f} {gap.unit}"
    return f"  {gap.quantity:<{NAME_WIDTH}}{rms:<{VALUE_WIDTH}}{max_difference:<{VALUE_WIDTH}}{location}"


def _format_joint_rows(difference: RunDifference) -> list[str]:
    """Format a row for each joint: how much later and larger its angle in B is than in A."""
    joint_head = f"{'angle by joint':<{NAME_WIDTH}}"
    value_heads = f"{'RMS of B - A':<{VALUE_WIDTH}}{'B later by':<{VALUE_WIDTH}}"
    lines = [f"  {joint_head}{value_heads}gain, and RMS left"]
    for name, rms, fit in zip(
        difference.joints,
        difference.angle.rms_by_joint,
        difference.lag_and_gain_by_joint,
        strict=True,
    ):
        apart = "unknown" if np.isnan(rms) else f"{rms:.5f} rad"
        lag = "unknown"
        rest = ""
        if fit is not None:
            lag = f"{1000 * fit.lag_s:+.2f} ms"
            rest = f"{fit.gain:.4f}, {fit.residual_rms:.5f} rad"
        lines.append(f"  {name:<{NAME_WIDTH}}{apart:<{VALUE_WIDTH}}{lag:<{VALUE_WIDTH}}{rest}")
    return lines


def _format_torques_and_tracking(difference: RunDifference) -> list[str]:
    lines: list[str] = []
    if difference.torque.correlation is not None:
        lines.append(f"  torques correlate by {difference.torque.correlation:.3f}")
    tracking = [
        f"{error:.4f} rad" if error is not None else "unknown"
        for error in difference.tracking_errors_rad
    ]
    lines.append(
        f"  angle off its own target, RMS in position mode: A {tracking[0]}, B {tracking[1]}"
    )
    if difference.other_mode_fraction:
        lines.append(
            f"  joints in another mode: {100 * difference.other_mode_fraction:.1f} % of the time; targets are not "
            "compared there"
        )
    return lines


def _shorten(value: str) -> str:
    return value if len(value) < VALUE_WIDTH else value[: VALUE_WIDTH - 4] + "..."
