"""The loop of teleop with a joystick, on a real network."""

import itertools
import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, LocomotionIntent
from snakesim_operator.robot_commands.teleop import command, joystick
from snakesim_operator.robot_commands.teleop.command import TeleopLoop
from snakesim_operator.robot_commands.teleop.joystick import (
    ABS_Y,
    EV_ABS,
    EVENT,
    Joystick,
    JoystickAxis,
)
from snakesim_testing.hal.small_robots import make_clock
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.wait import wait_until

SILENT_S = 0.3  # in the place of STICK_AGE_S


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Those of this process, given back."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def test_a_stick_that_falls_silent_asks_for_nothing_any_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as a receiver whose pad is switched off while it is pushed forward: its device stays, without events."""
    monkeypatch.setattr(joystick, "STICK_AGE_S", SILENT_S)
    monkeypatch.setattr(command, "STICK_AGE_S", SILENT_S)
    read, write = os.pipe()
    os.set_blocking(read, False)
    link = ConnectionSettings(find_free_endpoint(), "worm")
    with (
        open_session(ConnectionSettings(link.endpoint, "worm", listen=True)) as robot,
        open_session(link) as session,
    ):
        heard, clocks = (
            robot.declare_reader(keys.INTENT, LocomotionIntent, depth=256),
            robot.declare_publisher(keys.CLOCK, Clock),
        )
        stick = Joystick(read, JoystickAxis(0, 255), JoystickAxis(0, 255))
        teleop = TeleopLoop(session, link, 0.2, None, stick)
        loop = threading.Thread(target=teleop.run)
        # Of the main thread alone.
        monkeypatch.setattr(command, "call_on_stop_signals", lambda _stop: None)
        monkeypatch.setattr(signal, "signal", lambda *_: None)
        loop.start()
        intents, ticks = list[LocomotionIntent](), itertools.count(1)

        def speeds_at_last(count: int) -> set[float | None]:
            clocks.put(make_clock(next(ticks), arm_session=1, clock_mode="realtime"))
            time.sleep(0.02)
            intents.extend(heard.drain())
            return {intent.speed_m_s for intent in intents[-count:]}

        for _ in range(2):
            pushed_s = time.monotonic()
            os.write(write, event(pushed_s, ABS_Y, 0))
            wait_until(lambda: speeds_at_last(1) == {0.2}, "to go", 5.0)
            wait_until(lambda: speeds_at_last(3) == {0.0}, "to stand", 5.0)
            assert time.monotonic() - pushed_s > SILENT_S
        os.write(write, event(time.monotonic() - 10.0, ABS_Y, 0))  # read late
        for _ in range(10):
            assert speeds_at_last(1) == {0.0}
        os.close(write)
        loop.join(10.0)
        stick.close()


def event(at_s: float, axis: int, value: int) -> bytes:
    seconds, microseconds = divmod(round(1e6 * at_s), 1_000_000)
    return EVENT.pack(seconds, microseconds, EV_ABS, axis, value)


def test_a_stick_that_is_unplugged_ends_it_with_a_stop(capsys: pytest.CaptureFixture[str]) -> None:
    read, write = os.pipe()
    os.set_blocking(read, False)
    link = ConnectionSettings(find_free_endpoint(), "worm")
    with (
        open_session(ConnectionSettings(link.endpoint, "worm", listen=True)) as robot,
        open_session(link) as session,
    ):
        heard, clocks = (
            robot.declare_reader(keys.INTENT, LocomotionIntent, depth=256),
            robot.declare_publisher(keys.CLOCK, Clock),
        )

        def be_a_robot_and_a_hand() -> None:
            os.write(write, event(time.monotonic(), ABS_Y, 0))
            for tick in itertools.takewhile(lambda tick: tick < 60, itertools.count(1)):
                clocks.put(make_clock(tick, arm_session=1, clock_mode="realtime"))
                time.sleep(0.01)
            os.close(write)

        hand = threading.Thread(target=be_a_robot_and_a_hand)
        hand.start()
        stick = Joystick(read, JoystickAxis(0, 255), JoystickAxis(0, 255))
        assert TeleopLoop(session, link, 0.2, None, stick).run() == 1
        hand.join()
        stick.close()
        intents = heard.drain()
        wait_until(
            lambda: intents.extend(heard.drain()) or not intents[-1].go,
            "the stop, which is asked for last",
        )
    assert len(intents) > 3
    assert {intent.speed_m_s for intent in intents[:-1]} == {0.2}
    assert all(a.timestamp_ns <= b.timestamp_ns for a, b in itertools.pairwise(intents))
    assert "the joystick is gone" in capsys.readouterr().out
