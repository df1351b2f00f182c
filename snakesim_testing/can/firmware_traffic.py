"""Generates random traffic for one joint module: valid and invalid frames, sensor values and pauses.

The same seed gives the same traffic. It consists of scenes, such as a run of some periods or a series of parameter
requests, so that a module reaches every state. Each line is an event of `firmware_replay`.
"""

import random
import struct
from collections.abc import Callable

from snakesim_can_backend.protocol.commands import make_command, make_emergency, make_sync
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    PARAMETERS,
    CanFrame,
    CommandAction,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    checksum,
    frame_id,
)

NODE = 5
OTHER_NODE = 6
PAUSES_US = (0, 1, 150, 999, 1000, 2500, 10_000, 20_000, 50_000, 99_999, 100_000, 100_001)
FIFTY_DAYS_US = 50 * 86_400_000_000  # the uptime of a heartbeat ends after 49.7 days
START_US = 1_000
WATCHDOGS_S = (0.02, 0.05, 0.0731, 0.1)
REPORT_PERIODS = (1.0, 2.0, 3.0)  # Syncs
NORMAL_WINDING_TENTHS_C = 251
COOLING_WINDING_TENTHS_C = 930  # a winding that overheated must become cooler before a clear
TEMPERATURES_TENTHS_C = (-900, 798, 800, 802, 1048, 1050, 1052, 2149, 2154, 3000)
BOUNDARY_VALUES = (0.0, -0.0, -1e-9, 1.0, 0.5, 2.0, 254.6, 255.0, 255.0001, 256.0)
NOT_FINITE = (float("nan"), float("inf"), float("-inf"), 3e38, -3e38)


