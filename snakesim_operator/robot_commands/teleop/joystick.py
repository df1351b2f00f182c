"""A joystick or gamepad by Linux's event devices, /dev/input/event*.

Read directly, 24 bytes an event: the package `evdev` has no wheels, and would need a compiler and kernel headers.
Source: linux/input.h and linux/input-event-codes.h.

A device sends an event when something changes, and nothing otherwise. So a stick that is held still, a pad that is
switched off and a receiver that has lost its pad look alike. Each event has the time at which the kernel got it. What
the stick asks for counts for STICK_AGE_S from then on.
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
CLOCK_MONOTONIC = 1  # of which events have the time, once the device was asked for it
STICK_AGE_S = 5.0  # after this long without an event the stick counts as released


def _write_ioctl(number: int, size: int) -> int:
    return 1 << 30 | size << 16 | ord("E") << 8 | number


def _read_ioctl(number: int, size: int) -> int:
    return 2 << 30 | size << 16 | ord("E") << 8 | number


@dataclass(frozen=True)
class Axis:
    """The ends of an axis, in the device's unit."""

    least: int
    most: int

    def share(self, value: int) -> float:
        """From -1 to 1; 0 in the dead zone, from whose edge it begins without a jump."""
        middle, half = (self.least + self.most) / 2, (self.most - self.least) / 2
        share = max(-1.0, min(1.0, (value - middle) / half))
        beyond = max(abs(share) - DEAD_ZONE, 0.0) / (1 - DEAD_ZONE)
        return beyond if share > 0 else -beyond


class Joystick:
    """The left stick and the buttons of one device."""

    def __init__(self, handle: int, x: Axis, y: Axis) -> None:
        """handle: to read events from, without blocking; closed by `close`."""
        self.handle, self._x, self._y = handle, x, y
        self.right = self.forward = 0.0  # from -1 to 1
        self.lost = False  # unplugged, or its driver is gone
        self.moved_s = -math.inf  # when the kernel got the newest event, monotonic

    def take(self, wait_s: float) -> bool:
        """Take in what happened, at the latest after a time. Returns whether a button was pressed."""
        pressed = False
        ready, _, _ = select.select([self.handle], [], [], wait_s)
        if not ready:
            return False
        try:
            data = os.read(self.handle, MAX_EVENTS * EVENT.size)
        except BlockingIOError:
            return False
        except OSError:  # ENODEV: unplugged
            data = b""
        if not data:
            self.lost, self.right, self.forward = True, 0.0, 0.0
            return False
        for seconds, microseconds, kind, code, value in EVENT.iter_unpack(data[: len(data) // EVENT.size * EVENT.size]):
            self.moved_s = seconds + 1e-6 * microseconds
            if kind == EV_ABS and code == ABS_X:
                self.right = self._x.share(value)
            elif kind == EV_ABS and code == ABS_Y:
                self.forward = -self._y.share(value)  # away from the operator is negative
            elif kind == EV_SYN and code == SYN_DROPPED:
                self.right = self.forward = 0.0  # until the stick is moved again
            elif kind == EV_KEY and code in BUTTONS and value == 1:
                pressed = True
        return pressed

    def is_silent(self, now_s: float) -> bool:
        """Whether there was no event for so long that the operator, or the pad, may be gone."""
        return now_s - self.moved_s > STICK_AGE_S

    def close(self) -> None:
        """Close the device."""
        os.close(self.handle)


def open_joystick(device: Path | None) -> Joystick:
    """device: such as /dev/input/event5; None: the first with a stick and buttons. Raises ConfigError."""
    tried = [device] if device is not None else sorted(Path("/dev/input").glob("event*"))
    why = "there is no /dev/input/event*" if device is None else ""
    for path in tried:
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            why = f"{path}: {error.strerror}"
            continue
        axes = _axes(handle)
        if axes is not None and _has_monotonic_times(handle):
            return Joystick(handle, *axes)
        os.close(handle)
        why = f"{path}: has no stick with axes X and Y, and buttons"
    raise ConfigError(
        f"--joystick: {why}. Plug one in, name its device, or get the permission: sudo usermod -aG input $USER, "
        f"and log in again"
    )


def _has_monotonic_times(handle: int) -> bool:
    """Ask for events with the time of the monotonic clock, which nobody sets; whether the device does that."""
    try:
        fcntl.ioctl(handle, _write_ioctl(0xA0, 4), struct.pack("i", CLOCK_MONOTONIC))
    except OSError:
        return False
    return True


def _axes(handle: int) -> tuple[Axis, Axis] | None:
    """Of the stick; None when the device has none, or no joystick buttons, as a touch pad."""
    try:
        bits = bytearray(96)
        fcntl.ioctl(handle, _read_ioctl(0x20 + EV_KEY, len(bits)), bits)
        if not any(bits[code // 8] >> code % 8 & 1 for code in BUTTONS):
            return None
        found: list[Axis] = []
        for axis in (ABS_X, ABS_Y):
            info = bytearray(ABSINFO.size)
            fcntl.ioctl(handle, _read_ioctl(0x40 + axis, len(info)), info)
            _, least, most, *_ = ABSINFO.unpack(info)
            if most <= least:
                return None
            found.append(Axis(least, most))
        return found[0], found[1]
    except OSError:
        return None
