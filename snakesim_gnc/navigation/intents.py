"""Decides whether an operator's intent is valid now, and which speed and direction follow from it.

Pure except for its own state. All times are robot time.
"""

from dataclasses import dataclass

from snakesim_hal.wire.messages import Intent

LONGEST_NS = 5_000_000_000  # an intent expires after this, whatever validity it asks for
MAX_SPEED_M_S = 10.0  # as for a scenario's mission
MAX_SENDERS = 64  # whose newest timestamps are stored
MAX_AHEAD_NS = 100_000_000  # a sender may have a newer clock than navigation, which acts a few times a second


@dataclass(frozen=True)
class DesiredMotion:
    """The desired speed and direction of travel."""

    speed_m_s: float
    reason: str = ""  # the reason if the speed is not that of the mission
    heading_w_rad: float | None = None  # direction of travel; None: the mission's


class Intents:
    """Follows the newest valid intent until it expires, and then stops.

    The mission does not resume: an operator whose connection breaks must not set the robot in motion.
    """

    def __init__(self, mission_m_s: float) -> None:
        """Follow the mission's speed until the first intent arrives."""
        self._mission_m_s = mission_m_s
        self._followed: Intent | None = None
        self._stop_reason = ""  # why the robot stands after an intent; empty before the first one
        self._heading_w_rad: float | None = None  # stays during a stop, so that a stop causes no other path
        self._newest_ns: dict[str, int] = {}  # timestamp of the newest intent that was followed, by its sender

    def start_over(self) -> None:
        """Forget all timestamps, because robot time restarts, and stop an intent that is followed."""
        self._newest_ns.clear()
        if self._followed is not None:
            self._stop(f"the intent of {self._followed.requester} was for another start of the robot")

    def desired(self, newest: Intent | None, now_ns: int) -> DesiredMotion:
        """Return the desired motion at a robot time. newest: the newest intent that arrived."""
        refusal = ""
        if newest is not None and newest != self._followed:
            refusal = _find_refusal(newest, now_ns) or self._find_reordering(newest)
            if not refusal:
                self._follow(newest)
        if self._followed is not None:
            expiry = _find_refusal(self._followed, now_ns)
            if expiry:
                self._stop(expiry)
        if self._followed is None:
            speed_m_s = 0.0 if self._stop_reason else self._mission_m_s
            return DesiredMotion(speed_m_s, refusal or self._stop_reason, self._heading_w_rad)
        return self._motion_from(self._followed)

    def _motion_from(self, intent: Intent) -> DesiredMotion:
        if not intent.go:
            return DesiredMotion(0.0, f"{intent.requester} wants it to stop", self._heading_w_rad)
        speed_m_s = self._mission_m_s if intent.speed_m_s is None else intent.speed_m_s
        return DesiredMotion(speed_m_s, f"as {intent.requester} wants it", self._heading_w_rad)

    def _follow(self, intent: Intent) -> None:
        self._followed = intent
        self._stop_reason = ""
        if intent.go:
            self._heading_w_rad = intent.heading_w_rad
        # Insert it at the end: senders that were not followed for the longest time are dropped first.
        self._newest_ns.pop(intent.requester, None)
        self._newest_ns[intent.requester] = intent.timestamp_ns
        while len(self._newest_ns) > MAX_SENDERS:
            oldest_sender = next(iter(self._newest_ns))
            del self._newest_ns[oldest_sender]

    def _find_reordering(self, intent: Intent) -> str:
        """Return why an intent is rejected that its sender sent before another one; empty if it did not.

        The network may delay an intent. A sender that has asked for a stop must not be set in motion by an intent that
        it sent earlier.
        """
        newest_ns = self._newest_ns.get(intent.requester, intent.timestamp_ns)
        if intent.go and intent.timestamp_ns < newest_ns:
            return f"the intent of {intent.requester} is older than another one that came before it"
        return ""

    def _stop(self, reason: str) -> None:
        self._followed = None
        self._stop_reason = f"{reason}; send a new one to go on"


def _find_refusal(intent: Intent, now_ns: int) -> str:
    """Return why an intent is rejected at a robot time; empty if it is valid."""
    age_ns = now_ns - intent.timestamp_ns
    valid_ns = min(intent.valid_for_ns, LONGEST_NS)
    if age_ns < -MAX_AHEAD_NS:
        return f"the intent of {intent.requester} is stamped {-age_ns * 1e-9:.3g} s ahead of the robot's clock"
    if age_ns > valid_ns:
        age = f"it is {age_ns * 1e-9:.3g} s old, valid for {valid_ns * 1e-9:.3g} s"
        return f"the intent of {intent.requester} has expired: {age}"
    if intent.speed_m_s is not None and abs(intent.speed_m_s) > MAX_SPEED_M_S:
        return f"the intent of {intent.requester} asks for {intent.speed_m_s:g} m/s, at most {MAX_SPEED_M_S:g} m/s"
    return ""
