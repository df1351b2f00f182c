"""The teleop loop stops the robot on a real network when its joystick is silent or unplugged."""

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

MAX_STICK_AGE_S = 0.3  # replaces STICK_AGE_S, so that the tests are short
SPEED_M_S = 0.2
LAST_TICK = 60


@pytest.fixture(autouse=True)
def restored_signal_handlers() -> Iterator[None]:
    """Restore the signal handlers of this process after each test."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, handlers, strict=True):
        signal.signal(number, handler)


def test_teleop_with_silent_joystick_requests_speed_zero(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wireless receiver remains connected without events if its pad is switched off while it is pushed."""
    monkeypatch.setattr(joystick, "STICK_AGE_S", MAX_STICK_AGE_S)
    monkeypatch.setattr(command, "STICK_AGE_S", MAX_STICK_AGE_S)
    device_end, test_end = os.pipe()
    os.set_blocking(device_end, False)
    connection = ConnectionSettings(find_free_endpoint(), "worm")
    with (
        open_session(ConnectionSettings(connection.endpoint, "worm", listen=True)) as robot,
        open_session(connection) as session,
    ):
        intent_reader = robot.declare_reader(keys.INTENT, LocomotionIntent, depth=256)
        clock_publisher = robot.declare_publisher(keys.CLOCK, Clock)
        stick = Joystick(device_end, JoystickAxis(0, 255), JoystickAxis(0, 255))
        teleop = TeleopLoop(session, connection, SPEED_M_S, None, stick)
        teleop_thread = threading.Thread(target=teleop.run)
        # Only the main thread may set signal handlers, and the loop runs in another thread.
        monkeypatch.setattr(command, "call_on_stop_signals", lambda _stop: None)
        monkeypatch.setattr(signal, "signal", lambda *_: None)
        teleop_thread.start()
        intents = list[LocomotionIntent]()
        ticks = itertools.count(1)

        def read_newest_speeds(count: int) -> set[float | None]:
            """Publish the next tick, and return the speeds in the newest intents."""
            clock_publisher.put(make_clock(next(ticks), arm_session=1, clock_mode="realtime"))
            time.sleep(0.02)
            intents.extend(intent_reader.drain())
            return {intent.speed_m_s for intent in intents[-count:]}

        for _ in range(2):
            pushed_s = time.monotonic()
            os.write(test_end, make_event(pushed_s, ABS_Y, 0))
            wait_until(lambda: read_newest_speeds(1) == {SPEED_M_S}, "the requested speed", 5.0)
            wait_until(lambda: read_newest_speeds(3) == {0.0}, "speed 0", 5.0)
            assert time.monotonic() - pushed_s > MAX_STICK_AGE_S
        os.write(
            test_end, make_event(time.monotonic() - 10.0, ABS_Y, 0)
        )  # This event arrives late.
        for _ in range(10):
            assert read_newest_speeds(1) == {0.0}
        os.close(test_end)
        teleop_thread.join(10.0)
        stick.close()


def make_event(time_s: float, axis: int, value: int) -> bytes:
    """Return an event of a joystick as the kernel encodes it."""
    seconds, microseconds = divmod(round(1e6 * time_s), 1_000_000)
    return EVENT.pack(seconds, microseconds, EV_ABS, axis, value)


def test_teleop_with_unplugged_joystick_requests_stop_and_ends(
    capsys: pytest.CaptureFixture[str],
) -> None:
    device_end, test_end = os.pipe()
    os.set_blocking(device_end, False)
    connection = ConnectionSettings(find_free_endpoint(), "worm")
    with (
        open_session(ConnectionSettings(connection.endpoint, "worm", listen=True)) as robot,
        open_session(connection) as session,
    ):
        intent_reader = robot.declare_reader(keys.INTENT, LocomotionIntent, depth=256)
        clock_publisher = robot.declare_publisher(keys.CLOCK, Clock)

        def push_stick_and_unplug_it() -> None:
            """Push the stick, publish the clock of a robot, and close the device."""
            os.write(test_end, make_event(time.monotonic(), ABS_Y, 0))
            for tick in range(1, LAST_TICK):
                clock_publisher.put(make_clock(tick, arm_session=1, clock_mode="realtime"))
                time.sleep(0.01)
            os.close(test_end)

        robot_thread = threading.Thread(target=push_stick_and_unplug_it)
        robot_thread.start()
        stick = Joystick(device_end, JoystickAxis(0, 255), JoystickAxis(0, 255))
        assert TeleopLoop(session, connection, SPEED_M_S, None, stick).run() == 1
        robot_thread.join()
        stick.close()
        intents = intent_reader.drain()
        wait_until(
            lambda: intents.extend(intent_reader.drain()) or not intents[-1].go,
            "a stop as the last intent",
        )
    assert len(intents) > 3
    assert {intent.speed_m_s for intent in intents[:-1]} == {SPEED_M_S}
    timestamps_ns = [intent.timestamp_ns for intent in intents]
    assert timestamps_ns == sorted(timestamps_ns)
    assert "the joystick is gone" in capsys.readouterr().out
