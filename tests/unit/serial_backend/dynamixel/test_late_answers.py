"""Servos behind a slow adapter, in real time: late answers are not those of a second servo with the same id."""

import threading
import time
from collections import deque
from collections.abc import Iterator

import pytest

from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend, make_servo
from snakesim_serial_backend.dynamixel.bring_up import bring_up
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.wire import PseudoTerminal, SerialWire
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 3
GAP_S = 0.1
SETTINGS = DynamixelSettings(physics_model="inertia", bring_up_limit_s=5.0)


class SlowPty(PseudoTerminal):
    """A pseudo terminal that passes answers on with a delay."""

    def __init__(self) -> None:
        super().__init__()
        self.delay_s = 0.0  # of each answer
        # Answers are passed on together, at multiples of this time; 0: each alone.
        self.burst_s = 0.0
        self.min_waiting = 1  # answers that are passed on together
        self._waiting: deque[tuple[float, bytes]] = deque()

    def send(self, data: bytes) -> None:
        due_s = time.monotonic() + self.delay_s
        if self.burst_s:
            due_s += self.burst_s - due_s % self.burst_s
        self._waiting.append((due_s, data))

    def pass_on(self) -> None:
        """Pass on the answers that are due."""
        if len(self._waiting) < self.min_waiting:
            return
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            super().send(self._waiting.popleft()[1])


class SlowBench:
    """Emulated servos that a thread serves, and a driver's port to them."""

    def __init__(self) -> None:
        self._config = make_run_config(
            backend="dynamixel", robot__chain__modules=JOINTS, rate_hz=50, clock_mode="realtime"
        )
        self.pty = SlowPty()
        self.emulator = DynamixelBackend.make_robot_emulator(
            self._config, SETTINGS, [self.pty], DriverClock(self._config), None
        )
        self._wire = SerialWire(self.pty.path, 1_000_000)
        self.port = DynamixelPort(self._wire, GAP_S)
        self.servos = [
            make_servo(joint, self.port, SETTINGS) for joint in self._config.robot.joint_table
        ]
        self._runs = True
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def bring_up(self) -> None:
        """Let the driver find and check the servos."""
        bring_up(self.servos, self.port, SETTINGS)

    def duplicate(self, joint: int) -> None:
        """Add a second servo with the id of a joint's, whose answer follows."""
        self.emulator.inject(parse_injection(f"duplicate:joint_{joint}@0-9"), begins=True)
        self.emulator.servos[joint - 1].table[at.DELAY] = 0

    def close(self) -> None:
        self._runs = False
        self._thread.join()
        self._wire.close()
        self.emulator.close()

    def _serve(self) -> None:
        while self._runs:
            self.emulator()
            self.pty.pass_on()
            time.sleep(0.001)


@pytest.fixture
def bench() -> Iterator[SlowBench]:
    one = SlowBench()
    yield one
    one.close()


@pytest.mark.parametrize(
    ("delay_s", "burst_s"), [(0.03, 0.0), (0.0, 0.06)], ids=["slow adapter", "computer that pauses"]
)
def test_late_answers_are_not_taken_for_those_of_a_second_servo(
    bench: SlowBench, delay_s: float, burst_s: float
) -> None:
    bench.pty.delay_s = delay_s
    bench.pty.burst_s = burst_s
    bench.bring_up()


def test_servos_that_answer_later_than_the_driver_waits_are_not_called_duplicated(
    bench: SlowBench,
) -> None:
    bench.pty.delay_s = 0.4
    try:
        bench.bring_up()
    except BackendError as error:
        assert "duplicated" not in str(error)
        assert "second servo" not in str(error)


@pytest.mark.parametrize("delay_s", [0.0, 0.03])
def test_a_second_servo_is_found_behind_a_slow_adapter_too(
    bench: SlowBench, delay_s: float
) -> None:
    bench.pty.delay_s = delay_s
    bench.duplicate(2)
    with raises_error(BackendError, code="drive/not-complete", field="joint_2") as raised:
        bench.bring_up()
    text = str(raised.value)
    assert "joint_2" in text and "answers one question twice" in text
    assert "joint_1" not in text and "joint_3" not in text, text


def test_a_late_answer_that_arrives_with_the_next_one_is_no_surplus(bench: SlowBench) -> None:
    bench.bring_up()
    bench.pty.min_waiting = 2
    first = bench.port.read_alone(2, at.PRESENT, at.present_form.size)
    assert (len(first.statuses), first.surplus_count) == (0, 0)
    second = bench.port.read_alone(2, at.PRESENT, at.present_form.size)
    assert (len(second.statuses), second.surplus_count) == (2, 0)
