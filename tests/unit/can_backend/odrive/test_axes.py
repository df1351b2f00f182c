"""The ODrive driver against emulated axes in lockstep, with the robot's lifecycle as the host would have it."""

from collections.abc import Iterator
from typing import Any

import pytest

from snakesim_can_backend.odrive.backend import OdriveBackend, OdriveSettings
from snakesim_can_backend.odrive.protocol import Error, State
from snakesim_can_backend.odrive.twin import OdriveTwin
from snakesim_hal.backend import SetPoints
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.injection import parse
from snakesim_hal.wire.messages import Fault, JointState, LifecycleState, Mode
from tests.unit.hal.rig import run_config

JOINTS = 4
CRASHED = 20  # ticks in which a fault shows: a heartbeat takes ten


class Axes:
    """A backend and its axes, tick by tick."""

    def __init__(self, **dotted: Any) -> None:
        self.config = run_config(backend="odrive", robot__chain__modules=JOINTS, rate_hz=100, **dotted)
        self.backend = OdriveBackend(self.config, OdriveSettings(plant="inertia", bring_up_limit_s=0.5))
        self.tick, self.isolated = 0, frozenset[int]()
        self.joints: JointState | None = None

    @property
    def twin(self) -> OdriveTwin:
        twin = getattr(self.backend._drives, "_twin", None)
        assert isinstance(twin, OdriveTwin)
        return twin

    def run(self, ticks: int, lifecycle: LifecycleState) -> list[Fault]:
        """So many periods; a fault latches, as in the host."""
        found: list[Fault] = []
        for _ in range(ticks):
            self.joints = self.backend.sample(self.tick, self.tick * self.config.period_ns).joints
            modes = [Mode.POSITION if lifecycle == "armed" else Mode.PASSIVE] * JOINTS
            points = SetPoints(modes, [0.1] * JOINTS, [1.0] * JOINTS, self.isolated)
            self.backend.enact(points, lifecycle)
            self.backend.advance()
            found += self.backend.faults()
            if found and lifecycle in ("armed", "disarmed"):
                lifecycle = "fault"
            self.tick += 1
        return found

    def go_wrong(self, text: str, *, begins: bool = True) -> None:
        assert self.backend.inject(parse(text), begins=begins)


@pytest.fixture
def axes() -> Iterator[Axes]:
    one = Axes()
    yield one
    one.backend.close()


def test_an_error_of_an_axis_stays_until_the_operators_clear_and_is_reported_again_if_it_is_still_there(
    axes: Axes,
) -> None:
    assert axes.run(30, "disarmed") == [] and axes.run(30, "armed") == []
    axes.go_wrong("overheat:joint_2@0-9")
    fault = axes.run(CRASHED, "armed")[0]
    assert (fault.what, fault.joint) == ("drive_fault", "joint_2") and "motor_over_temp" in fault.cause
    assert axes.run(100, "fault") == [] and axes.twin.axes[1].errors & Error.MOTOR_OVER_TEMP
    assert [fault.joint for fault in axes.run(CRASHED, "disarmed")] == ["joint_2"], "cleared while it was still hot"
    axes.go_wrong("overheat:joint_2@0-9", begins=False)
    axes.twin.body.thermal.winding_c[:] = 20.0
    axes.run(5, "fault")
    assert axes.run(CRASHED, "disarmed") == [] and axes.twin.axes[1].errors == 0
    assert axes.run(40, "armed") == [] and axes.joints is not None
    assert axes.joints.angle_rad == pytest.approx([0.1] * JOINTS, abs=0.02)


def test_an_axis_that_restarts_in_motion_gets_its_settings_again_with_the_clear(axes: Axes) -> None:
    axes.run(20, "armed")
    axes.go_wrong("reboot:joint_3@0")
    faults = axes.run(80, "armed")
    assert faults[0].what == "drive_silent" and faults[0].joint == "joint_3"
    assert not faults[1:]
    assert axes.run(10, "fault") == [] and axes.run(10, "disarmed") == []
    axes.run(40, "armed")
    fresh, other = axes.twin.axes[2], axes.twin.axes[0]
    assert fresh.state == State.CLOSED_LOOP and fresh.position_gain == other.position_gain
    assert fresh.current_limit == other.current_limit == 1.0


def test_a_joint_that_was_lost_while_armed_is_left_alone_until_it_is_used_again(axes: Axes) -> None:
    axes.run(20, "armed")
    axes.go_wrong("mute:joint_4@0")
    axes.isolated = frozenset({3})
    assert axes.run(60, "armed") == [] and axes.twin.axes[3].state == State.IDLE
    assert axes.twin.axes[0].state == State.CLOSED_LOOP
    axes.go_wrong("mute:joint_4@0", begins=False)
    axes.isolated = frozenset()
    assert axes.run(30, "disarmed") == []


def test_axes_stop_by_their_own_watchdog_when_the_driver_is_gone(axes: Axes) -> None:
    axes.run(20, "armed")
    axes.backend._clock.robot_ns += 150_000_000
    axes.twin()
    assert {axis.state for axis in axes.twin.axes} == {State.IDLE}
    assert all(axis.errors & Error.WATCHDOG_TIMER_EXPIRED for axis in axes.twin.axes)


def test_a_node_with_another_id_is_missing_at_the_start_and_a_stranger_later(
    axes: Axes, monkeypatch: pytest.MonkeyPatch
) -> None:
    axes.twin.axes[0].node = 9
    faults = axes.run(40, "disarmed")
    assert {(fault.what, fault.joint) for fault in faults} == {("drive_silent", "joint_1"), ("unknown_node", None)}
    assert any("node 9 is on the bus" in fault.cause for fault in faults)
    made = OdriveTwin.__init__

    def elsewhere(twin: OdriveTwin, *rest: Any) -> None:
        made(twin, *rest)
        twin._at.pop((id(twin.wires[1]), 2))

    monkeypatch.setattr(OdriveTwin, "__init__", elsewhere)
    with pytest.raises(BackendError, match=r"joint_2 \(node 2 on .*\) does not say its version: .*another id"):
        Axes()


@pytest.mark.parametrize(
    ("dotted", "words"),
    [
        ({"rate_hz": 500}, "4 drives at 500 Hz need"),
        ({"rate_hz": 20}, "`backends.odrive.watchdog_s` = 0.1 s at `rate_hz` = 20: one lost set-point"),
        ({"robot__joints": {"joint_2": {"id": 63}}}, "joint_2: `id` = 63; axes have ids of 0 to 62"),
        ({"robot__joints": {"joint_2": {"port": "can7"}}}, "joint_2: `port` = 'can7' is not among"),
    ],
)
def test_what_axes_cannot_do_is_refused_before_the_start(dotted: dict[str, Any], words: str) -> None:
    config = run_config(**{"backend": "odrive", "robot__chain__modules": JOINTS, "rate_hz": 100, **dotted})
    with pytest.raises(ConfigError, match=words.replace("(", r"\(")):
        OdriveBackend.check(config, OdriveSettings())
