"""A joystick, at the event layer: a pipe is the device. tests/system/can/test_joystick.py has one of the kernel."""

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


class Device:
    """Writes events as the kernel does."""

    def __init__(self) -> None:
        handle, self._write = os.pipe()
        os.set_blocking(handle, False)
        self.stick = Joystick(handle, JoystickAxis(-32768, 32767), JoystickAxis(0, 255))

    def sends(self, kind: int, code: int, value: int, at_s: float = 1.000002) -> bool:
        seconds, microseconds = divmod(round(1e6 * at_s), 1_000_000)
        time = seconds, microseconds
        os.write(
            self._write, EVENT.pack(*time, kind, code, value) + EVENT.pack(*time, EV_SYN, 0, 0)
        )
        return self.stick.read_events(1.0)

    def unplug(self) -> None:
        os.close(self._write)


@pytest.fixture
def device() -> Iterator[Device]:
    made = Device()
    yield made
    made.stick.close()


def test_joystick_value_is_share_of_its_range_with_dead_zone(device: Device) -> None:
    device.sends(EV_ABS, ABS_Y, 0)
    assert device.stick.forward == pytest.approx(1.0), "away from the operator"
    device.sends(EV_ABS, ABS_Y, 140)
    assert device.stick.forward == 0.0, "a stick that does not quite come back"
    device.sends(EV_ABS, ABS_X, 32767)
    assert device.stick.right == pytest.approx(1.0)
    device.sends(EV_ABS, ABS_X, -20000)
    assert -0.6 < device.stick.right < -0.5


def test_joystick_any_button_press_is_emergency_stop(device: Device) -> None:
    assert device.sends(EV_KEY, 0x130, 1)
    assert not device.sends(EV_KEY, 0x130, 0)
    assert not device.sends(EV_KEY, 30, 1), "a key of a keyboard"


def test_joystick_lost_events_or_device_release_the_stick(device: Device) -> None:
    device.sends(EV_ABS, ABS_Y, 0)
    device.sends(EV_SYN, SYN_DROPPED, 0)
    assert device.stick.forward == 0.0
    device.sends(EV_ABS, ABS_Y, 0)
    device.unplug()
    device.stick.read_events(1.0)
    assert device.stick.is_lost
    assert device.stick.forward == 0.0


def test_joystick_is_released_when_newest_event_is_old(device: Device) -> None:
    assert device.stick.is_silent(0.0), "nothing has come yet"
    device.sends(EV_ABS, ABS_Y, 0, at_s=10.5)
    assert device.stick.forward == pytest.approx(1.0)
    assert not device.stick.is_silent(10.5 + STICK_AGE_S)
    assert device.stick.is_silent(10.6 + STICK_AGE_S), (
        "a receiver without its pad, or a program that was stopped"
    )
    device.sends(EV_ABS, ABS_Y, 1, at_s=20.0)
    assert not device.stick.is_silent(20.1)


def test_what_is_no_joystick_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "event0").write_text("")
    for path in (tmp_path / "event0", tmp_path / "event1"):
        with raises_error(ConfigError, code="command/invalid-option"):
            open_joystick(path)
