"""The comparison as text, for a terminal."""

from typing import Any

import numpy as np

from snakesim_operator.results.compare.difference import Difference, Gap, order
from snakesim_operator.results.compare.settings import Setting, drive_identities
from snakesim_operator.results.compare.verdict import SAME, relation, sentences

NAME, VALUE = 24, 22
SETTINGS_SHOWN = 16
HAND_OVERS_SHOWN = 8


def table(difference: Difference) -> list[str]:
    """Everything that the page shows in numbers, in lines."""
    lines = [
        _row("", "A", "B"),
        *_compared(difference),
        "",
        *_settings(difference.settings),
        *filter(None, [difference.drives]),
        "",
        f"over {difference.aligned.time_s[-1]:.2f} s from the first arming, {difference.aligned.how}",
        *_distance(difference),
        *_hand_overs(difference),
        "",
        f"  {'B - A':<{NAME}}{'RMS':<{VALUE}}{'worst':<{VALUE}}where and when",
        *(_gap(gap, difference.joints) for gap in difference.gaps),
        *_beside(difference),
        "",
        *_by_joint(difference),
        "",
        *sentences(difference),
    ]
    return [line.rstrip() for line in lines]


def for_scripts(difference: Difference) -> dict[str, Any]:
    """The same numbers as plain values. Unknown is None."""
    advance, names, parted = difference.advance, difference.joints, difference.parted
    return {
        "identical": difference.identical,
        "lacks": {"a": difference.a.lacks, "b": difference.b.lacks},
        "command_digest": {"a": difference.a.host.command_digest, "b": difference.b.host.command_digest},
        "settings": {one.key: {"a": one.a, "b": one.b} for one in difference.settings},
        "drives": drive_identities(difference.a, difference.b),
        "time_s": float(difference.aligned.time_s[-1]),
        "moved_m": None if advance is None else {"a": advance.a_m, "b": advance.b_m, "percent": advance.percent},
        "gaps": [
            {
                "what": gap.what,
                "unit": gap.unit,
                "rms": gap.rms,
                "worst": None if gap.worst is None else gap.worst.difference,
                "joint": None if gap.worst is None else names[gap.worst.joint],
                "time_s": None if gap.worst is None else gap.worst.time_s,
            }
            for gap in difference.gaps
        ],
        "by_joint": {
            name: {
                "angle_rms_rad": None if np.isnan(rms) else float(rms),
                "lag_s": None if fit is None else fit.lag_s,
                "gain": None if fit is None else fit.gain,
                "left_rad": None if fit is None else fit.left,
            }
            for name, rms, fit in zip(names, difference.angle.joint_rms, difference.following, strict=True)
        },
        "parted": None if parted is None else {"joint": names[parted.joint], "time_s": parted.time_s},
        "hand_overs": {
            run: [{"joint": names[one.joint], "time_s": one.start_s} for one in order_of]
            for run, order_of in (("a", difference.hand_overs.a), ("b", difference.hand_overs.b))
        },
    }


def _row(name: str, a: str, b: str, note: str = "") -> str:
    return f"  {name:<{NAME}}{a:<{VALUE}}{b:<{VALUE}}{note}"


def _compared(difference: Difference) -> list[str]:
    lines = [
        _row(one.key, _short(one.a), _short(one.b), "differs" if one.a != one.b else "") for one in difference.compared
    ]
    hosts = (difference.a.host, difference.b.host)
    faults, digests = [str(len(host.faults)) for host in hosts], [host.command_digest[:16] for host in hosts]
    lines.append(_row("faults", faults[0], faults[1]))
    for name, record in (("A", difference.a), ("B", difference.b)):
        lines += [f"  not known of {name}: {lack}" for lack in record.lacks]
    lines.append(_row("command digest", digests[0], digests[1], "the same" if digests[0] == digests[1] else ""))
    return lines


def _settings(settings: list[Setting]) -> list[str]:
    if not settings:
        return ["no setting differs"]
    lines = [f"{len(settings)} {'setting differs' if len(settings) == 1 else 'settings differ'}"]
    width = max(len(one.key) for one in settings[:SETTINGS_SHOWN])
    lines += [f"  {one.key:<{width}}  {_short(one.a)} -> {_short(one.b)}" for one in settings[:SETTINGS_SHOWN]]
    if len(settings) > SETTINGS_SHOWN:
        lines.append(f"  and {len(settings) - SETTINGS_SHOWN} more, which the page lists")
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
    both, names = difference.hand_overs, difference.joints
    if both.unknown:
        return [f"  {'propulsion joints':<{NAME}}{both.unknown}"]
    if not both.a and not both.b:
        return ["  no joint propelled in either"]
    lines = [_row("propulsion joints", f"{len(both.a)} in a row", f"{len(both.b)} in a row")]
    for i, later_s in enumerate(both.later_s[:HAND_OVERS_SHOWN]):
        a, b = both.a[i], both.b[i]
        lines.append(_row(f"  {names[a.joint]}", f"{a.start_s:.2f} s", f"{b.start_s:.2f} s", f"{later_s:+.2f} s"))
    if both.agreed > HAND_OVERS_SHOWN:
        lines.append(f"    and {both.agreed - HAND_OVERS_SHOWN} more that agree; the last is {both.later_s[-1]:+.2f} s")
    if not both.same_order:
        lines.append(f"    from there on A: {order(names, both.a[both.agreed :])}")
        lines.append(f"    from there on B: {order(names, both.b[both.agreed :])}")
    return lines


def _gap(gap: Gap, joints: list[str]) -> str:
    if gap.rms is None or gap.worst is None:
        return f"  {gap.what:<{NAME}}unknown"
    worst = gap.worst
    if gap.same:
        return f"  {gap.what:<{NAME}}the same for every joint at every instant"
    if not worst.difference:
        return f"  {gap.what:<{NAME}}the same where it is known"
    where = f"{joints[worst.joint]} at {worst.time_s:.2f} s, A {worst.a:+.3f}, B {worst.b:+.3f}"
    rms, most = f"{gap.rms:.4f} {gap.unit}", f"{worst.difference:+.4f} {gap.unit}"
    return f"  {gap.what:<{NAME}}{rms:<{VALUE}}{most:<{VALUE}}{where}"


def _by_joint(difference: Difference) -> list[str]:
    """How B's angle follows A's, joint by joint."""
    lines = [f"  {'angle by joint':<{NAME}}{'RMS of B - A':<{VALUE}}{'B later by':<{VALUE}}{'gain, and RMS left'}"]
    for name, rms, fit in zip(difference.joints, difference.angle.joint_rms, difference.following, strict=True):
        apart = "unknown" if np.isnan(rms) else f"{rms:.5f} rad"
        lag, rest = (
            ("unknown", "") if fit is None else (f"{1000 * fit.lag_s:+.2f} ms", f"{fit.gain:.4f}, {fit.left:.5f} rad")
        )
        lines.append(f"  {name:<{NAME}}{apart:<{VALUE}}{lag:<{VALUE}}{rest}")
    return lines


def _beside(difference: Difference) -> list[str]:
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


def _short(value: str) -> str:
    return value if len(value) < VALUE else value[: VALUE - 4] + "..."
