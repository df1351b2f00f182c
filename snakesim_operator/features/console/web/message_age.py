"""The maximum age of a page's message.

A network that stalls keeps what a page has sent, and delivers it all at once when it recovers. This includes messages
that a button is held, long after the finger was lifted. The page's clock cannot date them, because it would have to be
compared with the console's clock over the same network.

So the console asks the page numbered questions, several a second. The page answers each one on the connection that
carries all its other messages, in order. A message that follows an answer was sent after the page had received that
question. It is therefore no older than the question. This needs only the console's clock, and holds whichever direction
of the network stalls.
"""

import math
import threading
from dataclasses import dataclass

MAX_UNANSWERED = 20  # questions; a page that hangs gets no more until it answers


@dataclass(frozen=True)
class PageAction:
    """The time at which an operator acted on a page, as far as it is known."""

    # The operator acted at most this long ago; infinite: the page has not answered yet.
    age_s: float
    robot_ns: int | None = None  # the robot's time then, at the earliest; None: not known


@dataclass(frozen=True)
class _AgeQuestion:
    asked_s: float
    robot_ns: int | None


NO_QUESTION = _AgeQuestion(-math.inf, None)  # before the page has answered any


class MessageAge:
    """The questions to one page, and the newest one that the page has answered.

    Other threads ask; the thread that receives the page's messages notes the answers.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._unanswered: dict[str, _AgeQuestion] = {}
        self._answered = NO_QUESTION

    def may_ask(self) -> bool:
        """Return whether there is room for another question."""
        return len(self._unanswered) < MAX_UNANSWERED

    def note_question(self, question: str, now_s: float, robot_ns: int | None) -> None:
        """Note a question; called before it is sent.

        Args:
            question: A name that no other question has, and that the page cannot guess.
            now_s: The console's time.
            robot_ns: The robot's time, if it is known.
        """
        with self._lock:
            self._unanswered[question] = _AgeQuestion(now_s, robot_ns)

    def note_answer(self, question: str) -> None:
        """Note an answer. An answer to a question that was not asked is ignored."""
        with self._lock:
            answered = self._unanswered.pop(question, None)
            if answered is None:
                return
            # Answers come in order, so those to earlier questions are not expected any more.
            earlier = [
                name for name, other in self._unanswered.items() if other.asked_s < answered.asked_s
            ]
            for name in earlier:
                del self._unanswered[name]
            if answered.asked_s > self._answered.asked_s:
                self._answered = answered

    def date_action(self, now_s: float) -> PageAction:
        """Return the time of the action that a message reports which arrives now."""
        answered = self._answered
        return PageAction(now_s - answered.asked_s, answered.robot_ns)
