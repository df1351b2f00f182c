"""How old a page's message is at most, and what an old one may not do: by the questions that the page has answered."""

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

HZ = 10.0
VIEWER = 3


class Link:
    """A page in control behind a network that may stall in one direction or in both. Time is counted in seconds.

    The console asks ten times a second; the page answers at once, and says as often that a button is held.
    """

    def __init__(self) -> None:
        self.age = MessageAge()
        self._numbers = count()
        self._to_page: list[str] = []
        self._to_console: list[str | None] = []  # an answer; None: held

    def turn(self, now_s: float, *, down_stalls: bool, up_stalls: bool, held: bool) -> list[float]:
        """A tenth of a second; returns the ages of the "held" messages that reach the console."""
        if self.age.may_ask():
            question = str(next(self._numbers))
            self.age.note_question(question, now_s, round(now_s * 1e9))
            self._to_page.append(question)
        if not down_stalls:
            self._to_console += self._to_page
            self._to_page.clear()
        if held:
            self._to_console.append(None)
        found: list[float] = []
        while self._to_console and not up_stalls:
            message = self._to_console.pop(0)
            if message is None:
                found.append(self.age.date_action(now_s).age_s)
            else:
                self.age.note_answer(message)
        return found


@pytest.mark.parametrize(("down_stalls", "up_stalls"), [(True, True), (False, True), (True, False)])
@pytest.mark.parametrize("stall_s", [1.0, 14.0, 30.0])
def test_console_message_delayed_by_a_stall_is_too_old(
    *, down_stalls: bool, up_stalls: bool, stall_s: float
) -> None:
    link, now_s = Link(), 0.0
    fresh: list[float] = []
    for _ in range(20):
        fresh += link.turn(now_s, down_stalls=False, up_stalls=False, held=True)
        now_s += 1 / HZ
    assert len(fresh) == 20
    assert max(fresh) <= MAX_HOLD_AGE_S
    # The finger is lifted before the network recovers.
    lifted_s = now_s + stall_s - MAX_HOLD_AGE_S - 0.2
    late: list[float] = []
    for _ in range(round(stall_s * HZ)):
        late += link.turn(
            now_s, down_stalls=down_stalls, up_stalls=up_stalls, held=now_s < lifted_s
        )
        now_s += 1 / HZ
    if up_stalls:
        late = link.turn(now_s, down_stalls=False, up_stalls=False, held=False)
        assert len(late) >= (stall_s - 1.0) * HZ
        assert min(late) > MAX_HOLD_AGE_S
    else:
        assert all(age_s > MAX_HOLD_AGE_S for age_s in late[round(HZ) :]), (
            "no question reaches the page"
        )
    for _ in range(3):
        link.turn(now_s, down_stalls=False, up_stalls=False, held=False)
        now_s += 1 / HZ
    again = link.turn(now_s, down_stalls=False, up_stalls=False, held=True)
    assert again and max(again) <= MAX_HOLD_AGE_S, "who holds it again drives again"


def test_answers_that_nobody_asked_for_make_nothing_younger() -> None:
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
    assert not age.may_ask(), "a page that hangs"


def test_console_late_motion_is_ignored_and_late_stop_obeyed() -> None:
    done: list[str] = []
    late: list[float] = []
    with running_console(ReadyStop()) as (server, _):
        admission = ControlAdmission()
        group = server.gui.add_button_group("Robot", ("Arm", "Disarm"))
        hold = server.gui.add_button("Hold")
        stop = server.gui.add_button("Stop")

        def note(what: str) -> Any:
            return lambda viewer, _action: done.append(f"{what} {viewer}")

        admission.admit_control(
            group,
            VIEWER,
            handler=note("group"),
            max_age_s=MAX_PRESS_AGE_S,
            at_any_age=("Disarm",),
            on_late=late.append,
        )
        admission.admit_control(
            hold, VIEWER, hold_hz=HZ, handler=note("hold"), max_age_s=MAX_HOLD_AGE_S
        )
        admission.admit_control(stop, handler=note("stop"))
        messages = {
            "arm": _update(group, "Arm"),
            "disarm": _update(group, "Disarm"),
            "hold": {"type": "GuiButtonHoldMessage", "uuid": hold._impl.uuid, "frequency": HZ},
            "stop": _update(stop, True),
        }
        raw = {name: msgspec.msgpack.encode(message) for name, message in messages.items()}
        old, fresh = MessageAge(), MessageAge()
        for age, asked_s in ((old, time.monotonic() - 14.0), (fresh, time.monotonic())):
            age.note_question("question", asked_s, 0)
            answer = {"type": "LocalStorageGetItemResponseMessage", "request_uuid": "question"}
            admission.filter_message(
                VIEWER, msgspec.msgpack.encode(answer | {"value": None, "error": None}), age
            )
        for name in raw:
            assert admission.filter_message(VIEWER, raw[name], old) is None
        assert done == [f"group {VIEWER}", f"stop {VIEWER}"], "to disarm and to stop"
        assert len(late) == 1
        assert late[0] == pytest.approx(14.0, abs=1.0)
        assert admission.dropped["too old"] == 2
        done.clear()
        for name in raw:
            assert admission.filter_message(VIEWER, raw[name], fresh) is None
        assert [name.split()[0] for name in done] == ["group", "group", "hold", "stop"]


def _update(handle: Any, value: object) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}


def test_console_page_without_scene_may_view_and_stop() -> None:
    stopped: list[int] = []
    with running_console(ReadyStop()) as (server, address):
        button = server.gui.add_button("EMERGENCY STOP  (Esc)")
        server.admission.admit_control(
            button, handler=lambda viewer, _action: stopped.append(viewer)
        )
        with ViewerPage(address, draws=False) as page:
            page.click("EMERGENCY STOP  (Esc)")
            wait_until(lambda: stopped == [0], "the stop", 10.0)
            assert server.count_viewers() == 1
            assert not server.get_clients()
        wait_until(lambda: server.count_viewers() == 0, "its end", 10.0)


def test_a_real_page_answers_what_it_is_asked(capfd: pytest.CaptureFixture[str]) -> None:
    ages: list[PageAction] = []

    def act(viewer: int, action: PageAction) -> None:
        ages.append(action)
        if len(ages) == 1:
            raise RuntimeError(f"unexpected, of viewer {viewer}")

    with running_console(ReadyStop()) as (server, address):
        button = server.gui.add_button("Go")
        server.admission.admit_control(button, handler=act)
        with ViewerPage(address) as page:
            wait_until(lambda: server.get_clients(), "a viewer", 10.0)
            page.click("Go")
            wait_until(lambda: ages, "a press", 10.0)
            assert ages[0].age_s == math.inf

            def is_known() -> bool:
                server.ask_for_age(0, 7)
                page.click("Go")
                return ages[-1].robot_ns == 7

            wait_until(is_known, "an answer", 10.0)
            assert 0.0 < ages[-1].age_s < 10.0
    assert "a page: unexpected error, going on: RuntimeError" in capfd.readouterr().err
