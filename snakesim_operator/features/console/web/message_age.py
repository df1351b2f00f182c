"""How old a message of a page is, at most. Pure, but for a lock.

A network that stalls keeps what a page has sent, and delivers it all at once when it recovers: also that a button was
held, long after the finger was lifted. A page's own clock would have to be compared with ours over the same network.
So the console asks the page numbered questions, several a second, and the page answers each on the connection on which
everything else comes, in order. A message that follows an answer was sent after the page had got that question. It is
no older than the question, by the console's clock alone, and whichever direction of the network stalls.
"""

import math
import threading
from dataclasses import dataclass

MAX_UNANSWERED = 20  # questions; a page that hangs gets no more until it answers


@dataclass(frozen=True)
class PageAction:
    """What is known of the time at which an operator acted on a page."""

    age_s: float  # at most so long ago; infinite when the page has not answered yet
    robot_ns: int | None = None  # the robot's time then, at the earliest; None: not known


@dataclass(frozen=True)
class _Question:
    asked_s: float
    robot_ns: int | None


NEVER = _Question(-math.inf, None)


class MessageAge:
    """The questions to one page, and the newest one that it has answered."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._unanswered: dict[str, _Question] = {}
        self._answered = NEVER

    def may_ask(self) -> bool:
        """Whether there is room for another question."""
        return len(self._unanswered) < MAX_UNANSWERED

    def ask(self, question: str, now_s: float, robot_ns: int | None) -> None:
        """Note a question before it is sent. robot_ns: the robot's time now, if it is known."""
        with self._lock:
            self._unanswered[question] = _Question(now_s, robot_ns)

    def answer(self, question: str) -> None:
        """Note an answer; one to a question that was not asked counts for nothing."""
        with self._lock:
            answered = self._unanswered.pop(question, None)
            if answered is None:
                return
            for earlier in [key for key, one in self._unanswered.items() if one.asked_s < answered.asked_s]:
                del self._unanswered[earlier]
            if answered.asked_s > self._answered.asked_s:
                self._answered = answered

    def action(self, now_s: float) -> PageAction:
        """Return what is known of a message that comes now."""
        answered = self._answered
        return PageAction(now_s - answered.asked_s, answered.robot_ns)
