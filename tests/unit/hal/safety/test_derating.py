"""The health monitor derates hot joints, stops the robot at leaks, heat and low supply, and notes silent modules."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.safety.derating import REPORT_TIMEOUT_NS, WHERE_TO_SET_MIN_VOLTAGE, HealthMonitor
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, SensorDescription
from snakesim_testing.hal.limiter_rig import JOINT_COUNT
from snakesim_testing.hal.small_robots import make_description, make_power

NS_PER_MS = 1_000_000
NS_PER_S = 1000 * NS_PER_MS


class HealthRig:
    """A health monitor and its clock."""

    def __init__(
        self, *, has_power_sensor: bool = False, awaits_reports: bool = False, **robot: Any
    ) -> None:
        sensor = SensorDescription(key=keys.POWER, rate_hz=2.0, delay_s=0.0)
        description = make_description(**robot)
        sensors = [*description.sensors, sensor] if has_power_sensor else description.sensors
        self.derating = HealthMonitor(
            msgspec.structs.replace(description, sensors=sensors), awaits_reports=awaits_reports
        )
        self.now_ns = 5 * NS_PER_S
        self.notes: list[Fault] = []

    def receive(self, *values: Any, after_ns: int = 500 * NS_PER_MS, **fields: Any) -> list[Fault]:
        """Give the monitor a power sample, and return the new faults."""
        self.now_ns += after_ns
        self.derating.update(make_power(*values, **fields), self.now_ns)
        return self.evaluate(0)

    def evaluate(self, after_ns: int) -> list[Fault]:
        """Let time pass, return the new faults, and keep the note."""
        self.now_ns += after_ns
        faults, note = self.derating.evaluate(self.now_ns, 3)
        self.notes += [] if note is None else [note]
        return faults

    @property
    def supply_problems(self) -> list[str]:
        return self.derating.find_supply_problems(self.now_ns)

    @property
    def torque_fractions(self) -> list[float]:
        return self.derating.torque_fraction.tolist()


def test_derating_without_samples_changes_nothing() -> None:
    rig = HealthRig()
    assert rig.torque_fractions == [1.0] * JOINT_COUNT
    assert rig.derating.current_faults == []
    assert rig.evaluate(0) == []
    assert rig.torque_fractions == [1.0] * JOINT_COUNT
    assert rig.derating.find_derated_joints() == {}


def test_derating_joint_without_heat_or_voltage_sensor_never_stops() -> None:
    rig = HealthRig(
        joints={"joint_2": {"measures": ["torque"]}, "joint_3": {"measures": ["voltage"]}}
    )
    assert rig.receive(motor_c=[0.0, 300.0, 300.0], voltage_v=[24.0, 0.0, 24.0]) == []
    assert rig.evaluate(100 * NS_PER_MS) == []
    assert rig.torque_fractions == [1.0] * JOINT_COUNT
    assert rig.supply_problems == []
    faults = rig.receive(motor_c=[0.0, 300.0, 300.0], voltage_v=[24.0, 0.0, 12.0]) + rig.evaluate(
        100 * NS_PER_MS
    )
    assert [(fault.what, fault.joint) for fault in faults] == [("undervoltage", "joint_3")]


@pytest.mark.parametrize(
    ("celsius", "fraction"),
    [(-40.0, 1.0), (80.0, 1.0), (85.0, 0.84), (92.5, 0.6), (104.9, 0.2032), (105, 0.2), (300, 0.2)],
)
def test_derating_reduces_torque_linearly_with_temperature(celsius: float, fraction: float) -> None:
    rig = HealthRig()
    rig.receive([20.0, celsius, 20.0])
    assert rig.torque_fractions == pytest.approx([1.0, fraction, 1.0])
    assert rig.derating.find_derated_joints() == (
        {} if fraction == 1.0 else {"joint_2": pytest.approx(fraction)}
    )


def test_derating_range_comes_from_the_robot_file() -> None:
    rig = HealthRig(limits__derate_from_c=50.0, limits__stop_at_c=60.0)
    assert rig.receive(55.0) == []
    assert rig.torque_fractions == pytest.approx([0.6] * JOINT_COUNT)
    assert len(rig.receive(60.0)) == JOINT_COUNT


STOP_AT_C = 105.0
COOL_BELOW_C = 80.0


def test_derating_winding_at_stop_temperature_is_a_joint_fault() -> None:
    rig = HealthRig()
    assert rig.receive([20.0, STOP_AT_C - 0.1, 20.0]) == []
    (fault,) = rig.receive([20.0, STOP_AT_C, 20.0])
    assert fault.what == "overheated"
    assert fault.joint == "joint_2"
    assert fault.tick == 3
    assert (
        fault.cause
        == "the winding of joint_2 is at 105.0 °C; the limit is 105 °C, and it must cool below 80 °C"
    )


@pytest.mark.parametrize("temperature_c", [STOP_AT_C - 1.0, COOL_BELOW_C])
def test_derating_overheated_fault_stays_until_winding_has_cooled(temperature_c: float) -> None:
    rig = HealthRig()
    rig.receive([20.0, STOP_AT_C, 20.0])
    assert rig.receive([20.0, temperature_c, 20.0]) == [], "the fault is reported once"
    assert len(rig.derating.current_faults) == 1


def test_derating_cooled_winding_that_overheats_again_is_a_new_fault() -> None:
    rig = HealthRig()
    rig.receive([20.0, STOP_AT_C, 20.0])
    assert rig.receive([20.0, COOL_BELOW_C - 0.1, 20.0]) == []
    assert rig.derating.current_faults == []
    assert len(rig.receive([20.0, STOP_AT_C + 5.0, 20.0])) == 1


def test_derating_overheated_fault_remains_while_module_is_silent() -> None:
    rig = HealthRig()
    rig.receive([20.0, 110.0, 20.0])
    assert rig.evaluate(10 * NS_PER_S) == []
    assert [fault.what for fault in rig.derating.current_faults] == ["overheated"]
    assert rig.torque_fractions == [1.0] * JOINT_COUNT


def test_derating_leak_is_a_fault_until_it_ends() -> None:
    rig = HealthRig()
    (fault,) = rig.receive(leak=[False, False, True])
    assert fault.what == "leak"
    assert fault.joint == "joint_3"
    assert fault.cause == "joint_3 reports water inside"
    assert rig.receive() == []
    assert rig.derating.current_faults == []


def test_derating_low_supply_is_a_fault_after_50_ms() -> None:
    rig = HealthRig()
    assert rig.receive(voltage_v=[24.0, 17.9, 18.0]) == []
    assert rig.evaluate(50 * NS_PER_MS - 1) == []
    (fault,) = rig.evaluate(1)
    assert fault.what == "undervoltage"
    assert fault.joint == "joint_2"
    assert (
        fault.cause
        == f"the supply of joint_2 is at 17.9 V, it needs 18 V: {WHERE_TO_SET_MIN_VOLTAGE}"
    )
    assert rig.evaluate(1) == []
    assert len(rig.derating.current_faults) == 1
    assert rig.receive() == []
    assert rig.derating.current_faults == []


ADVICE = "check the supply, or set `min_voltage_v` under [limits] in the robot file of 'worm'"


def test_derating_low_supply_prevents_arming_immediately() -> None:
    rig = HealthRig()
    assert rig.receive(voltage_v=[24.0, 17.9, 18.0]) == []
    assert rig.supply_problems == [
        f"the supply is at 17.9 V at joint_2, which needs 18 V: {ADVICE}"
    ]
    rig.receive(voltage_v=[12.5, 17.9, 12.0])
    assert rig.supply_problems == [
        f"the supply is at 12.0 V at joint_3, which needs 18 V, and 2 more: {ADVICE}"
    ]
    rig.evaluate(REPORT_TIMEOUT_NS)
    assert rig.supply_problems != []
    rig.evaluate(1)
    assert rig.supply_problems == []  # a voltage that was reported so long ago is unknown
    rig.receive(voltage_v=[12.5, 17.9, 12.0])
    rig.receive()
    assert rig.supply_problems == []


def test_derating_unknown_supply_prevents_arming_until_timeout() -> None:
    rig = HealthRig(has_power_sensor=True, awaits_reports=True)
    assert rig.supply_problems == ["joint_1 has not reported its supply yet, and 2 more"]
    rig.receive(valid=[True, False, True])
    assert rig.supply_problems == ["joint_2 has not reported its supply yet"]
    rig.evaluate(REPORT_TIMEOUT_NS)
    assert rig.supply_problems == ["joint_2 has not reported its supply yet"]
    rig.evaluate(1)
    assert rig.supply_problems == []
    assert rig.notes != []  # the unknown supply is noted, and ignored from now on
    in_lockstep = HealthRig(has_power_sensor=True)
    without_sensor = HealthRig(awaits_reports=True)
    assert in_lockstep.supply_problems == []
    assert without_sensor.supply_problems == []


def test_derating_short_voltage_drop_is_no_fault() -> None:
    rig = HealthRig()
    for _ in range(20):
        assert rig.receive(voltage_v=12.0, after_ns=20 * NS_PER_MS) == []
        assert rig.receive(voltage_v=24.0, after_ns=20 * NS_PER_MS) == []
    assert rig.receive(voltage_v=12.0, after_ns=30 * NS_PER_MS) == []
    assert (
        len(rig.receive(voltage_v=12.0, after_ns=50 * NS_PER_MS)) == JOINT_COUNT
    )  # counted from the first low report


def test_derating_invalid_or_nan_values_are_ignored() -> None:
    rig = HealthRig()
    nan = float("nan")
    assert (
        rig.receive([300.0, nan, 300.0], [5.0, 24.0, nan], leak=True, valid=[False, True, True])
        == []
    )
    assert rig.evaluate(1 * NS_PER_S) == []
    assert rig.torque_fractions == [1.0] * JOINT_COUNT


@pytest.mark.parametrize("column", ["motor_c", "voltage_v", "leak", "valid"])
def test_derating_sample_of_wrong_length_is_ignored(column: str) -> None:
    rig = HealthRig()
    values: dict[str, Any] = {"motor_c": 300.0, column: [1.0] * (JOINT_COUNT + 1)}
    assert rig.receive(**values) == []


def test_derating_silent_modules_are_noted_once_and_not_derated() -> None:
    rig = HealthRig()
    rig.receive(90.0)
    valid = [True, False, False]
    for _ in range(6):
        rig.receive(90.0, valid=valid)
    assert rig.notes == []
    assert rig.torque_fractions[1] < 1.0
    rig.receive(90.0, valid=valid, after_ns=1)
    (note,) = rig.notes
    assert note.what == "power_unknown"
    assert note.joint is None
    assert note.tick == 3
    assert note.cause == "supply and heat are unknown, and ignored, for joint_2, joint_3"
    assert rig.torque_fractions == pytest.approx([0.68, 1.0, 1.0])
    rig.receive(90.0, valid=[True, True, False])
    rig.evaluate(3 * NS_PER_S)
    assert len(rig.notes) == 1
    rig.evaluate(1)
    assert len(rig.notes) == 2
    assert rig.notes[1].cause.endswith("for joint_1, joint_2")


@pytest.mark.parametrize("values", [{"leak": True}, {"voltage_v": 12.0}])
def test_derating_leak_and_voltage_of_silent_module_are_ignored(values: dict[str, Any]) -> None:
    rig = HealthRig()
    rig.receive(**values)
    rig.evaluate(50 * NS_PER_MS)
    assert len(rig.derating.current_faults) == JOINT_COUNT
    rig.evaluate(3 * NS_PER_S)
    assert rig.derating.current_faults == []


def test_derating_missing_reports_are_recorded_where_sensor_is_described() -> None:
    silent = HealthRig(has_power_sensor=True)
    absent = HealthRig()
    for rig in (silent, absent):
        rig.evaluate(0)
        rig.evaluate(3 * NS_PER_S)
        assert rig.notes == []
        rig.evaluate(1)
    assert absent.notes == []
    assert silent.notes[0].cause.endswith("for joint_1, joint_2, joint_3")
    assert silent.notes[0].joint is None


def test_derating_single_silent_module_is_named() -> None:
    rig = HealthRig()
    rig.receive(valid=[True, False, False])
    rig.evaluate(4 * NS_PER_S)
    assert rig.notes[0].joint == "joint_1"


def test_derating_note_of_many_silent_modules_has_bounded_length() -> None:
    rig = HealthRig(has_power_sensor=True, chain__modules=100)
    rig.evaluate(0)
    rig.evaluate(4 * NS_PER_S)
    assert len(rig.notes[0].cause) == 400


@pytest.mark.parametrize(
    ("values", "scope"),
    [({"motor_c": 110.0}, "joint"), ({"leak": True}, "robot"), ({"voltage_v": 12.0}, "robot")],
)
def test_derating_heat_concerns_a_joint_and_others_the_robot(
    values: dict[str, Any], scope: str
) -> None:
    rig = HealthRig()
    rig.receive(**values)
    rig.evaluate(50 * NS_PER_MS)
    assert [fault.scope for fault in rig.derating.current_faults] == [scope] * JOINT_COUNT
