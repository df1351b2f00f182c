"""Whether an intent is valid now, and its speed and direction. Pure except for its own state."""

from dataclasses import dataclass

from snakesim_hal.wire.messages import Intent

LONGEST_NS = 5_000_000_000  # upper limit of an intent's validity
FASTEST_M_S = 10.0  # as a scenario's mission
SENDERS_KEPT = 64
AHEAD_NS = 100_000_000  # its sender may have received a newer clock than navigation, which acts a few times a second


@dataclass(frozen=True)
class DesiredMotion:
    """The speed, and why it is not the mission's; empty when it is."""

    speed_m_s: float
    why: str = ""
    heading_w_rad: float | None = None  # direction of travel; None: the mission's


class Intents:
    """Follows the newest valid intent until it expires, and then stops.

    The mission does not resume: an operator whose connection breaks must not set the robot in motion.
    """

    def __init__(self, mission_m_s: float) -> None:
        self._mission_m_s = mission_m_s
        self._followed: Intent | None = None
        self._stopped = ""  # why it stands still, after an intent that was followed; empty before any was
        self._heading_w_rad: float | None = None  # stays while it stands still: a stop plans no other path
        self._newest_ns: dict[str, int] = {}  # stamp of the newest intent that was followed, by its sender

    def start_over(self) -> None:
        """Robot time restarts: earlier stamps are void."""
        self._newest_ns.clear()
        if self._followed is not None:
            self._stop(f"the intent of {self._followed.who} was for another start of the robot")

    def desired(self, newest: Intent | None, now_ns: int) -> DesiredMotion:
        """The present speed. newest: the newest intent; now_ns: robot time."""
        refused = ""
        if newest is not None and newest != self._followed:
            refused = _against(newest, now_ns) or self._why_overtaken(newest)
            if not refused:
                self._follow(newest)
        if self._followed is not None and (why := _against(self._followed, now_ns)):
            self._stop(why)
        followed, heading = self._followed, self._heading_w_rad
        if followed is None:
            return DesiredMotion(0.0 if self._stopped else self._mission_m_s, refused or self._stopped, heading)
        if not followed.go:
            return DesiredMotion(0.0, f"{followed.who} wants it to stop", heading)
        asked = followed.speed_m_s
        return DesiredMotion(self._mission_m_s if asked is None else asked, f"as {followed.who} wants it", heading)

    def _follow(self, intent: Intent) -> None:
        self._followed = intent
        self._stopped = ""
        if intent.go:
            self._heading_w_rad = intent.heading_w_rad
        self._newest_ns.pop(intent.who, None)
        self._newest_ns[intent.who] = intent.timestamp_ns
        while len(self._newest_ns) > SENDERS_KEPT:
            del self._newest_ns[next(iter(self._newest_ns))]

    def _why_overtaken(self, intent: Intent) -> str:
        """Return why an intent is rejected that its sender gave before another one; empty when it did not.

        Whoever has asked for a stop must not be set in motion by what they asked for earlier, and a network held back.
        """
        if intent.go and intent.timestamp_ns < self._newest_ns.get(intent.who, intent.timestamp_ns):
            return f"the intent of {intent.who} is older than another one that came before it"
        return ""

    def _stop(self, why: str) -> None:
        self._followed, self._stopped = None, f"{why}; send a new one to go on"


def _against(intent: Intent, now_ns: int) -> str:
    """Why an intent is rejected; empty when it is valid."""
    age_ns, valid_ns = now_ns - intent.timestamp_ns, min(intent.valid_for_ns, LONGEST_NS)
    if age_ns < -AHEAD_NS:
        return f"the intent of {intent.who} is stamped {-age_ns * 1e-9:.3g} s ahead of the robot's clock"
    if age_ns > valid_ns:
        age = f"it is {age_ns * 1e-9:.3g} s old, valid for {valid_ns * 1e-9:.3g} s"
        return f"the intent of {intent.who} has expired: {age}"
    if intent.speed_m_s is not None and abs(intent.speed_m_s) > FASTEST_M_S:
        return f"the intent of {intent.who} asks for {intent.speed_m_s:g} m/s, at most {FASTEST_M_S:g} m/s"
    return ""