class Traffic:
    """Generates the events of one seed."""

    def __init__(self, seed: int) -> None:
        self.events: list[str] = []
        self._random = random.Random(seed)
        self._now_us = START_US
        self._setpoint_count = 0
        self._sync_count = 0

    def generate_events(self, event_count: int) -> list[str]:
        """Return at least this many events."""
        rated_nm = self._random.choice((0.5, 4.0, 32.5))
        self._append(
            f"init {NODE} {self._random.getrandbits(32)} {rated_nm} 6.25 800 1050 18000 {START_US}"
        )
        self._set_sensors()
        scenes: list[tuple[int, Callable[[], None]]] = [
            (10, self._run_periods),
            (3, self._request_parameters),
            (3, self._send_wrong_frames),
            (2, self._send_random_frames),
            (3, self._break_sensors),
            (2, self._repeat_setpoints),
            (4, self._stop_in_motion),
            (1, self._stop_by_emergency),
            (1, self._reboot),
            (2, self._be_silent),
        ]
        weights = [weight for weight, _ in scenes]
        while len(self.events) < event_count:
            ((_, play),) = self._random.choices(scenes, weights)
            play()
        return self.events

    # --- scenes -------------------------------------------------------------------------------------------------

    def _run_periods(self) -> None:
        """Arm the module, and send setpoints and Syncs."""
        self._command(CommandAction.CLEAR)
        self._command(CommandAction.ARM)
        for _ in range(self._random.randrange(1, 40)):
            self._pause(self._random.choice((500, 5_000, 10_000, 20_000)))
            if self._random.random() < 0.9:
                self._send(self._make_setpoint())
            if self._random.random() < 0.9:
                self._sync()
            if self._random.random() < 0.1:
                self._set_sensors()

    def _request_parameters(self) -> None:
        """Read and write random parameters, mostly while the module is disarmed."""
        if self._random.random() < 0.7:
            self._command(CommandAction.DISARM)
        for _ in range(self._random.randrange(1, 12)):
            self._send(self._make_parameter_request())

    def _send_wrong_frames(self) -> None:
        """Send setpoints, commands and parameter requests with one error each."""
        self._command(CommandAction.ARM)
        for _ in range(self._random.randrange(1, 12)):
            frame = self._random.choice(
                (self._make_setpoint, self._make_command, self._make_parameter_request)
            )()
            self._send(self._break_frame(frame))
            if self._random.random() < 0.3:
                self._sync()

    def _send_random_frames(self) -> None:
        """Send frames with random data, half of them with an id that the module receives."""
        for _ in range(self._random.randrange(1, 20)):
            identifier = self._random.choice(
                (self._random.randrange(0x800), self._random.randrange(0x10000))
            )
            if self._random.random() < 0.5:
                identifier = frame_id(
                    self._random.choice(list(Opcode)), self._random.choice((0, NODE))
                )
            data = self._random.randbytes(self._random.randrange(9))
            self._send(CanFrame(identifier, data))

    def _break_sensors(self) -> None:
        """Let a sensor report a fault, send commands, and then let the fault go away."""
        self._command(CommandAction.ARM)
        self._set_sensors(self._random.choice(("sensor", "leak", "voltage", "heat", "several")))
        for _ in range(self._random.randrange(1, 8)):
            self._pause()
            self._send(self._make_command())
        self._set_sensors("cooling")
        self._command(CommandAction.CLEAR)
        self._set_sensors()
        self._pause()
        self._command(CommandAction.CLEAR)

    def _stop_in_motion(self) -> None:
        """Command a stop while the joint moves at a speed near the limit of "at rest"."""
        self._command(CommandAction.CLEAR)
        self._command(CommandAction.ARM)
        self._set_sensors(speed_mrad_s=self._random.choice((-1000, -50, -49, 49, 50, 51, 900)))
        self._send(self._make_setpoint())
        self._sync()
        self._command(CommandAction.STOP)
        for _ in range(self._random.randrange(1, 6)):
            self._pause()
            self._sync()
        self._set_sensors()

    def _repeat_setpoints(self) -> None:
        """Send one setpoint again and again, as a host that hangs."""
        self._command(CommandAction.CLEAR)
        self._command(CommandAction.ARM)
        repeated = self._make_setpoint()
        for _ in range(self._random.randrange(1, 9)):
            self._send(repeated)
            self._sync()

    def _stop_by_emergency(self) -> None:
        """Send an emergency stop with random data, and then a random command."""
        self._send(CanFrame(make_emergency().id, self._random.randbytes(self._random.randrange(9))))
        if self._random.random() < 0.5:
            self._set_sensors("several")
        self._pause()
        self._send(self._make_command())
        self._set_sensors()
        self._command(CommandAction.CLEAR)

    def _reboot(self) -> None:
        """Reboot the module, and send frames while it boots."""
        self._command(CommandAction.REBOOT)
        for _ in range(self._random.randrange(1, 6)):
            self._pause()
            self._send(
                self._random.choice((self._make_setpoint, self._make_command, make_emergency))()
            )
        self._pause(100_000)

    def _be_silent(self) -> None:
        """Send nothing to an armed module for longer than its watchdog allows."""
        self._command(CommandAction.ARM)
        self._pause(self._random.choice((100_000, 100_000, 300_000, 2_000_000, FIFTY_DAYS_US)))
        for _ in range(self._random.randrange(12)):
            self._pause()

    # --- events -------------------------------------------------------------------------------------------------

    def _append(self, event: str) -> None:
        self.events.append(event)

    def _pause(self, duration_us: int | None = None) -> None:
        """Let time pass, and poll the module."""
        self._now_us += self._random.choice(PAUSES_US) if duration_us is None else duration_us
        self._append(f"poll {self._now_us}")

    def _send(self, frame: CanFrame) -> None:
        """Send a frame, and mostly poll the module after it."""
        self._now_us += self._random.choice((0, 1, 130))
        self._append(f"frame {self._now_us} {frame.id:x} {frame.data.hex() or '-'}")
        if self._random.random() < 0.8:
            self._append(f"poll {self._now_us}")

    def _command(self, action: CommandAction) -> None:
        self._send(make_command(action, self._random.choice((BROADCAST, NODE))))

    def _sync(self) -> None:
        self._sync_count += self._random.choice((1, 1, 1, 2, 100))
        self._send(make_sync(self._sync_count, self._now_us))

    def _set_sensors(self, broken: str = "", speed_mrad_s: int | None = None) -> None:
        """Append an event that sets all measurements to random values, in the order of the event `sensors`.

        Args:
            broken: What is wrong: "sensor", "voltage", "leak", a case of `_choose_winding_tenths_c`, or "several" for
                any of them. Empty: nothing.
            speed_mrad_s: Speed of the joint in mrad/s; None for a slow random speed.
        """
        choose = self._random.choice
        # The order of the random choices is that of the values, so that a seed gives the same events.
        is_several = broken == "several"
        has_failed_sensor = broken == "sensor" or (is_several and choose((True, False)))
        angle = self._random.randrange(-40_000, 40_000)
        if speed_mrad_s is None:
            speed_mrad_s = self._random.randrange(-200, 200)
        torque = self._random.randrange(-40_000, 40_000)
        is_derated = choose((0, 1))
        has_low_voltage = broken == "voltage" or is_several
        voltages_mv = (0, 17_999, 18_000) if has_low_voltage else (18_000, 24_017, 70_000)
        voltage_mv = choose(voltages_mv)
        current_ma = self._random.randrange(-40_000, 40_000)
        winding_tenths_c = self._choose_winding_tenths_c(broken)
        board_tenths_c = choose((-500, 213, 2152))
        has_leak = broken == "leak" or (is_several and choose((True, False)))
        values = [
            int(not has_failed_sensor),
            angle,
            speed_mrad_s,
            torque,
            is_derated,
            voltage_mv,
            current_ma,
            winding_tenths_c,
            board_tenths_c,
            int(has_leak),
            100 * int(has_leak),  # water, in percent
        ]
        # Contacts of the link and of the tail.
        values += [*self._make_contact(), *self._make_contact()]
        # IMU.
        values += [choose((0, 1)), *(self._random.randrange(-40_000, 40_000) for _ in range(6))]
        values += [choose((0, 1)), self._random.randrange(-40_000, 40_000)]  # shaft load
        self._append("sensors " + " ".join(str(value) for value in values))

    def _choose_winding_tenths_c(self, broken: str) -> int:
        match broken:
            case "heat" | "several":
                return self._random.choice(TEMPERATURES_TENTHS_C)
            case "cooling":
                return COOLING_WINDING_TENTHS_C
            case _:
                return NORMAL_WINDING_TENTHS_C

    def _make_contact(self) -> list[int]:
        forces = [self._random.randrange(-5_000, 5_000) for _ in range(3)]
        return [
            self._random.choice((0, 1)),
            *forces,
            self._random.randrange(-700, 700),
            self._random.randrange(256),
        ]

    # --- frames -------------------------------------------------------------------------------------------------

    def _make_setpoint(self) -> CanFrame:
        """Return a random setpoint whose counter is mostly right."""
        step = self._random.choice((1,) * 12 + (2, 3, 4, 0, 9))
        self._setpoint_count = (self._setpoint_count + step) % 16
        mode = self._random.choice((0, 1, 1, 2, 3, 3, self._random.randrange(16)))
        target = self._random.randrange(-0x8000, 0x8000)
        limit = self._random.randrange(0x10000)
        data = struct.pack("<BhH", mode | self._setpoint_count << 4, target, limit)
        return _with_checksum(CanFrame(frame_id(Opcode.SET_POINT, NODE), data))

    def _make_command(self) -> CanFrame:
        key = self._random.choice((0x5AAE,) * 9 + (0x5AAF,))
        node = self._random.choice((BROADCAST, NODE, NODE, OTHER_NODE))
        data = struct.pack("<BH", self._random.randrange(8), key)
        return _with_checksum(CanFrame(frame_id(Opcode.COMMAND, node), data))

    def _make_parameter_request(self) -> CanFrame:
        index = self._random.choice(
            (*ModuleParameter, ModuleParameter.WATCHDOG, ModuleParameter.CONTACT_EVERY, 0, 14, 255)
        )
        operation = self._random.choice((*ParameterOperation, ParameterOperation.WRITE, 3, 15))
        value = self._choose_value(index)
        return CanFrame(
            frame_id(Opcode.PARAMETER_REQUEST, NODE), struct.pack("<BBf", index, operation, value)
        )

    def _choose_value(self, index: int) -> float:
        """Return a value in the range of a parameter, at its ends, outside of them, or one that is not a number."""
        if index not in PARAMETERS or self._random.random() < 0.3:
            return self._random.choice(BOUNDARY_VALUES + NOT_FINITE)
        if index == ModuleParameter.WATCHDOG and self._random.random() < 0.5:
            return self._random.choice(WATCHDOGS_S)
        if (
            index in (ModuleParameter.CONTACT_EVERY, ModuleParameter.IMU_EVERY)
            and self._random.random() < 0.7
        ):
            return self._random.choice(REPORT_PERIODS)
        allowed = PARAMETERS[ModuleParameter(index)]
        bound = self._random.choice((allowed.low, allowed.high))
        within = self._random.uniform(allowed.low, allowed.high)
        return self._random.choice(
            (bound, bound * (1 + 5e-7), bound * 1.00001, within, float(round(within)))
        )

    def _break_frame(self, frame: CanFrame) -> CanFrame:
        """Return a frame with a changed bit, another length, or another id."""
        data = bytearray(frame.data)
        match self._random.choice(("bit", "shorter", "longer", "node", "checksum")):
            case "bit":
                data[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
            case "shorter":
                del data[self._random.randrange(len(data)) :]
            case "longer":
                data += self._random.randbytes(8 - len(data))
            case "node":
                return CanFrame(frame.id ^ 1 << self._random.randrange(11), frame.data)
            case _:
                data[-1] ^= self._random.randrange(1, 256)
        return CanFrame(frame.id, bytes(data))


def _with_checksum(frame: CanFrame) -> CanFrame:
    return CanFrame(frame.id, frame.data + bytes((checksum(frame.id, frame.data),)))
