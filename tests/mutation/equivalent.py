# ruff: noqa: E501 - a change stands here as the tool prints it
"""Mutants that behave like the original, and why no test can tell: (file, function, change) -> reason."""

_SAME_LENGTHS = "a second net: refuse() and observe() let no vector of another length through"
_AT_THE_BOUND = "a value at the bound is the bound, whichever branch returns it"
_A_SUM = "renewed() adds the two: their order does not matter"
_ROUNDED = "one part in a million, in a text that is rounded to whole milliseconds"
_BELOW_A_NANOSECOND = "a delay that counts is below a lease, and this changes it by less than a nanosecond"
_SET_BEFORE_USE = "whatever reads it is preceded by a change of lifecycle or lease that sets it; here it is declared"
_ONLY_COMPARED = "zeros as whole or as real numbers: the first modes are only ever compared"
_A_SHORTCUT = "a shortcut: the long way comes to the same, only later"
_THE_ONLY_ONE = "of a list with one entry the first is the last"
_NOT_READ_YET = "nothing reads it before a good state, or a sample, has replaced it"
_FOR_THE_READER = "nobody assigns to it; that nobody may is for the reader"
_MASKED = "it stands where a mask leaves it out, or never comes to five in a row"
_ROUGH = "the bound is a rough one, and no sum of floating-point numbers comes to rest exactly on it"
_BOTH = "both must hold, in whatever order they stand"
_IN_ANY_ORDER = "the greater of two, or the middle of three with a low below a high, does not depend on the order"

