# ruff: noqa: E501 - a change stands here as the tool prints it
"""Mutants that behave like the original, and why no test can tell: (file, function, change) -> reason."""

_SAME_LENGTHS = "a second net: refuse() and observe() let no vector of another length through"
_AT_THE_BOUND = "a value at the bound is the bound, whichever branch returns it"
_A_SUM = "renewed() adds the two: their order does not matter"
_ROUNDED = "one part in a million, in a text that is rounded to whole milliseconds"
_BELOW_A_NANOSECOND = "a delay that counts is below a lease, and this changes it by less than a nanosecond"
_SET_BEFORE_USE = "whatever reads it is preceded by a change of lifecycle or lease that sets it; here it is declared"
_ONLY_COMPARED = "zeros as whole or as real numbers: the first modes are only ever compared"
_IN_ANY_ORDER = "the greater of two, or the middle of three with a low below a high, does not depend on the order"

EQUIVALENT: dict[tuple[str, str, str], str] = {
    (
        "arming.py",
        "far_targets",
        "True -> False in `for joint, mode, target, angle in zip(description.joints, command.mode, command.target, angle_rad.tolist(), strict=True):`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "limit",
        "True -> False in `for asked, joint, held in zip(asked_limits, limits.joints, last.torque_limit_nm.tolist(), strict=True):`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "limit",
        "True -> False in `before = zip(last.mode.tolist(), last.target.tolist(), strict=True)`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "limit",
        "True -> False in `now = zip(measured.angle_rad.tolist(), measured.velocity_rad_s.tolist(), measured.torque_nm.tolist(), strict=True)`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "limit",
        "True -> False in `for joint, mode, wanted, torque_limit, (last_mode, last_target), (angle, velocity, torque) in zip(limits.joints, command.mode, command.target, torque_limits, before, now, strict=True):`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "_within",
        "value < low -> value <= low in `return low if value < low else high if value > high else value`",
    ): _AT_THE_BOUND,
    (
        "gate.py",
        "_within",
        "value > high -> value >= high in `return low if value < low else high if value > high else value`",
    ): _AT_THE_BOUND,
    ("lease.py", "rule", "1000000.0 -> 1000001.0 in `left_ms = (lease.expires_ns - now_ns) / 1000000.0`"): _ROUNDED,
    ("lease.py", "rule", "1000000.0 -> 999999.0 in `left_ms = (lease.expires_ns - now_ns) / 1000000.0`"): _ROUNDED,
    (
        "lease.py",
        "rule",
        "renewed(lease, now_ns, term_ns) -> renewed(lease, term_ns, now_ns) in `return Ruling(renewed(lease, now_ns, term_ns))`",
    ): _A_SUM,
    (
        "authority.py",
        "Authority.__init__",
        "Applied(np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm) -> Applied(np.zeros(count), np.zeros(count, dtype=np.int64), self.limits.torque_nm) in `self._applied = Applied(np.zeros(count, dtype=np.int64), np.zeros(count), self.limits.torque_nm)`",
    ): _ONLY_COMPARED,
    ("authority.py", "Authority.__init__", "self._command_ns = 0 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> 1 in `self._command_ns = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> -1 in `self._command_ns = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._last_sequence = -1 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "-1 -> +1 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 2 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 0 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._hold_at = np.zeros(count) -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._was_armed = False -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "False -> True in `self._was_armed = False`"): _SET_BEFORE_USE,
    (
        "authority.py",
        "Authority.offer",
        "renewed(self.lease, now_ns, self.description.lease_ns) -> renewed(self.lease, self.description.lease_ns, now_ns) in `self.lease = renewed(self.lease, now_ns, self.description.lease_ns)`",
    ): _A_SUM,
    (
        "authority.py",
        "Authority.on_lifecycle",
        "renewed(self.lease, now_ns, self.description.lease_ns) -> renewed(self.lease, self.description.lease_ns, now_ns) in `self.lease = renewed(self.lease, now_ns, self.description.lease_ns)`",
    ): _A_SUM,
    (
        "halting.py",
        "Halt.begin",
        "True -> False in `states = zip(limits.joints, angle.tolist(), velocity.tolist(), measured.torque_nm.tolist(), strict=True)`",
    ): _SAME_LENGTHS,
    (
        "halting.py",
        "Halt.begin",
        "np.clip(target, angle - limits.max_step_rad, angle + limits.max_step_rad) -> np.clip(angle - limits.max_step_rad, target, angle + limits.max_step_rad) in `near = np.clip(target, angle - limits.max_step_rad, angle + limits.max_step_rad)`",
    ): _IN_ANY_ORDER,
    (
        "halting.py",
        "Halt.begin",
        "np.clip(velocity, -limits.speed_rad_s, limits.speed_rad_s) -> np.clip(-limits.speed_rad_s, velocity, limits.speed_rad_s) in `slowed = np.clip(velocity, -limits.speed_rad_s, limits.speed_rad_s)`",
    ): _IN_ANY_ORDER,
    (
        "halting.py",
        "Halt.after_a_period",
        "np.maximum(np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0) -> np.maximum(0.0, np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s) in `slower = np.maximum(np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0)`",
    ): _IN_ANY_ORDER,
    (
        "halting.py",
        "Halt.after_a_period",
        "np.clip(wanted, self.target_rad - step, self.target_rad + step) -> np.clip(self.target_rad - step, wanted, self.target_rad + step) in `target = np.clip(wanted, self.target_rad - step, self.target_rad + step)`",
    ): _IN_ANY_ORDER,
    (
        "halting.py",
        "Halt",
        "True -> False in `@dataclass(frozen=True)`",
    ): "nobody assigns to it; that nobody may is for the reader",
    (
        "gate.py",
        "JointLimits.inside",
        "np.clip(angle_rad, self.angle_min_rad, self.angle_max_rad) -> np.clip(self.angle_min_rad, angle_rad, self.angle_max_rad) in `return np.clip(angle_rad, self.angle_min_rad, self.angle_max_rad)`",
    ): _IN_ANY_ORDER,
    (
        "gate.py",
        "_oldest_state_ns",
        "1000000000.0 -> 1000000001.0 in `return min(fresh_ns + round(delay_s * 1000000000.0), description.lease_ns)`",
    ): _BELOW_A_NANOSECOND,
    (
        "gate.py",
        "_oldest_state_ns",
        "1000000000.0 -> 999999999.0 in `return min(fresh_ns + round(delay_s * 1000000000.0), description.lease_ns)`",
    ): _BELOW_A_NANOSECOND,
}
