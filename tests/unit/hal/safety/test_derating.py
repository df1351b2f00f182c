"""Heat, supply and leaks: what is derated, what stops the robot, and what is only told."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.safety.derating import REPORT_TIMEOUT_NS, WHERE_TO_SET_MIN_VOLTAGE, HealthMonitor
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, SensorDescription
from snakesim_testing.hal.limiter_rig import JOINT_COUNT
from snakesim_testing.hal.small_robots import make_description, make_power

MS = 1_000_000
S = 1000 * MS


class Bench:
    """A derating and its clock."""

    def __init__(
        self, *, expected: bool = False, awaits_reports: bool = False, **robot: Any
    ) -> None:
        sensor = SensorDescription(key=keys.POWER, rate_hz=2.0, delay_s=0.0)
        plain = make_description(**robot)
        sensors = [*plain.sensors, sensor] if expected else plain.sensors
        self.derating = HealthMonitor(
            msgspec.structs.replace(plain, sensors=sensors), awaits_reports=awaits_reports
        )
        self.now_ns = 5 * S
        self.notes: list[Fault] = []

    def receive(self, *values: Any, after_ns: int = 500 * MS, **other: Any) -> list[Fault]:
        """A sample, and what is newly wrong."""
        self.now_ns += after_ns
        self.derating.update(make_power(*values, **other), self.now_ns)
        return self.look(0)

    def look(self, after_ns: int) -> list[Fault]:
        self.now_ns += after_ns
        wrong, note = self.derating.evaluate(self.now_ns, 3)
        self.notes += [] if note is None else [note]
        return wrong

    @property
    def against_arming(self) -> list[str]:
        return self.derating.find_supply_problems(self.now_ns)

    @property
    def shares(self) -> list[float]:
        return self.derating.torque_fraction.tolist()


def test_nothing_is_derated_before_anything_is_known() -> None:
    bench = Bench()
    assert bench.shares == [1.0] * JOINT_COUNT
    assert bench.derating.current_faults == []
    assert bench.look(0) == []
    assert bench.shares == [1.0] * JOINT_COUNT
    assert bench.derating.find_derated_joints() == {}


def test_derating_joint_without_heat_or_voltage_sensor_never_stops() -> None:
    bench = Bench(
        joints={"joint_2": {"measures": ["torque"]}, "joint_3": {"measures": ["voltage"]}}
    )
    assert bench.receive(motor_c=[0.0, 300.0, 300.0], voltage_v=[24.0, 0.0, 24.0]) == []
    assert bench.look(100 * MS) == []
    assert bench.shares == [1.0] * JOINT_COUNT
    assert bench.against_arming == []
    low = bench.receive(motor_c=[0.0, 300.0, 300.0], voltage_v=[24.0, 0.0, 12.0]) + bench.look(
        100 * MS
    )
    assert [(fault.what, fault.joint) for fault in low] == [("undervoltage", "joint_3")]


@pytest.mark.parametrize(
    ("celsius", "share"),
    [(-40.0, 1.0), (80.0, 1.0), (85.0, 0.84), (92.5, 0.6), (104.9, 0.2032), (105, 0.2), (300, 0.2)],
)
def test_torque_fades_linearly(celsius: float, share: float) -> None:
    bench = Bench()
    bench.receive([20.0, celsius, 20.0])
    assert bench.shares == pytest.approx([1.0, share, 1.0])
    assert bench.derating.find_derated_joints() == (
        {} if share == 1.0 else {"joint_2": pytest.approx(share)}
    )


def test_the_robot_file_says_from_where_to_where() -> None:
    bench = Bench(limits__derate_from_c=50.0, limits__stop_at_c=60.0)
    assert bench.receive(55.0) == []
    assert bench.shares == pytest.approx([0.6] * JOINT_COUNT)
    assert len(bench.receive(60.0)) == JOINT_COUNT


STOP_AT_C = 105.0
COOL_BELOW_C = 80.0


def test_derating_winding_at_stop_temperature_is_a_fault_of_its_joint() -> None:
    bench = Bench()
    assert bench.receive([20.0, STOP_AT_C - 0.1, 20.0]) == []
    (fault,) = bench.receive([20.0, STOP_AT_C, 20.0])
    assert fault.what == "overheated"
    assert fault.joint == "joint_2"
    assert fault.tick == 3
    assert (
        fault.cause
        == "the winding of joint_2 is at 105.0 °C; the limit is 105 °C, and it must cool below 80 °C"
    )


@pytest.mark.parametrize("temperature_c", [STOP_AT_C - 1.0, COOL_BELOW_C])
def test_derating_overheated_fault_stays_until_winding_has_cooled(temperature_c: float) -> None:
    bench = Bench()
    bench.receive([20.0, STOP_AT_C, 20.0])
    assert bench.receive([20.0, temperature_c, 20.0]) == [], "the fault is reported once"
    assert len(bench.derating.current_faults) == 1


def test_derating_cooled_winding_that_overheats_again_is_a_new_fault() -> None:
    bench = Bench()
    bench.receive([20.0, STOP_AT_C, 20.0])
    assert bench.receive([20.0, COOL_BELOW_C - 0.1, 20.0]) == []
    assert bench.derating.current_faults == []
    assert len(bench.receive([20.0, STOP_AT_C + 5.0, 20.0])) == 1


def test_heat_that_was_too_much_is_not_forgotten_in_silence() -> None:
    bench = Bench()
    bench.receive([20.0, 110.0, 20.0])
    assert bench.look(10 * S) == []
    assert [fault.what for fault in bench.derating.current_faults] == ["overheated"]
    assert bench.shares == [1.0] * JOINT_COUNT


def test_water_stops_the_robot() -> None:
    bench = Bench()
    (fault,) = bench.receive(leak=[False, False, True])
    assert fault.what == "leak"
    assert fault.joint == "joint_3"
    assert fault.cause == "joint_3 reports water inside"
    assert bench.receive() == []
    assert bench.derating.current_faults == []


def test_a_weak_supply_stops_the_robot_after_50_ms() -> None:
    bench = Bench()
    assert bench.receive(voltage_v=[24.0, 17.9, 18.0]) == []
    assert bench.look(50 * MS - 1) == []
    (fault,) = bench.look(1)
    assert fault.what == "undervoltage"
    assert fault.joint == "joint_2"
    assert (
        fault.cause
        == f"the supply of joint_2 is at 17.9 V, it needs 18 V: {WHERE_TO_SET_MIN_VOLTAGE}"
    )
    assert bench.look(1) == []
    assert len(bench.derating.current_faults) == 1
    assert bench.receive() == []
    assert bench.derating.current_faults == []


WAY_OUT = "check the supply, or set `min_voltage_v` under [limits] in the robot file of 'worm'"


def test_a_weak_supply_keeps_the_robot_from_arming_at_once() -> None:
    bench = Bench()
    assert bench.receive(voltage_v=[24.0, 17.9, 18.0]) == []
    assert bench.against_arming == [
        f"the supply is at 17.9 V at joint_2, which needs 18 V: {WAY_OUT}"
    ]
    bench.receive(voltage_v=[12.5, 17.9, 12.0])
    assert bench.against_arming == [
        f"the supply is at 12.0 V at joint_3, which needs 18 V, and 2 more: {WAY_OUT}"
    ]
    bench.look(REPORT_TIMEOUT_NS)
    assert bench.against_arming != []
    bench.look(1)
    assert bench.against_arming == []  # what it was that long ago is not known to be so still
    bench.receive(voltage_v=[12.5, 17.9, 12.0])
    bench.receive()
    assert bench.against_arming == []


def test_a_robot_is_not_armed_before_its_supply_is_known() -> None:
    bench = Bench(expected=True, awaits_reports=True)
    assert bench.against_arming == ["joint_1 has not reported its supply yet, and 2 more"]
    bench.receive(valid=[True, False, True])
    assert bench.against_arming == ["joint_2 has not reported its supply yet"]
    bench.look(REPORT_TIMEOUT_NS)
    assert bench.against_arming == ["joint_2 has not reported its supply yet"]
    bench.look(1)
    assert bench.against_arming == []
    assert bench.notes != []  # it is noted, and ignored from now on
    for other in (
        Bench(expected=True),
        Bench(awaits_reports=True),
    ):  # whose time may stand; without such a sensor
        assert other.against_arming == []


def test_a_dip_of_the_supply_is_forgiven() -> None:
    bench = Bench()
    for _ in range(20):
        assert bench.receive(voltage_v=12.0, after_ns=20 * MS) == []
        assert bench.receive(voltage_v=24.0, after_ns=20 * MS) == []
    assert bench.receive(voltage_v=12.0, after_ns=30 * MS) == []
    assert (
        len(bench.receive(voltage_v=12.0, after_ns=50 * MS)) == JOINT_COUNT
    )  # since it was low first


def test_what_is_not_valid_or_no_number_says_nothing() -> None:
    bench = Bench()
    nan = float("nan")
    assert (
        bench.receive([300.0, nan, 300.0], [5.0, 24.0, nan], leak=True, valid=[False, True, True])
        == []
    )
    assert bench.look(1 * S) == []
    assert bench.shares == [1.0] * JOINT_COUNT


@pytest.mark.parametrize("column", ["motor_c", "voltage_v", "leak", "valid"])
def test_a_sample_of_another_number_of_joints_says_nothing(column: str) -> None:
    bench = Bench()
    values: dict[str, Any] = {"motor_c": 300.0, column: [1.0] * (JOINT_COUNT + 1)}
    assert bench.receive(**values) == []


def test_who_falls_silent_is_told_once_and_is_not_derated() -> None:
    bench = Bench()
    bench.receive(90.0)
    valid = [True, False, False]
    for _ in range(6):
        bench.receive(90.0, valid=valid)
    assert bench.notes == []
    assert bench.shares[1] < 1.0
    bench.receive(90.0, valid=valid, after_ns=1)
    (note,) = bench.notes
    assert note.what == "power_unknown"
    assert note.joint is None
    assert note.tick == 3
    assert note.cause == "supply and heat are unknown, and ignored, for joint_2, joint_3"
    assert bench.shares == pytest.approx([0.68, 1.0, 1.0])
    bench.receive(90.0, valid=[True, True, False])
    bench.look(3 * S)
    assert len(bench.notes) == 1
    bench.look(1)
    assert len(bench.notes) == 2
    assert bench.notes[1].cause.endswith("for joint_1, joint_2")


@pytest.mark.parametrize("reported", [{"leak": True}, {"voltage_v": 12.0}])
def test_derating_leak_and_voltage_of_silent_module_are_ignored(reported: dict[str, Any]) -> None:
    bench = Bench()
    bench.receive(**reported)
    bench.look(50 * MS)
    assert len(bench.derating.current_faults) == JOINT_COUNT
    bench.look(3 * S)
    assert bench.derating.current_faults == []


def test_derating_missing_reports_are_recorded_where_sensor_is_described() -> None:
    silent, absent = Bench(expected=True), Bench()
    for bench in (silent, absent):
        bench.look(0)
        bench.look(3 * S)
        assert bench.notes == []
        bench.look(1)
    assert absent.notes == []
    assert silent.notes[0].cause.endswith("for joint_1, joint_2, joint_3")
    assert silent.notes[0].joint is None


def test_one_silent_module_is_named() -> None:
    bench = Bench()
    bench.receive(valid=[True, False, False])
    bench.look(4 * S)
    assert bench.notes[0].joint == "joint_1"


def test_a_long_list_of_silent_modules_fits_into_a_message() -> None:
    bench = Bench(expected=True, chain__modules=100)
    bench.look(0)
    bench.look(4 * S)
    assert len(bench.notes[0].cause) == 400


@pytest.mark.parametrize(
    ("reported", "scope"),
    [({"motor_c": 110.0}, "joint"), ({"leak": True}, "robot"), ({"voltage_v": 12.0}, "robot")],
)
def test_heat_concerns_a_joint_and_water_and_voltage_the_robot(
    reported: dict[str, Any], scope: str
) -> None:
    bench = Bench()
    bench.receive(**reported)
    bench.look(50 * MS)
    assert [fault.scope for fault in bench.derating.current_faults] == [scope] * JOINT_COUNT
