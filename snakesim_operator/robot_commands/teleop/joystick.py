"""A joystick or gamepad by Linux's event devices, /dev/input/event*.

Read directly, 24 bytes an event: the package `evdev` has no wheels, and would need a compiler and kernel headers.
Source: linux/input.h and linux/input-event-codes.h.

A device sends an event when something changes, and nothing otherwise. So a stick that is held still, a pad that is
switched off and a receiver that has lost its pad look alike. Each event has the time at which the kernel got it. The
position of the stick is valid for STICK_AGE_S from then on.
"""

import fcntl
import math
import os
import select
import struct
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.errors import ConfigError

EVENT = struct.Struct("llHHi")  # struct input_event on 64-bit: time, type, code, value
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_DROPPED = 3  # the kernel's buffer overflowed: events were lost
ABS_X, ABS_Y = 0, 1
BUTTONS = range(0x120, 0x140)  # BTN_JOYSTICK to BTN_THUMBR; every one of them is the emergency stop
ABSINFO = struct.Struct("6i")  # value, minimum, maximum, fuzz, flat, resolution
DEAD_ZONE = 0.12  # of the way to either side
MAX_EVENTS = 256  # in one read
CLOCK_MONOTONIC = 1  # the clock that is requested for the time of events
STICK_AGE_S = 5.0  # after this long without an event the stick counts as released


def _encode_write_ioctl(number: int, size: int) -> int:
    return 1 << 30 | size << 16 | ord("E") << 8 | number


def _encode_read_ioctl(number: int, size: int) -> int:
    return 2 << 30 | size << 16 | ord("E") << 8 | number


@dataclass(frozen=True)
class JoystickAxis:
    """The ends of an axis, in the device's unit."""

    lower: int
    upper: int

    def normalize(self, value: int) -> float:
        """Return a position from -1 to 1; 0 in the dead zone, from whose edge it grows without a jump."""
        middle = (self.lower + self.upper) / 2
        half_range = (self.upper - self.lower) / 2
        position = max(-1.0, min(1.0, (value - middle) / half_range))
        beyond_dead_zone = max(abs(position) - DEAD_ZONE, 0.0) / (1 - DEAD_ZONE)
        return beyond_dead_zone if position > 0 else -beyond_dead_zone


class Joystick:
    """The left stick and the buttons of one device."""

    def __init__(self, handle: int, x_axis: JoystickAxis, y_axis: JoystickAxis) -> None:
        """Start with a released stick.

        Args:
            handle: Non-blocking file descriptor of the device, which `close` closes.
            x_axis: Range of the stick's axis to the right.
            y_axis: Range of the stick's axis toward the operator.
        """
        self.handle = handle
        self._x_axis = x_axis
        self._y_axis = y_axis
        self.right = 0.0  # from -1 to 1
        self.forward = 0.0  # from -1 to 1
        self.is_lost = False  # unplugged, or its driver is gone
        # Monotonic time at which the kernel received the newest event.
        self.last_event_s = -math.inf

    def read_events(self, timeout_s: float) -> bool:
        """Read all events that have arrived, and update the position of the stick.

        If the joystick is unplugged, `is_lost` becomes true and the stick counts as released.

        Args:
            timeout_s: Maximum time to wait for the first event.

        Returns:
            Whether a button was pressed.
        """
        ready, _, _ = select.select([self.handle], [], [], timeout_s)
        if not ready:
            return False
        try:
            data = os.read(self.handle, MAX_EVENTS * EVENT.size)
        except BlockingIOError:
            return False
        except OSError:  # ENODEV: unplugged
            data = b""
        if not data:
            self.is_lost = True
            self._release()
            return False
        event_count = len(data) // EVENT.size  # an incomplete event at the end is dropped
        is_button_pressed = False
        for seconds, microseconds, event_type, code, value in EVENT.iter_unpack(
            data[: event_count * EVENT.size]
        ):
            self.last_event_s = seconds + 1e-6 * microseconds
            if event_type == EV_ABS and code == ABS_X:
                self.right = self._x_axis.normalize(value)
            elif event_type == EV_ABS and code == ABS_Y:
                self.forward = -self._y_axis.normalize(value)  # away from the operator is negative
            elif event_type == EV_SYN and code == SYN_DROPPED:
                self._release()  # the kernel lost events; the stick counts again once it is moved
            elif event_type == EV_KEY and code in BUTTONS and value == 1:
                is_button_pressed = True
        return is_button_pressed

    def _release(self) -> None:
        """Count the stick as released."""
        self.right = 0.0
        self.forward = 0.0

    def is_silent(self, now_s: float) -> bool:
        """Return whether there was no event for so long that the operator may have left or the connection be lost."""
        return now_s - self.last_event_s > STICK_AGE_S

    def close(self) -> None:
        """Close the device."""
        os.close(self.handle)


def open_joystick(device_path: Path | None) -> Joystick:
    """Open a joystick of Linux' event interface that has a stick and buttons.

    Args:
        device_path: Path of the device, such as /dev/input/event5. None selects the first device with a stick and
            buttons.

    Raises:
        ConfigError: There is no such device, or it cannot be opened.
    """
    paths = [device_path] if device_path is not None else sorted(Path("/dev/input").glob("event*"))
    problem = "there is no /dev/input/event*" if device_path is None else ""
    for path in paths:
        try:
            file_descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            problem = f"{path}: {error.strerror}"
            continue
        axes = _read_axes(file_descriptor)
        if axes is not None and _enable_monotonic_timestamps(file_descriptor):
            return Joystick(file_descriptor, *axes)
        os.close(file_descriptor)
        problem = f"{path}: has no stick with axes X and Y, and buttons"
    raise ConfigError(
        f"--joystick: {problem}. Plug one in, name its device, or get the permission: sudo usermod -aG input $USER, "
        f"and log in again",
        code="command/invalid-option",
    )


def _enable_monotonic_timestamps(handle: int) -> bool:
    """Request that events have timestamps of the monotonic clock, and return whether the device supports that."""
    try:
        fcntl.ioctl(handle, _encode_write_ioctl(0xA0, 4), struct.pack("i", CLOCK_MONOTONIC))
    except OSError:
        return False
    return True


def _read_axes(handle: int) -> tuple[JoystickAxis, JoystickAxis] | None:
    """Return the axes X and Y of the stick; None if an axis or the buttons of a joystick are missing."""
    try:
        if not _has_joystick_buttons(handle):
            return None
        x = _read_axis(handle, ABS_X)
        y = _read_axis(handle, ABS_Y)
    except OSError:
        return None
    if x is None or y is None:
        return None
    return x, y


def _has_joystick_buttons(handle: int) -> bool:
    """Return whether a device has any of BUTTONS; a touch pad has none."""
    bits = bytearray(96)  # one bit for each key code
    fcntl.ioctl(handle, _encode_read_ioctl(0x20 + EV_KEY, len(bits)), bits)
    return any(bits[code // 8] >> code % 8 & 1 for code in BUTTONS)


def _read_axis(handle: int, axis: int) -> JoystickAxis | None:
    """Return the range of an axis; None if it is empty."""
    info = bytearray(ABSINFO.size)
    fcntl.ioctl(handle, _encode_read_ioctl(0x40 + axis, len(info)), info)
    _, lower, upper, *_ = ABSINFO.unpack(info)
    if upper <= lower:
        return None
    return JoystickAxis(lower, upper)
