"""Reads joystick events from a pipe; tests/system/can/test_joystick.py reads them from a device of the kernel."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.robot_commands.teleop.joystick import (
    ABS_X,
    ABS_Y,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    EVENT,
    STICK_AGE_S,
    SYN_DROPPED,
    Joystick,
    JoystickAxis,
    open_joystick,
)
from snakesim_testing.messages import raises_error

GAMEPAD_BUTTON = 0x130  # BTN_SOUTH of the kernel
KEYBOARD_KEY = 30  # KEY_A of the kernel


class FakeDevice:
    """A joystick device that writes events into a pipe as the kernel does."""

    def __init__(self) -> None:
        read_handle, self._write_handle = os.pipe()
        os.set_blocking(read_handle, False)
        self.stick = Joystick(read_handle, JoystickAxis(-32768, 32767), JoystickAxis(0, 255))

    def send_event(self, event_type: int, code: int, value: int, time_s: float = 1.000002) -> bool:
        """Write an event, and return whether the joystick reads an emergency stop from it."""
        seconds, microseconds = divmod(round(1e6 * time_s), 1_000_000)
        event = EVENT.pack(seconds, microseconds, event_type, code, value)
        end_of_report = EVENT.pack(seconds, microseconds, EV_SYN, 0, 0)
        os.write(self._write_handle, event + end_of_report)
        return self.stick.read_events(1.0)

    def unplug(self) -> None:
        os.close(self._write_handle)


@pytest.fixture
def device() -> Iterator[FakeDevice]:
    fake_device = FakeDevice()
    yield fake_device
    fake_device.stick.close()


def test_joystick_value_is_fraction_of_range_with_dead_zone(device: FakeDevice) -> None:
    device.send_event(EV_ABS, ABS_Y, 0)
    assert device.stick.forward == pytest.approx(1.0), "the stick is pushed away from the operator"
    device.send_event(EV_ABS, ABS_Y, 140)
    assert device.stick.forward == 0.0, "a released stick may rest near its center"
    device.send_event(EV_ABS, ABS_X, 32767)
    assert device.stick.right == pytest.approx(1.0)
    device.send_event(EV_ABS, ABS_X, -20000)
    assert -0.6 < device.stick.right < -0.5


def test_joystick_any_button_press_is_emergency_stop(device: FakeDevice) -> None:
    assert device.send_event(EV_KEY, GAMEPAD_BUTTON, 1)
    assert not device.send_event(EV_KEY, GAMEPAD_BUTTON, 0)
    assert not device.send_event(EV_KEY, KEYBOARD_KEY, 1), "this is a key of a keyboard"


def test_joystick_lost_events_or_device_release_the_stick(device: FakeDevice) -> None:
    device.send_event(EV_ABS, ABS_Y, 0)
    device.send_event(EV_SYN, SYN_DROPPED, 0)
    assert device.stick.forward == 0.0
    device.send_event(EV_ABS, ABS_Y, 0)
    device.unplug()
    device.stick.read_events(1.0)
    assert device.stick.is_lost
    assert device.stick.forward == 0.0


def test_joystick_is_released_when_newest_event_is_old(device: FakeDevice) -> None:
    assert device.stick.is_silent(0.0), "no event has arrived"
    device.send_event(EV_ABS, ABS_Y, 0, time_s=10.5)
    assert device.stick.forward == pytest.approx(1.0)
    assert not device.stick.is_silent(10.5 + STICK_AGE_S)
    assert device.stick.is_silent(10.6 + STICK_AGE_S), (
        "the gamepad is off, or the program was suspended"
    )
    device.send_event(EV_ABS, ABS_Y, 1, time_s=20.0)
    assert not device.stick.is_silent(20.1)


def test_joystick_path_of_another_file_is_refused_with_advice(tmp_path: Path) -> None:
    (tmp_path / "event0").write_text("")
    for path in (tmp_path / "event0", tmp_path / "event1"):
        with raises_error(ConfigError, code="command/invalid-option"):
            open_joystick(path)
