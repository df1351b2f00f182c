"""The console estimates how old a message of a page is, from answered questions, and ignores old motion commands."""

import math
import time
from itertools import count
from typing import Any

import msgspec
import pytest

from snakesim_operator.features.console.web.admission import (
    MAX_HOLD_AGE_S,
    MAX_PRESS_AGE_S,
    ControlAdmission,
)
from snakesim_operator.features.console.web.message_age import (
    MAX_UNANSWERED,
    MessageAge,
    PageAction,
)
from snakesim_testing.harness.page import ViewerPage
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.ready_stop import ReadyStop
from snakesim_testing.operator.served_console import running_console

QUESTION_RATE_HZ = 10.0
VIEWER = 3
START_STEPS = 20  # two seconds without a stall
OLD_S = 14.0  # age of a message that may only stop or disarm


class StallingNetwork:
    """A network between the console and a page, which may stall in one direction or in both.

    The console sends ten questions a second. The page answers at once, and reports as often that a button is held.
    """

    def __init__(self) -> None:
        self.age = MessageAge()
        self._numbers = count()
        self._to_page: list[str] = []
        self._to_console: list[str | None] = []  # answers; None reports a held button

    def advance(
        self, now_s: float, *, down_stalls: bool, up_stalls: bool, is_held: bool
    ) -> list[float]:
        """Advance by a tenth of a second.

        Args:
            now_s: The present time.
            down_stalls: Whether messages to the page are delayed.
            up_stalls: Whether messages to the console are delayed.
            is_held: Whether the page reports a held button.

        Returns:
            The ages in s of the reports of a held button that reach the console.
        """
        if self.age.may_ask():
            question = str(next(self._numbers))
            self.age.note_question(question, now_s, round(now_s * 1e9))
            self._to_page.append(question)
        if not down_stalls:
            self._to_console += self._to_page
            self._to_page.clear()
        if is_held:
            self._to_console.append(None)
        ages_s: list[float] = []
        while self._to_console and not up_stalls:
            message = self._to_console.pop(0)
            if message is None:
                ages_s.append(self.age.date_action(now_s).age_s)
            else:
                self.age.note_answer(message)
        return ages_s


@pytest.mark.parametrize(("down_stalls", "up_stalls"), [(True, True), (False, True), (True, False)])
@pytest.mark.parametrize("stall_s", [1.0, 14.0, 30.0])
def test_console_message_delayed_by_a_stall_is_too_old(
    *, down_stalls: bool, up_stalls: bool, stall_s: float
) -> None:
    network = StallingNetwork()
    now_s = 0.0
    ages_before_stall_s: list[float] = []
    for _ in range(START_STEPS):
        ages_before_stall_s += network.advance(
            now_s, down_stalls=False, up_stalls=False, is_held=True
        )
        now_s += 1 / QUESTION_RATE_HZ
    assert len(ages_before_stall_s) == START_STEPS
    assert max(ages_before_stall_s) <= MAX_HOLD_AGE_S
    # The viewer releases the button before the network recovers.
    release_s = now_s + stall_s - MAX_HOLD_AGE_S - 0.2
    late_ages_s: list[float] = []
    for _ in range(round(stall_s * QUESTION_RATE_HZ)):
        late_ages_s += network.advance(
            now_s, down_stalls=down_stalls, up_stalls=up_stalls, is_held=now_s < release_s
        )
        now_s += 1 / QUESTION_RATE_HZ
    if up_stalls:
        late_ages_s = network.advance(now_s, down_stalls=False, up_stalls=False, is_held=False)
        assert len(late_ages_s) >= (stall_s - 1.0) * QUESTION_RATE_HZ
        assert min(late_ages_s) > MAX_HOLD_AGE_S
    else:
        # No question reaches the page, so that all messages after the first second are too old.
        assert all(age_s > MAX_HOLD_AGE_S for age_s in late_ages_s[round(QUESTION_RATE_HZ) :])
    for _ in range(3):
        network.advance(now_s, down_stalls=False, up_stalls=False, is_held=False)
        now_s += 1 / QUESTION_RATE_HZ
    ages_after_stall_s = network.advance(now_s, down_stalls=False, up_stalls=False, is_held=True)
    assert ages_after_stall_s, "a button that is held again has no effect"
    assert max(ages_after_stall_s) <= MAX_HOLD_AGE_S


def test_message_age_ignores_answers_without_question_and_limits_questions() -> None:
    age = MessageAge()
    age.note_answer("guessed")
    assert age.date_action(5.0) == PageAction(math.inf)
    age.note_question("a", 1.0, 100)
    age.note_question("b", 2.0, 200)
    age.note_answer("b")
    age.note_answer("a")
    assert age.date_action(5.0) == PageAction(3.0, 200)
    for number in range(MAX_UNANSWERED):
        assert age.may_ask()
        age.note_question(str(number), 6.0, None)
    assert not age.may_ask(), "a page that answers nothing gets more questions"


