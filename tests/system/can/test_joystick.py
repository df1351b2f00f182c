"""Teleoperation finds and reads a joystick, a virtual device of the kernel (uinput), and notices its removal."""

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
# Constants of linux/input-event-codes.h, linux/input.h and linux/uinput.h.
BTN_SOUTH = 0x130
KEY_A = 30
BUS_USB = 3
UI_DEV_CREATE = 0x5501
UI_DEV_DESTROY = 0x5502
pytestmark = pytest.mark.skipif(
    not UINPUT.exists(), reason="this kernel has no uinput: sudo modprobe uinput"
)


def make_write_ioctl(number: int, size: int) -> int:
    """Return the number of an ioctl of uinput that writes a structure of this size."""
    return 1 << 30 | size << 16 | ord("U") << 8 | number


class VirtualDevice:
    """An input device that the kernel shows as /dev/input/event*. Source: linux/uinput.h."""

    def __init__(self, button: int) -> None:
        self._handle = os.open(UINPUT, os.O_WRONLY | os.O_NONBLOCK)
        for number, value in (
            (100, EV_KEY),
            (101, button),
            (100, EV_ABS),
            (103, ABS_X),
            (103, ABS_Y),
        ):
            fcntl.ioctl(self._handle, make_write_ioctl(number, 4), value)
        for axis, minimum, maximum in ((ABS_X, -100, 100), (ABS_Y, 0, 200)):
            center = (minimum + maximum) // 2
            setup = struct.pack("Hxx6i", axis, center, minimum, maximum, 0, 0, 0)
            fcntl.ioctl(self._handle, make_write_ioctl(4, len(setup)), setup)
        setup = struct.pack("4H80sI", BUS_USB, 1, 1, 1, b"a joystick of the tests", 0)
        fcntl.ioctl(self._handle, make_write_ioctl(3, len(setup)), setup)
        fcntl.ioctl(self._handle, UI_DEV_CREATE)

    def send_event(self, kind: int, code: int, value: int) -> None:
        """Send an event and the report that ends it."""
        os.write(self._handle, EVENT.pack(0, 0, kind, code, value) + EVENT.pack(0, 0, EV_SYN, 0, 0))

    def unplug(self) -> None:
        fcntl.ioctl(self._handle, UI_DEV_DESTROY)
        os.close(self._handle)


def find_joystick() -> Joystick | None:
    """Open the first joystick, or return None if there is none."""
    try:
        return open_joystick(None)
    except ConfigError:
        return None


def test_joystick_is_found_read_and_lost() -> None:
    device = VirtualDevice(BTN_SOUTH)
    stick = wait_until(find_joystick, "the device exists")
    device.send_event(EV_ABS, ABS_Y, 0)
    assert not stick.read_events(1.0)
    assert stick.forward == pytest.approx(1.0)
    device.send_event(EV_ABS, ABS_X, -100)
    assert not stick.read_events(1.0)
    assert stick.right == pytest.approx(-1.0)
    device.send_event(EV_KEY, BTN_SOUTH, 1)
    assert stick.read_events(1.0), "the emergency stop"
    device.unplug()
    wait_until(lambda: stick.read_events(0.1) or stick.is_lost, "the joystick is lost")
    assert stick.forward == 0.0
    stick.close()


def test_keyboard_with_axes_is_no_joystick() -> None:
    device = VirtualDevice(KEY_A)
    with raises_error(ConfigError, code="command/invalid-option", stored=False):
        open_joystick(None)
    device.unplug()