EQUIVALENT: dict[tuple[str, str, str], str] = {
    (
        "lifecycle.py",
        "far_targets",
        "True -> False in `for joint, mode, target, angle, passive in zip(description.joints, command.mode, command.target, angle_rad.tolist(), aside.tolist(), strict=True):`",
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
    ("authority.py", "Authority.__init__", "self._state_tick = 0 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> 1 in `self._state_tick = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> -1 in `self._state_tick = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._armed_tick = -1 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "-1 -> +1 in `self._armed_tick = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 2 in `self._armed_tick = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 0 in `self._armed_tick = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._command_ns = 0 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> 1 in `self._command_ns = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "0 -> -1 in `self._command_ns = 0`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._last_sequence = -1 -> (removed)"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "-1 -> +1 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 2 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "1 -> 0 in `self._last_sequence = -1`"): _SET_BEFORE_USE,
    ("authority.py", "Authority.__init__", "self._hold_at = np.zeros(count) -> (removed)"): _SET_BEFORE_USE,
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
        "stop_ramp.py",
        "StopRamp.begin",
        "True -> False in `states = zip(limits.joints, angle.tolist(), velocity.tolist(), measured.torque_nm.tolist(), strict=True)`",
    ): _SAME_LENGTHS,
    (
        "stop_ramp.py",
        "StopRamp.begin",
        "np.clip(target, angle - limits.max_step_rad, angle + limits.max_step_rad) -> np.clip(angle - limits.max_step_rad, target, angle + limits.max_step_rad) in `near = np.clip(target, angle - limits.max_step_rad, angle + limits.max_step_rad)`",
    ): _IN_ANY_ORDER,
    (
        "stop_ramp.py",
        "StopRamp.begin",
        "np.clip(velocity, -limits.speed_rad_s, limits.speed_rad_s) -> np.clip(-limits.speed_rad_s, velocity, limits.speed_rad_s) in `slowed = np.clip(velocity, -limits.speed_rad_s, limits.speed_rad_s)`",
    ): _IN_ANY_ORDER,
    (
        "stop_ramp.py",
        "StopRamp.after_a_period",
        "np.maximum(np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0) -> np.maximum(0.0, np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s) in `slower = np.maximum(np.abs(self.velocity_rad_s) - limits.acceleration_rad_s2 * period_s, 0.0)`",
    ): _IN_ANY_ORDER,
    (
        "stop_ramp.py",
        "StopRamp.after_a_period",
        "np.clip(wanted, self.target_rad - step, self.target_rad + step) -> np.clip(self.target_rad - step, wanted, self.target_rad + step) in `target = np.clip(wanted, self.target_rad - step, self.target_rad + step)`",
    ): _IN_ANY_ORDER,
    (
        "stop_ramp.py",
        "StopRamp",
        "True -> False in `@dataclass(frozen=True)`",
    ): _FOR_THE_READER,
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
    ("isolation.py", "Isolation.without", "if not self.indices: -> (removed)"): _A_SHORTCUT,
    ("isolation.py", "Isolation.without", "return applied -> (removed)"): _A_SHORTCUT,
    ("derating.py", "Derating.look", "if now_ns < self._due_ns: -> (removed)"): _A_SHORTCUT,
    ("derating.py", "Derating.look", "return ([], None) -> (removed)"): _A_SHORTCUT,
    (
        "derating.py",
        "Derating.look",
        "self._due_ns = min(min((health.due_ns(now_ns, began_ns) for health in self._healths)), now_ns + KNOWN_FOR_NS) -> (removed)",
    ): _A_SHORTCUT,
    (
        "derating.py",
        "Derating.look",
        "now_ns + KNOWN_FOR_NS -> now_ns - KNOWN_FOR_NS in `self._due_ns = min(min((health.due_ns(now_ns, began_ns) for health in self._healths)), now_ns + KNOWN_FOR_NS)`",
    ): _A_SHORTCUT,
    (
        "derating.py",
        "_Health.due_ns",
        "at_ns > now_ns -> at_ns >= now_ns in `return min((at_ns for at_ns in (silent_ns, low_ns) if at_ns > now_ns), default=math.inf)`",
    ): _A_SHORTCUT,
    ("plausibility.py", "PlausibilityCheck.take", "if not np.count_nonzero(~good | frozen): -> (removed)"): _A_SHORTCUT,
    ("plausibility.py", "PlausibilityCheck.take", "return None -> (removed)"): _A_SHORTCUT,
    ("plausibility.py", "_JumpDetector.settled", "if not np.count_nonzero(strayed): -> (removed)"): _A_SHORTCUT,
    ("plausibility.py", "_FrozenDetector.look", "if not np.count_nonzero(same): -> (removed)"): _A_SHORTCUT,
    ("plausibility.py", "_FrozenDetector.look", "return same -> (removed)"): _A_SHORTCUT,
    (
        "plausibility.py",
        "_FrozenDetector.__init__",
        "self._low_rad, self._high_rad = (np.zeros(count), np.zeros(count)) -> (removed)",
    ): _NOT_READ_YET,
    ("plausibility.py", "_FrozenDetector.__init__", "self._far_since_s = self._never_s -> (removed)"): _NOT_READ_YET,
    ("plausibility.py", "_JumpDetector.settled", "return strayed -> (removed)"): _A_SHORTCUT,
    (
        "derating.py",
        "Derating.take",
        "True -> False in `for health, volts, winding_c, leak, valid in zip(self._healths, *lists, strict=True):`",
    ): _SAME_LENGTHS,
    (
        "derating.py",
        "Derating.derated",
        "True -> False in `shares = zip(self._healths, self.share.tolist(), strict=True)`",
    ): _SAME_LENGTHS,
    (
        "plausibility.py",
        "PlausibilityCheck.take",
        "True -> False in `tails = [f' by {by:+.2f} rad in {within * 1000.0:.0f} ms' for by, within in zip(jump_rad, elapsed_s, strict=True)]`",
    ): _SAME_LENGTHS,
    (
        "plausibility.py",
        "PlausibilityCheck._doubt",
        "True -> False in `told = names if tails is None else [name + tails[i] for name, i in zip(names, found, strict=True)]`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "limit",
        "True -> False in `for asked, joint, cool, held in zip(asked_limits, limits.joints, most, last.torque_limit_nm.tolist(), strict=True):`",
    ): _SAME_LENGTHS,
    (
        "derating.py",
        "Derating._newly_silent",
        "0 -> -1 in `joint = fresh[0] if len(fresh) == 1 else None`",
    ): _THE_ONLY_ONE,
    (
        "plausibility.py",
        "PlausibilityCheck._doubt",
        "0 -> -1 in `joint = names[0] if len(names) == 1 else None`",
    ): _THE_ONLY_ONE,
    ("derating.py", "_Health", "winding_c: float = 0.0 -> (removed)"): _NOT_READ_YET,
    ("derating.py", "_Health", "0.0 -> 1.0 in `winding_c: float = 0.0`"): _NOT_READ_YET,
    ("derating.py", "_Health", "0.0 -> -1.0 in `winding_c: float = 0.0`"): _NOT_READ_YET,
    ("derating.py", "_Health", "voltage_v: float = 0.0 -> (removed)"): _NOT_READ_YET,
    ("derating.py", "_Health", "0.0 -> 1.0 in `voltage_v: float = 0.0`"): _NOT_READ_YET,
    ("derating.py", "_Health", "0.0 -> -1.0 in `voltage_v: float = 0.0`"): _NOT_READ_YET,
    ("derating.py", "_Health", "leak: bool = False -> (removed)"): _NOT_READ_YET,
    ("derating.py", "_Health", "False -> True in `leak: bool = False`"): _NOT_READ_YET,
    ("plausibility.py", "PlausibilityCheck.__init__", "2 -> 1 in `self._good_s = np.zeros((2, count))`"): _NOT_READ_YET,
    ("plausibility.py", "_JumpDetector.__init__", "2 -> 1 in `self._taken_s = np.zeros((2, count))`"): _NOT_READ_YET,
    ("plausibility.py", "Doubt", "True -> False in `@dataclass(frozen=True)`"): _FOR_THE_READER,
    ("thermal.py", "HeatLimits", "True -> False in `@dataclass(frozen=True)`"): _FOR_THE_READER,
    (
        "plausibility.py",
        "PlausibilityCheck.take",
        "0.0 -> 1.0 in `jump_rad = np.where(sound, columns[0], 0.0) - self._columns[0]`",
    ): _MASKED,
    (
        "plausibility.py",
        "PlausibilityCheck.take",
        "0.0 -> -1.0 in `jump_rad = np.where(sound, columns[0], 0.0) - self._columns[0]`",
    ): _MASKED,
    (
        "plausibility.py",
        "_JumpDetector.settled",
        "0.0 -> 1.0 in `follows = np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) <= self.reach_rad(elapsed_s.max(axis=0))`",
    ): _MASKED,
    (
        "plausibility.py",
        "_JumpDetector.settled",
        "0.0 -> -1.0 in `follows = np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) <= self.reach_rad(elapsed_s.max(axis=0))`",
    ): _MASKED,
    (
        "plausibility.py",
        "_JumpDetector.settled",
        "0.0 -> 1.0 in `self._angle_rad, self._taken_s = (np.where(strayed, angle_rad, 0.0), taken_s)`",
    ): _MASKED,
    (
        "plausibility.py",
        "_JumpDetector.settled",
        "0.0 -> -1.0 in `self._angle_rad, self._taken_s = (np.where(strayed, angle_rad, 0.0), taken_s)`",
    ): _MASKED,
    (
        "plausibility.py",
        "_JumpDetector.reach_rad",
        "np.maximum(elapsed_s, 0.0) -> np.maximum(0.0, elapsed_s) in `return SLACK_RAD + self._speed_rad_s * np.maximum(elapsed_s, 0.0)`",
    ): _IN_ANY_ORDER,
    (
        "plausibility.py",
        "_FrozenDetector.look",
        "np.minimum(self._low_rad, target) -> np.minimum(target, self._low_rad) in `self._low_rad = np.where(same, np.minimum(self._low_rad, target), target)`",
    ): _IN_ANY_ORDER,
    (
        "plausibility.py",
        "_FrozenDetector.look",
        "np.maximum(self._high_rad, target) -> np.maximum(target, self._high_rad) in `self._high_rad = np.where(same, np.maximum(self._high_rad, target), target)`",
    ): _IN_ANY_ORDER,
    (
        "plausibility.py",
        "_FrozenDetector.look",
        "np.minimum(self._far_since_s, taken_s) -> np.minimum(taken_s, self._far_since_s) in `self._far_since_s = np.where(far, np.minimum(self._far_since_s, taken_s), self._never_s)`",
    ): _IN_ANY_ORDER,
    (
        "plausibility.py",
        "_JumpDetector.settled",
        "np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) <= self.reach_rad(elapsed_s.max(axis=0)) -> np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) < self.reach_rad(elapsed_s.max(axis=0)) in `follows = np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) <= self.reach_rad(elapsed_s.max(axis=0))`",
    ): _ROUGH,
    (
        "plausibility.py",
        "_FrozenDetector.look",
        "taken_s - self._far_since_s > self._lease_s -> taken_s - self._far_since_s >= self._lease_s in `long = taken_s - self._far_since_s > self._lease_s`",
    ): _ROUGH,
    (
        "plausibility.py",
        "readable",
        "True -> False in `sound = [all(map(math.isfinite, values)) for values in zip(*columns, strict=True)]`",
    ): _SAME_LENGTHS,
    (
        "plausibility.py",
        "readable",
        "True -> False in `angle, velocity, torque = ([value if fine else last for value, fine, last in zip(column, sound, before, strict=True)] for column, before in zip(columns, kept, strict=True))`",
    ): _SAME_LENGTHS,
    (
        "plausibility.py",
        "readable",
        "zip(joints.valid, sound, strict=True) -> zip(sound, joints.valid, strict=True) in `valid = [valid and fine for valid, fine in zip(joints.valid, sound, strict=True)]`",
    ): _BOTH,
    (
        "plausibility.py",
        "readable",
        "True -> False in `valid = [valid and fine for valid, fine in zip(joints.valid, sound, strict=True)]`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "stoppable_speed",
        "distance_rad <= 0.0 -> distance_rad < 0.0 in `if distance_rad <= 0.0:`",
    ): _AT_THE_BOUND,
    (
        "gate.py",
        "why_limited",
        "True -> False in `for i, (mode, want) in enumerate(zip(command.mode, command.target, strict=True)):`",
    ): _SAME_LENGTHS,
    (
        "gate.py",
        "bound_by_heat",
        "np.minimum(command.torque_limit_nm, limits.torque_nm) -> np.minimum(limits.torque_nm, command.torque_limit_nm) in `asked = limits.torque_nm if command.torque_limit_nm is None else np.minimum(command.torque_limit_nm, limits.torque_nm)`",
    ): _IN_ANY_ORDER,
}