def test_console_ignores_late_motion_and_obeys_late_stop() -> None:
    actions: list[str] = []
    late_ages_s: list[float] = []
    with running_console(ReadyStop()) as (server, _):
        admission = ControlAdmission()
        group = server.gui.add_button_group("Robot", ("Arm", "Disarm"))
        hold = server.gui.add_button("Hold")
        stop = server.gui.add_button("Stop")

        def make_handler(control: str) -> Any:
            return lambda viewer, _action: actions.append(f"{control} {viewer}")

        admission.admit_control(
            group,
            VIEWER,
            handler=make_handler("group"),
            max_age_s=MAX_PRESS_AGE_S,
            at_any_age=("Disarm",),
            on_late=late_ages_s.append,
        )
        admission.admit_control(
            hold,
            VIEWER,
            hold_hz=QUESTION_RATE_HZ,
            handler=make_handler("hold"),
            max_age_s=MAX_HOLD_AGE_S,
        )
        admission.admit_control(stop, handler=make_handler("stop"))
        messages_by_name = {
            "arm": make_update_message(group, "Arm"),
            "disarm": make_update_message(group, "Disarm"),
            "hold": {
                "type": "GuiButtonHoldMessage",
                "uuid": hold._impl.uuid,
                "frequency": QUESTION_RATE_HZ,
            },
            "stop": make_update_message(stop, True),
        }
        messages = [msgspec.msgpack.encode(message) for message in messages_by_name.values()]
        old_age = MessageAge()
        fresh_age = MessageAge()
        for age, question_s in (
            (old_age, time.monotonic() - OLD_S),
            (fresh_age, time.monotonic()),
        ):
            age.note_question("question", question_s, 0)
            answer = {"type": "LocalStorageGetItemResponseMessage", "request_uuid": "question"}
            admission.filter_message(
                VIEWER, msgspec.msgpack.encode(answer | {"value": None, "error": None}), age
            )
        for message in messages:
            assert admission.filter_message(VIEWER, message, old_age) is None
        # Only the old messages to disarm and to stop have an effect.
        assert actions == [f"group {VIEWER}", f"stop {VIEWER}"]
        assert len(late_ages_s) == 1
        assert late_ages_s[0] == pytest.approx(OLD_S, abs=1.0)
        assert admission.dropped["too old"] == 2
        actions.clear()
        for message in messages:
            assert admission.filter_message(VIEWER, message, fresh_age) is None
        assert [action.split()[0] for action in actions] == ["group", "group", "hold", "stop"]


def make_update_message(handle: Any, value: object) -> dict[str, Any]:
    """Return the message of a page that changes the value of a control."""
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}


def test_console_page_without_scene_may_view_and_stop() -> None:
    viewers_that_stopped: list[int] = []
    with running_console(ReadyStop()) as (server, address):
        button = server.gui.add_button("EMERGENCY STOP  (Esc)")
        server.admission.admit_control(
            button, handler=lambda viewer, _action: viewers_that_stopped.append(viewer)
        )
        with ViewerPage(address, draws=False) as page:
            page.click("EMERGENCY STOP  (Esc)")
            wait_until(lambda: viewers_that_stopped == [0], "the stop", 10.0)
            assert server.count_viewers() == 1
            assert not server.get_clients()
        wait_until(lambda: server.count_viewers() == 0, "the end of the page", 10.0)


def test_console_page_that_answers_gets_an_age(capfd: pytest.CaptureFixture[str]) -> None:
    actions: list[PageAction] = []

    def record_action(viewer: int, action: PageAction) -> None:
        actions.append(action)
        if len(actions) == 1:
            raise RuntimeError(f"unexpected, of viewer {viewer}")

    with running_console(ReadyStop()) as (server, address):
        button = server.gui.add_button("Go")
        server.admission.admit_control(button, handler=record_action)
        with ViewerPage(address) as page:
            wait_until(lambda: server.get_clients(), "a viewer", 10.0)
            page.click("Go")
            wait_until(lambda: actions, "a press", 10.0)
            assert actions[0].age_s == math.inf

            def has_known_age() -> bool:
                server.ask_for_age(0, 7)
                page.click("Go")
                return actions[-1].robot_ns == 7

            wait_until(has_known_age, "an answer", 10.0)
            assert 0.0 < actions[-1].age_s < 10.0
    assert "a page: unexpected error, but it continues: RuntimeError" in capfd.readouterr().err
