"""Teleoperation's joystick on a virtual device of the kernel (uinput): found, read, and unplugged."""

import fcntl
import os
import struct
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
    Joystick,
    open_joystick,
)
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

UINPUT = Path("/dev/uinput")
BTN_SOUTH, KEY_A, BUS_USB = 0x130, 30, 3
CREATE, DESTROY = 0x5501, 0x5502
pytestmark = pytest.mark.skipif(
    not UINPUT.exists(), reason="this kernel has no uinput: sudo modprobe uinput"
)


def write_ioctl(number: int, size: int) -> int:
    return 1 << 30 | size << 16 | ord("U") << 8 | number


class Virtual:
    """A device that the kernel shows as /dev/input/event*. Source: linux/uinput.h."""

    def __init__(self, button: int) -> None:
        self._handle = os.open(UINPUT, os.O_WRONLY | os.O_NONBLOCK)
        for number, value in (
            (100, EV_KEY),
            (101, button),
            (100, EV_ABS),
            (103, ABS_X),
            (103, ABS_Y),
        ):
            fcntl.ioctl(self._handle, write_ioctl(number, 4), value)
        for axis, least, most in ((ABS_X, -100, 100), (ABS_Y, 0, 200)):
            setup = struct.pack("Hxx6i", axis, (least + most) // 2, least, most, 0, 0, 0)
            fcntl.ioctl(self._handle, write_ioctl(4, len(setup)), setup)
        setup = struct.pack("4H80sI", BUS_USB, 1, 1, 1, b"a joystick of the tests", 0)
        fcntl.ioctl(self._handle, write_ioctl(3, len(setup)), setup)
        fcntl.ioctl(self._handle, CREATE)

    def sends(self, kind: int, code: int, value: int) -> None:
        os.write(self._handle, EVENT.pack(0, 0, kind, code, value) + EVENT.pack(0, 0, EV_SYN, 0, 0))

    def unplug(self) -> None:
        fcntl.ioctl(self._handle, DESTROY)
        os.close(self._handle)


def found() -> Joystick | None:
    try:
        return open_joystick(None)
    except ConfigError:
        return None


def test_a_joystick_is_found_read_and_lost() -> None:
    device = Virtual(BTN_SOUTH)
    sticks: list[Joystick] = []
    wait_until(
        lambda: sticks.append(stick) or True if (stick := found()) else False,
        "the device to be there",
    )
    stick = sticks[0]
    device.sends(EV_ABS, ABS_Y, 0)
    assert not stick.read_events(1.0)
    assert stick.forward == pytest.approx(1.0)
    device.sends(EV_ABS, ABS_X, -100)
    assert not stick.read_events(1.0)
    assert stick.right == pytest.approx(-1.0)
    device.sends(EV_KEY, BTN_SOUTH, 1)
    assert stick.read_events(1.0), "the emergency stop"
    device.unplug()
    wait_until(lambda: stick.read_events(0.1) or stick.is_lost, "the stick to be lost")
    assert stick.forward == 0.0
    stick.close()


def test_a_keyboard_with_axes_is_no_joystick() -> None:
    device = Virtual(KEY_A)
    with raises_error(ConfigError, code="command/invalid-option", stored=False):
        open_joystick(None)
    device.unplug()
