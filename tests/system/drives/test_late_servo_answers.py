"""In real time, late answers behind a slow adapter do not count as answers of a second servo with the same id."""

import threading
import time
from collections import deque
from collections.abc import Iterator

import pytest

from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend, make_servo
from snakesim_serial_backend.dynamixel.bring_up import bring_up
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.servo_checks import NO_ANSWER, RESPONDS_TWICE
from snakesim_serial_backend.wire import PseudoTerminal, SerialWire
from snakesim_testing.hal.small_robots import make_run_config

JOINTS = 3
GAP_S = 0.1
SETTINGS = DynamixelSettings(physics_model="inertia", bring_up_limit_s=5.0)


class SlowTerminal(PseudoTerminal):
    """A pseudo terminal that delivers answers with a delay."""

    def __init__(self) -> None:
        super().__init__()
        self.delay_s = 0.0  # of each answer
        # Answers are delivered together, at multiples of this time. With 0, each is delivered alone.
        self.burst_s = 0.0
        self.min_waiting = 1  # answers that are delivered together
        self._waiting: deque[tuple[float, bytes]] = deque()

    def send(self, data: bytes) -> None:
        due_s = time.monotonic() + self.delay_s
        if self.burst_s:
            due_s += self.burst_s - due_s % self.burst_s
        self._waiting.append((due_s, data))

    def deliver_due_answers(self) -> None:
        """Deliver the answers that are due."""
        if len(self._waiting) < self.min_waiting:
            return
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            super().send(self._waiting.popleft()[1])


class SlowServoRig:
    """Emulated servos that a thread serves, and the port of a driver to them."""

    def __init__(self) -> None:
        self._config = make_run_config(
            backend="dynamixel", robot__chain__modules=JOINTS, rate_hz=50, clock_mode="realtime"
        )
        self.pty = SlowTerminal()
        self.emulator = DynamixelBackend.make_robot_emulator(
            self._config, SETTINGS, [self.pty], DriverClock(self._config), None
        )
        self._wire = SerialWire(self.pty.path, 1_000_000)
        self.port = DynamixelPort(self._wire, GAP_S)
        self.servos = [
            make_servo(joint, self.port, SETTINGS) for joint in self._config.robot.joint_table
        ]
        self._is_running = True
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def bring_up(self) -> str:
        """Let the driver find and check the servos, and return what it reports; empty if all servos are accepted.

        The test is skipped if a servo was silent: the computer was too busy for its thread.
        """
        try:
            bring_up(self.servos, self.port, SETTINGS)
        except BackendError as error:
            assert error.code == "drive/not-complete"
            report = str(error)
            if NO_ANSWER in report:
                pytest.skip(f"the computer was too busy for the emulated servos: {report}")
            return report
        return ""

    def add_second_servo(self, joint: int) -> None:
        """Add a second servo with the id of the servo of a joint. Its answer follows that of the first one."""
        self.emulator.inject(parse_injection(f"duplicate:joint_{joint}@0-9"), begins=True)
        self.emulator.servos[joint - 1].table[registers.DELAY] = 0

    def close(self) -> None:
        self._is_running = False
        self._thread.join()
        self._wire.close()
        self.emulator.close()

    def _serve(self) -> None:
        while self._is_running:
            self.emulator()
            self.pty.deliver_due_answers()
            time.sleep(0.001)


@pytest.fixture
def rig() -> Iterator[SlowServoRig]:
    opened = SlowServoRig()
    yield opened
    opened.close()


@pytest.mark.parametrize(
    ("delay_s", "burst_s"), [(0.03, 0.0), (0.0, 0.06)], ids=["slow adapter", "computer that pauses"]
)
def test_late_answers_do_not_count_as_a_second_servo(
    rig: SlowServoRig, delay_s: float, burst_s: float
) -> None:
    rig.pty.delay_s = delay_s
    rig.pty.burst_s = burst_s
    assert rig.bring_up() == ""


def test_servos_with_answers_after_timeout_are_not_reported_as_duplicated(
    rig: SlowServoRig,
) -> None:
    rig.pty.delay_s = 0.4
    try:
        bring_up(rig.servos, rig.port, SETTINGS)
    except BackendError as error:
        assert RESPONDS_TWICE not in str(error)


@pytest.mark.parametrize("delay_s", [0.0, 0.03])
def test_second_servo_behind_a_slow_adapter_is_refused(rig: SlowServoRig, delay_s: float) -> None:
    rig.pty.delay_s = delay_s
    rig.add_second_servo(2)
    report = rig.bring_up()
    assert f"joint_2 (id 2 on {rig.pty.path}) {RESPONDS_TWICE}" in report
    assert "joint_1" not in report and "joint_3" not in report, report


def test_late_answer_together_with_the_next_is_no_surplus(rig: SlowServoRig) -> None:
    assert rig.bring_up() == ""
    rig.pty.min_waiting = 2
    first_reading = rig.port.read_alone(2, registers.PRESENT, registers.present_form.size)
    assert (len(first_reading.statuses), first_reading.surplus_count) == (0, 0)
    second_reading = rig.port.read_alone(2, registers.PRESENT, registers.present_form.size)
    if not second_reading.statuses:
        pytest.skip("the computer was too busy for the emulated servos")
    assert (len(second_reading.statuses), second_reading.surplus_count) == (2, 0)
