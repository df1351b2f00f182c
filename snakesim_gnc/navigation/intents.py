"""Decides whether an operator's intent is valid now, and which speed and direction follow from it.

Pure except for its own state. All times are robot time.
"""

from dataclasses import dataclass

from snakesim_hal.wire.messages import LocomotionIntent

MAX_VALIDITY_NS = 5_000_000_000  # an intent expires after this, whatever validity it asks for
MAX_SPEED_M_S = 10.0  # as for a scenario's mission
MAX_SENDERS = 64  # whose newest timestamps are stored
# A sender may have a newer clock than navigation, which acts a few times a second.
MAX_TIMESTAMP_AHEAD_NS = 100_000_000


@dataclass(frozen=True)
class DesiredMotion:
    """The desired speed and direction of travel."""

    speed_m_s: float
    reason: str = ""  # the reason if the speed is not that of the mission
    heading_w_rad: float | None = None  # direction of travel; None for the mission's


class IntentTracker:
    """Follows the newest valid intent until it expires, and then stops.

    The mission does not resume: an operator whose connection breaks must not set the robot in motion.
    """

    def __init__(self, mission_speed_m_s: float) -> None:
        """Follow the mission's speed until the first intent arrives."""
        self._mission_speed_m_s = mission_speed_m_s
        self._followed_intent: LocomotionIntent | None = None
        self._stop_reason = ""  # why the robot stands after an intent; empty before the first one
        # Stays during a stop, so that a stop causes no other path.
        self._heading_w_rad: float | None = None
        # Timestamp of the newest intent that was followed, by its sender.
        self._newest_timestamp_by_requester: dict[str, int] = {}

    def reset(self) -> None:
        """Forget all timestamps, because robot time restarts, and stop an intent that is followed."""
        self._newest_timestamp_by_requester.clear()
        if self._followed_intent is not None:
            self._stop_following(
                f"the intent of {self._followed_intent.requester} was for another start of the robot"
            )

    def choose_motion(self, newest_intent: LocomotionIntent | None, now_ns: int) -> DesiredMotion:
        """Choose the desired motion at a robot time, and start or stop to follow an intent.

        Args:
            newest_intent: The newest intent that arrived; None if there was none.
            now_ns: Robot time.
        """
        rejection = ""
        if newest_intent is not None and newest_intent != self._followed_intent:
            rejection = _find_rejection_reason(
                newest_intent, now_ns
            ) or self._find_reordering_reason(newest_intent)
            if not rejection:
                self._start_following(newest_intent)
        if self._followed_intent is not None:
            expiry_reason = _find_rejection_reason(self._followed_intent, now_ns)
            if expiry_reason:
                self._stop_following(expiry_reason)
        if self._followed_intent is None:
            speed_m_s = 0.0 if self._stop_reason else self._mission_speed_m_s
            return DesiredMotion(speed_m_s, rejection or self._stop_reason, self._heading_w_rad)
        return self._make_motion(self._followed_intent)

    def _make_motion(self, intent: LocomotionIntent) -> DesiredMotion:
        if not intent.go:
            return DesiredMotion(0.0, f"{intent.requester} wants it to stop", self._heading_w_rad)
        speed_m_s = self._mission_speed_m_s if intent.speed_m_s is None else intent.speed_m_s
        return DesiredMotion(speed_m_s, f"as {intent.requester} wants it", self._heading_w_rad)

    def _start_following(self, intent: LocomotionIntent) -> None:
        self._followed_intent = intent
        self._stop_reason = ""
        if intent.go:
            self._heading_w_rad = intent.heading_w_rad
        # Insert it at the end: senders that were not followed for the longest time are dropped first.
        self._newest_timestamp_by_requester.pop(intent.requester, None)
        self._newest_timestamp_by_requester[intent.requester] = intent.timestamp_ns
        while len(self._newest_timestamp_by_requester) > MAX_SENDERS:
            oldest_sender = next(iter(self._newest_timestamp_by_requester))
            del self._newest_timestamp_by_requester[oldest_sender]

    def _find_reordering_reason(self, intent: LocomotionIntent) -> str:
        """Return why an intent is rejected that was sent before one that is followed already; empty if it was not.

        The network may delay an intent. A sender that has asked for a stop must not be set in motion by an intent that
        it sent earlier.
        """
        newest_ns = self._newest_timestamp_by_requester.get(intent.requester, intent.timestamp_ns)
        if intent.go and intent.timestamp_ns < newest_ns:
            return f"the intent of {intent.requester} is older than another one that came before it"
        return ""

    def _stop_following(self, reason: str) -> None:
        self._followed_intent = None
        self._stop_reason = f"{reason}; send a new one to go on"


def _find_rejection_reason(intent: LocomotionIntent, now_ns: int) -> str:
    """Return why an intent is rejected at a robot time; an empty text if it is valid."""
    age_ns = now_ns - intent.timestamp_ns
    valid_ns = min(intent.valid_for_ns, MAX_VALIDITY_NS)
    if age_ns < -MAX_TIMESTAMP_AHEAD_NS:
        return f"the intent of {intent.requester} is stamped {-age_ns * 1e-9:.3g} s ahead of the robot's clock"
    if age_ns > valid_ns:
        age = f"it is {age_ns * 1e-9:.3g} s old, valid for {valid_ns * 1e-9:.3g} s"
        return f"the intent of {intent.requester} has expired: {age}"
    if intent.speed_m_s is not None and abs(intent.speed_m_s) > MAX_SPEED_M_S:
        return f"the intent of {intent.requester} asks for {intent.speed_m_s:g} m/s, at most {MAX_SPEED_M_S:g} m/s"
    return ""
