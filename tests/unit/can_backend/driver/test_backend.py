"""The whole driver on virtual buses with module twins: what goes over the wire, when it acts, and how it ends."""

import socket
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from snakesim_can_backend.bus.bus import OtherEnd, VirtualWire
from snakesim_can_backend.bus.load import Reports
from snakesim_can_backend.bus.log import LoggedWire
from snakesim_can_backend.driver import backend as backend_module
from snakesim_can_backend.driver.backend import CanBackend, _answer_time_s
from snakesim_can_backend.driver.bring_up import Bus
from snakesim_can_backend.protocol.commands import question
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    FROM_HOST,
    Action,
    Frame,
    LastStop,
    ModuleFault,
    ModuleState,
    Opcode,
    Parameter,
    node_of,
    opcode_of,
)
from snakesim_can_backend.settings import Settings
from snakesim_can_backend.twin.chain import ModuleChain
from snakesim_can_backend.twin.firmware import Module
from snakesim_can_backend.twin.inertia import InertiaPlant, InertiaSettings
from snakesim_can_backend.twin.server import Here, TwinServer, here
from snakesim_hal.backend import SetPoints
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.model.injection import Injection
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LifecycleState, Mode, Pose
from tests.unit.can_backend.loop import JOINTS, Loop, armed, config, loop
from tests.unit.can_backend.twin import rig

ARMED, DISARMED, EMERGENCY = ModuleState.ARMED, ModuleState.DISARMED, ModuleState.EMERGENCY
Which = Callable[[Frame], bool]


def none(_frame: Frame) -> bool:
    return False


class RecordedWire(VirtualWire):
    """A virtual bus that keeps what went over it, and does not take, or loses, what a test says."""

    def __init__(self, channel: str, other_end: OtherEnd | None = None) -> None:
        super().__init__(channel, other_end)
        self.sent: list[Frame] = []
        self.all: list[Frame] = []
        self.refuses: Which = none
        self.loses: Which = none
        self.deaf_to: Which = none
        self.closed = 0
        WIRES.append(self)

    def send(self, frame: Frame) -> bool:
        if self.refuses(frame):
            return False
        self.sent.append(frame)
        self.all.append(frame)
        return self.loses(frame) or super().send(frame)

    def receive(self) -> list[Frame]:
        frames = [frame for frame in super().receive() if not self.deaf_to(frame)]
        self.all += frames
        return frames

    def close(self) -> None:
        self.closed += 1
        super().close()


WIRES: list[RecordedWire] = []


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every driver of this file opens recorded wires."""
    WIRES.clear()
    monkeypatch.setattr(backend_module, "VirtualWire", RecordedWire)


def is_action(frame: Frame, *actions: Action) -> bool:
    return opcode_of(frame.id) == Opcode.COMMAND and rig.read(frame)["action"] in actions


def is_set_point(frame: Frame) -> bool:
    return opcode_of(frame.id) == Opcode.SET_POINT


def words(frames: list[Frame]) -> list[str]:
    """What the host said beside Syncs and set-points."""
    found = []
    for frame in frames:
        opcode = Opcode(opcode_of(frame.id))
        if opcode == Opcode.COMMAND:
            who = "" if node_of(frame.id) == BROADCAST else f" {node_of(frame.id)}"
            found.append(Action(int(rig.read(frame)["action"])).name.lower() + who)
        elif opcode == Opcode.EMERGENCY:
            found.append("emergency")
    return found


def module_of(run: Loop, node: int) -> Module:
    wire = run.backend._wires[0]
    wire = wire._wire if isinstance(wire, LoggedWire) else wire
    assert isinstance(wire, RecordedWire) and isinstance(wire.other_end, Here)
    return wire.other_end.server.chain.slots[node - 1].module


def go(run: Loop, lifecycle: LifecycleState, ticks: int = 1) -> list[Frame]:
    """So many ticks in a state, whatever is found; what was sent meanwhile."""
    before = len(WIRES[0].sent)
    for _ in range(ticks):
        run.lifecycle = lifecycle
        run.run(1)
    return WIRES[0].sent[before:]


# --- opening -----------------------------------------------------------------------------------------------


def test_bring_up_enables_nothing() -> None:
    with loop() as run:
        sent = WIRES[0].sent
        assert {opcode_of(frame.id) for frame in sent} == {Opcode.COMMAND, Opcode.PARAMETER_REQUEST, Opcode.SYNC}
        assert all(is_action(f, Action.IDENTIFY, Action.DISARM) for f in sent if opcode_of(f.id) == Opcode.COMMAND)
        disarm = next(i for i, frame in enumerate(sent) if is_action(frame, Action.DISARM))
        written = next(i for i, frame in enumerate(sent) if opcode_of(frame.id) == Opcode.PARAMETER_REQUEST)
        assert disarm < written and node_of(sent[disarm].id) == BROADCAST
        assert run.states() == [DISARMED] * JOINTS
        assert not any(is_set_point(frame) for frame in go(run, "disarmed", 30))
        assert run.faults == [] and run.true_speed_rad_s == [0.0] * 30


def test_who_does_not_answer_syncs_is_told_and_everything_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Deaf(RecordedWire):
        def __init__(self, channel: str, other_end: OtherEnd | None = None) -> None:
            super().__init__(channel, other_end)
            self.deaf_to = lambda frame: opcode_of(frame.id) == Opcode.JOINT_STATE and node_of(frame.id) == 2

    monkeypatch.setattr(backend_module, "VirtualWire", Deaf)
    with pytest.raises(BackendError, match="joint_2 did not answer 20 Syncs; nothing was enabled"), loop():
        pass
    (wire,) = WIRES
    assert wire.closed == 1 and words(wire.sent)[-1] == "disarm" and not any(map(is_set_point, wire.sent))


def left_behind(module: Module, kind: str) -> None:
    """What a module is like whose driver was killed, or worse."""
    if kind == "emergency":
        module.hear(rig.emergency(), 0.0)
        return
    module.hear(rig.command(Action.ARM), 0.0)
    module._fail(ModuleFault.STREAM if kind == "stream" else ModuleFault.WATCHDOG, 0.0)
    if kind == "leak":  # after the watchdog had stopped it, water came, and went
        module.inside.leak = True
        module.poll(0.0)
        module.inside.leak = False
        assert module.last_stop == LastStop.WATCHDOG


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        ("watchdog", DISARMED),
        ("stream", DISARMED),
        ("leak", ModuleState.FAULT),
        ("emergency", EMERGENCY),
    ],
)
def test_what_a_killed_driver_left_is_cleared_and_nothing_else(
    kind: str, state: ModuleState, monkeypatch: pytest.MonkeyPatch
) -> None:
    def twins(run: RunConfig, settings: Settings, channel: str, pose: str | None, *, stepped: bool) -> Here:
        end = here(run, settings, channel, pose, stepped=stepped)
        left_behind(end.server.chain.slots[1].module, kind)
        return end

    monkeypatch.setattr(backend_module, "twins_here", twins)
    with loop() as run:
        go(run, "disarmed", 2)
        assert run.states() == [DISARMED, state, DISARMED, DISARMED]
        assert words(WIRES[0].sent).count("clear 2") == (state == DISARMED)
        found = [fault for _ in range(3) for fault in (go(run, "disarmed"), *run.faults)[1:]]
        assert {fault.joint for fault in found} == (set() if state == DISARMED else {"joint_2"})


def test_a_module_that_is_too_weak_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def twins(run: RunConfig, settings: Settings, channel: str, pose: str | None, *, stepped: bool) -> Here:
        end = here(run, settings, channel, pose, stepped=stepped)
        end.server.chain.slots[2].module.parameters.values[Parameter.RATED_TORQUE] = 1.0
        return end

    monkeypatch.setattr(backend_module, "twins_here", twins)
    with pytest.raises(BackendError, match=r"joint_3 is rated for 1 N·m"), loop():
        pass


def test_paces_and_what_is_checked_before_anything_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    assert CanBackend.check(config(), Settings()) == ("lockstep", "realtime")
    with pytest.raises(ConfigError, match="channel 'nocan7'"):
        CanBackend.check(config(), Settings(channels=["nocan7"]))
    asked: list[str] = []
    monkeypatch.setattr(backend_module, "check_interface", asked.append)
    assert CanBackend.check(config(), Settings(channels=["can0", "can1"])) == ("realtime",)
    assert CanBackend.check(config(), Settings(channels=["vcan0"], twins="process")) == ("lockstep", "realtime")
    assert asked == ["can0", "can1", "vcan0"]
    for settings, text in (
        (Settings(twins="none"), "needs a bus"),
        (Settings(faults=["mute:joint_9@1"]), "joint_9"),
    ):
        with pytest.raises(ConfigError, match=text):
            CanBackend.check(config(), settings)
    with pytest.raises(ConfigError, match="do not fit"):
        CanBackend.check(config(robot__chain__modules=40, rate_hz=200), Settings())
    with pytest.raises(ConfigError, match="hold"):
        CanBackend.check(config(robot__safety__action="hold"), Settings())
    assert WIRES == []


def test_it_describes_robot_and_sensors_and_delivers_them() -> None:
    sensors = {
        "robot__sensors__contacts__rate_hz": 50.0,
        "robot__sensors__imu__rate_hz": 50.0,
        "robot__sensors__pose__rate_hz": 50.0,
    }
    with loop(config(**sensors), plant="mujoco") as run:
        description = run.backend.describe()
        assert description.backend == "can"
        assert [joint.name for joint in description.joints] == ["joint_1", "joint_2", "joint_3", "joint_4"]
        go(run, "disarmed", 60)
        delivered = {"sensor/joints"}.union(*(samples.others for samples in run.samples))
        assert delivered == {sensor.key for sensor in description.sensors}


def test_answers_are_waited_for_as_long_as_the_fullest_bus_takes() -> None:
    wire = VirtualWire("answers")
    buses = [Bus(wire, range(1, 14)), Bus(wire, range(14, 20))]
    wire.close()
    assert _answer_time_s(buses, Reports(100.0)) == pytest.approx(1.25 * 27 * 135e-6 + 0.002)
    assert _answer_time_s(buses, Reports(100.0, 0, tail=False)) == pytest.approx(1.25 * 13 * 135e-6 + 0.002)


# --- a period ----------------------------------------------------------------------------------------------


def test_a_command_acts_exactly_one_period_after_the_state_that_it_answers() -> None:
    change_at = 15
    speeds = []
    for torque_nm in (0.0, 1.0):
        with loop() as run:
            run.wanted = SetPoints([Mode.TORQUE] * JOINTS, [0.0] * JOINTS, [4.0] * JOINTS)
            run.arm()

            def wish(tick: int, torque_nm: float = torque_nm) -> SetPoints:
                return SetPoints([Mode.TORQUE] * JOINTS, [torque_nm * (tick == change_at)] * JOINTS, [4.0] * JOINTS)

            run.run(change_at + 5 - run.tick, wish)
            speeds.append(np.array([samples.joints.velocity_rad_s for samples in run.samples]))
    moved = (np.abs(speeds[1] - speeds[0]) > 1e-9).any(axis=1)
    assert not moved[: change_at + 2].any(), "it waits for the next Sync"
    assert moved[change_at + 2 :].all(), "and acts from then on"


def test_every_joint_may_be_in_its_own_mode() -> None:
    modes = [Mode.POSITION, Mode.VELOCITY, Mode.TORQUE, Mode.PASSIVE]
    targets = [0.2, -0.5, 0.3, 0.0]
    with loop() as run:
        run.arm()
        run.run(3, lambda _tick: SetPoints(modes, targets, [4.0, 3.0, 2.0, 0.0]))
        demands = [module_of(run, node).demand for node in (1, 2, 3, 4)]
        assert [demand.mode for demand in demands] == modes
        assert [demand.target for demand in demands] == pytest.approx(targets)
        assert [demand.torque_limit_nm for demand in demands] == pytest.approx([4.0, 3.0, 2.0, 0.0])
        run.run(60, lambda _tick: SetPoints(modes, targets, [4.0, 3.0, 2.0, 0.0]))
        joints = run.samples[-1].joints
        assert joints.angle_rad[0] == pytest.approx(0.2, abs=0.02)
        assert joints.velocity_rad_s[1] == pytest.approx(-0.5, abs=0.15)
        assert run.faults == []


def test_a_period_has_one_sync_and_one_set_point_for_each_module() -> None:
    with loop() as run:
        run.arm()
        for _ in range(20):
            sent = go(run, "armed")
            assert [opcode_of(frame.id) for frame in sent] == [Opcode.SYNC, *[Opcode.SET_POINT] * JOINTS]
            assert [node_of(frame.id) for frame in sent[1:]] == [1, 2, 3, 4]
        counts = [rig.read(f)["count"] for f in WIRES[0].sent if opcode_of(f.id) == Opcode.SYNC]
        assert counts == [i % 256 for i in range(len(counts))]
        times = [rig.read(f)["time"] for f in WIRES[0].sent if opcode_of(f.id) == Opcode.SYNC]
        assert np.diff(times[-20:]).tolist() == [10_000] * 19


# --- who may move ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lifecycle", "said", "state"),
    [
        ("disarmed", ["disarm"], DISARMED),
        ("fault", ["stop"], DISARMED),
        ("estop", ["emergency"], EMERGENCY),
    ],
)
def test_only_an_armed_robot_gets_set_points(lifecycle: LifecycleState, said: list[str], state: ModuleState) -> None:
    with loop() as run:
        run.arm()
        run.run(20, run.waving)
        assert max(run.true_speed_rad_s) > 0.3
        sent = go(run, lifecycle, 40)
        assert not any(map(is_set_point, sent))
        assert words(sent)[:1] == said and len(words(sent)) <= 3, "a word, and not all the time"
        assert run.states() == [state] * JOINTS and run.true_speed_rad_s[-1] < 0.05
        assert run.faults == []


def test_an_emergency_stays_in_the_modules_until_somebody_clears() -> None:
    with loop() as run:
        run.arm()
        go(run, "estop", 30)
        assert run.states() == [EMERGENCY] * JOINTS
        assert words(go(run, "disarmed"))[0] == "clear"
        go(run, "disarmed", 10)
        assert run.states() == [DISARMED] * JOINTS and run.faults == []
        run.wanted = None
        run.arm()
        run.run(20, run.waving)
        assert run.faults == []


@pytest.mark.parametrize("latched", ["estop", "fault"])
def test_clearing_and_arming_between_two_ticks_works(latched: LifecycleState) -> None:
    with loop() as run:
        run.arm()
        go(run, latched, 25)
        assert words(go(run, "armed"))[:2] == ["clear", "arm"]
        run.arm()
        run.run(20, run.waving)
        assert run.faults == [] and max(run.true_speed_rad_s[-10:]) > 0.1


def test_an_arming_that_is_lost_is_said_again_to_those_who_need_it() -> None:
    with loop() as run:
        WIRES[0].loses = lambda frame: is_action(frame, Action.ARM) and node_of(frame.id) == BROADCAST
        sent = go(run, "armed", 6)
        assert words(sent)[:5] == ["arm", "arm 1", "arm 2", "arm 3", "arm 4"]
        assert run.states() == [ARMED] * JOINTS and run.faults == []


def test_who_was_armed_and_stopped_is_not_armed_again_by_itself() -> None:
    with loop() as run:
        go(run, "armed", 3)
        assert run.states() == [ARMED] * JOINTS
        module_of(run, 2).hear(rig.command(Action.DISARM), 0.0)
        before = len(WIRES[0].sent)
        run.run(5)
        assert words(WIRES[0].sent[before:]) == ["stop"] and module_of(run, 2).state == DISARMED
        assert [(fault.what, fault.joint) for fault in run.faults] == [("module_not_armed", "joint_2")]


def test_an_emergency_that_is_lost_is_said_until_everybody_has_heard() -> None:
    lost: list[Frame] = []

    def lose_some(frame: Frame) -> bool:
        lost.extend([frame] * (frame.id == 0))
        return frame.id == 0 and len(lost) < 10

    with loop() as run:
        run.arm()
        WIRES[0].loses = lose_some
        go(run, "estop", 10)
        assert run.states() == [EMERGENCY] * JOINTS
        assert words(go(run, "estop", 10)) == []


def test_a_stop_that_is_lost_is_said_again() -> None:
    with loop() as run:
        run.arm()
        WIRES[0].loses = lambda frame: is_action(frame, Action.STOP) and node_of(frame.id) == BROADCAST
        assert words(go(run, "fault", 3)) == ["stop", "stop 1", "stop 2", "stop 3", "stop 4"]
        go(run, "fault", 20)
        assert run.states() == [DISARMED] * JOINTS


# --- frames that the bus does not take ---------------------------------------------------------------------


def test_a_set_point_that_is_refused_is_replaced_and_never_sent_later() -> None:
    with loop() as run:
        run.arm()
        start = run.tick
        refused = (start + 4, start + 5, start + 9)
        WIRES[0].refuses = lambda frame: is_set_point(frame) and node_of(frame.id) == 2 and run.tick in refused
        by_tick: dict[int, list[dict[str, float]]] = {}
        for _ in range(30):
            tick = run.tick
            before = len(WIRES[0].sent)
            run.run(1, lambda tick: SetPoints([Mode.POSITION] * 4, [0.001 * (tick - start)] * 4, [4.0] * 4))
            mine = [f for f in WIRES[0].sent[before:] if is_set_point(f) and node_of(f.id) == 2]
            by_tick[tick] = [rig.read(frame) for frame in mine]
        assert [tick for tick, frames in by_tick.items() if not frames] == list(refused)
        assert all(len(frames) == 1 for tick, frames in by_tick.items() if tick not in refused)
        sent = {tick: frames[0] for tick, frames in by_tick.items() if frames}
        assert all(f["position"] == pytest.approx(0.001 * (tick - start)) for tick, f in sent.items()), "the newest"
        counts = [int(frame["count"]) for frame in sent.values()]
        assert all((b - a) % 16 == 1 for a, b in pairwise(counts)), "a count is of what was sent"
        assert run.faults == [] and run.states() == [ARMED] * JOINTS


def test_a_bus_that_stays_full_is_told_after_three_periods() -> None:
    with loop() as run:
        run.arm()
        WIRES[0].refuses = is_set_point
        run.run(2)
        assert run.faults == []
        run.run(2)
        (fault,) = [fault for fault in run.faults if fault.what == "bus_stuck"]
        assert fault.joint is None and WIRES[0].channel in fault.cause
        WIRES[0].refuses = none
        assert not any(map(is_set_point, go(run, "fault", 20))), "nothing was kept for later"


def test_a_bus_that_takes_no_sync_is_told_even_when_nothing_is_armed() -> None:
    with loop() as run:
        run.run(2)
        WIRES[0].refuses = lambda frame: opcode_of(frame.id) == Opcode.SYNC
        run.run(8)
        assert [fault.what for fault in run.faults] == ["bus_stuck"], "and no module is blamed for it"
        assert run.samples[-1].joints.valid == [False] * JOINTS


# --- modules that restart ----------------------------------------------------------------------------------


def test_a_restarted_module_is_not_armed_before_it_has_its_parameters() -> None:
    with loop(faults=["reboot:joint_2@0.3"]) as run:
        run.arm()
        module = module_of(run, 2)
        run.run(25 - run.tick)
        assert module.state == ARMED
        states: list[ModuleState] = []
        for _ in range(60):
            run.run(1)
            states.append(module.state)
        assert ARMED not in states[states.index(ModuleState.BOOT) :]
        assert module.parameters.values[Parameter.STIFFNESS] == 0.0
        assert "module_restarted" in [fault.what for fault in run.faults] and run.lifecycle == "fault"
        go(run, "armed", 8)  # cleared and armed between two ticks
        assert run.states() == [ARMED] * JOINTS
        assert module.parameters.values[Parameter.STIFFNESS] == 40.0


def test_a_robot_is_not_armed_while_a_module_does_not_take_its_parameters() -> None:
    with loop(faults=["reboot:joint_2@0.3"]) as run:
        WIRES[0].loses = lambda frame: opcode_of(frame.id) == Opcode.PARAMETER_REQUEST
        run.run(60)
        assert run.lifecycle == "fault"
        before = len(run.faults)
        sent = go(run, "armed", 1) + go(run, "fault", 3)
        assert "clear" in words(sent) and "arm" not in words(sent)
        assert [(fault.what, fault.joint) for fault in run.faults[before:]] == [("module_not_configured", "joint_2")]
        assert ARMED not in run.states()
        WIRES[0].loses = none
        before = len(run.faults)
        go(run, "armed", 8)
        assert run.states() == [ARMED] * JOINTS and run.faults[before:] == []
        assert module_of(run, 2).parameters.values[Parameter.STIFFNESS] == 40.0


# --- several buses -----------------------------------------------------------------------------------------


class OneChain:
    """Twins of one robot on several virtual buses; the first wire that is idle lets them all run."""

    def __init__(self, server: TwinServer) -> None:
        self.server = server
        self.closed = False

    def __call__(self) -> float | None:
        return None if self.closed else self.server.run_due(0)

    def inject(self, injection: Injection, *, begins: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        if not self.closed:
            for wire in self.server.wires:
                wire.close()
        self.closed = True


class NoProcess:
    """Instead of a child with the twins in it."""

    started: list[tuple[Any, ...]] = []
    stopped = 0
    ended: str | None = None

    def __init__(self, run: RunConfig, settings: Settings, pose: str | None, *, stepped: bool) -> None:
        self.started.append((settings.channels, pose, stepped))

    def how_it_ended(self) -> str | None:
        return self.ended

    def stop(self) -> None:
        type(self).stopped += 1


@pytest.fixture
def two_buses(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[list[int]], Loop]]:
    """Opens a driver for two buses with so many joints each, on twins with three and one."""
    run, channels = config(robot__sensors__pose__rate_hz=100.0), ["bus_a", "bus_b"]
    real = Settings(channels=channels, joints_per_channel=[3, 1], twins="process", plant="inertia")
    chain = ModuleChain(run, real, InertiaPlant(run, InertiaSettings()), stepped=True)
    end = OneChain(TwinServer([VirtualWire(name) for name in channels], chain))
    monkeypatch.setattr(backend_module, "check_interface", lambda _channel: None)
    monkeypatch.setattr(backend_module, "SocketCanWire", lambda name: RecordedWire(name, end))
    monkeypatch.setattr(backend_module, "TwinProcess", NoProcess)
    opened: list[CanBackend] = []

    def open_with(joints: list[int], **settings: Any) -> Loop:
        asked = Settings(channels=channels, joints_per_channel=joints, twins="process", **settings)
        opened.append(CanBackend(run, asked))
        return TwoBusLoop(opened[-1], run)

    yield open_with
    for driver in opened:
        driver.close()
    end.close()


class TwoBusLoop(Loop):
    @property
    def plant(self) -> Any:
        wire = WIRES[0]
        assert isinstance(wire.other_end, OneChain)
        return wire.other_end.server.chain.plant


def test_every_module_is_spoken_to_on_its_own_bus(two_buses: Callable[..., Loop]) -> None:
    NoProcess.started.clear()
    run = two_buses([3, 1])
    ((channels, pose, stepped),) = NoProcess.started
    assert channels == ["bus_a", "bus_b"] and pose.startswith("127.0.0.1:") and stepped
    run.arm()
    run.run(30, run.waving)
    assert run.faults == []
    a, b = WIRES
    for wire, nodes in ((a, {1, 2, 3}), (b, {4})):
        assert {node_of(frame.id) for frame in wire.sent} == {0, *nodes}
        assert {node_of(frame.id) for frame in wire.sent if is_set_point(frame)} == nodes
    counts = [[f.data for f in wire.sent if opcode_of(f.id) == Opcode.SYNC] for wire in WIRES]
    assert counts[0] == counts[1], "all are seen at one instant"
    b.refuses = is_set_point
    run.run(7, run.waving)
    assert [fault.cause[:6] for fault in run.faults if fault.what == "bus_stuck"] == ["bus_b:"]
    stopped = NoProcess.stopped
    run.backend.close()
    assert [words(wire.sent)[-1] for wire in WIRES] == ["disarm", "disarm"]
    assert NoProcess.stopped == stopped + 1 and [wire.closed for wire in WIRES] == [1, 1]


def test_in_lockstep_nothing_that_twins_said_is_still_on_its_way_when_a_tick_goes_on(
    two_buses: Callable[..., Loop],
) -> None:
    run = two_buses([3, 1])
    run.run(2)
    for wire in WIRES:
        wire.sent.clear()
    run.run(20)
    for wire, node in zip(WIRES, (1, 4), strict=True):
        asked = [opcode_of(f.id) for f in wire.sent if f == question(node) or opcode_of(f.id) == Opcode.SYNC]
        assert asked == [Opcode.SYNC, Opcode.PARAMETER_REQUEST] * 20
    assert run.backend._reading.answers_missing == 0
    run.backend.close()


def test_a_module_on_the_wrong_bus_is_found_before_anything_is_enabled(two_buses: Callable[..., Loop]) -> None:
    with pytest.raises(BackendError, match=r"joint_3 \(node 3 on bus_b\) does not answer; a node 3 answers on bus_a"):
        two_buses([2, 2], bring_up_limit_s=0.3)
    assert [wire.closed for wire in WIRES] == [1, 1]
    assert not any(is_action(frame, Action.DISARM) for wire in WIRES for frame in wire.sent), "they are another's"


def test_a_driver_whose_twins_have_died_ends(two_buses: Callable[..., Loop], monkeypatch: pytest.MonkeyPatch) -> None:
    run = two_buses([3, 1])
    run.run(1)
    monkeypatch.setattr(NoProcess, "ended", "they died")
    with pytest.raises(BackendError, match="they died"):
        run.run(1)


def test_a_bus_that_fails_does_not_keep_the_other_from_hearing(two_buses: Callable[..., Loop]) -> None:
    run = two_buses([3, 1])
    run.arm()

    def broken(frame: Frame) -> bool:
        if frame.id == 0:
            raise BackendError("the bus is broken")
        return False

    WIRES[0].refuses = broken
    with pytest.raises(BackendError, match="broken"):
        go(run, "estop")
    assert words(WIRES[1].sent)[-1] == "emergency"


# --- closing -----------------------------------------------------------------------------------------------


def test_closing_disarms_and_twice_is_harmless() -> None:
    with loop() as run:
        run.arm()
        module = module_of(run, 3)
        (wire,) = WIRES
        run.backend.close()
        assert words(wire.sent)[-1] == "disarm" and wire.closed == 1
        assert module.state == DISARMED and module.last_stop == LastStop.DISARM, "and they have heard it"
        sent = len(wire.sent)
        run.backend.close()
        assert wire.closed == 1
        for call in (lambda: run.backend.sample(99, 0), run.backend.advance):
            with pytest.raises(BackendError, match="closed"):
                call()
        run.backend.enact(run.staying(run.samples[-1]), "armed")
        assert run.backend.faults() == [] and len(wire.sent) == sent


def test_closing_goes_on_when_a_bus_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    with loop(config(robot__sensors__pose__rate_hz=100.0), pose_listen="127.0.0.1:0") as run:
        mocap = run.backend._mocap
        assert mocap is not None
        host, _, port = mocap.address.rpartition(":")

        def broken(_frame: Frame) -> bool:
            raise BackendError("the bus is broken")

        def gone() -> None:
            raise can.CanOperationError("the bus is gone")

        WIRES[0].refuses = broken
        with monkeypatch.context() as patched:
            patched.setattr(WIRES[0]._bus, "shutdown", gone)
            run.backend.close()
        assert WIRES[0].closed == 1
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind((host, int(port)))


def test_a_datagram_that_cannot_be_decoded_does_no_harm() -> None:
    with loop(config(robot__sensors__pose__rate_hz=100.0), pose_listen="127.0.0.1:0") as run:
        mocap = run.backend._mocap
        assert mocap is not None
        host, _, port = mocap.address.rpartition(":")
        run.arm()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b'{"a":' + b"[" * 2000, (host, int(port)))
            run.run(5, run.waving)
        assert run.faults == [] and run.lifecycle == "armed"


def test_poses_need_a_delay_that_somebody_has_stated() -> None:
    with pytest.raises(ConfigError, match=r"pose_listen.*\[sensors\.pose\].*delay_s"):
        CanBackend.check(config(), Settings(pose_listen="127.0.0.1:0"))
    CanBackend.check(config(robot__sensors__pose__delay_s=0.02), Settings(pose_listen="127.0.0.1:0"))


@pytest.mark.parametrize("delay_s", [0.0, 0.03])
def test_a_pose_of_twins_is_as_old_as_the_robot_file_says(delay_s: float) -> None:
    """To the bit, in lockstep; and the description says so."""
    with loop(config(robot__sensors__pose__delay_s=delay_s), plant="mujoco") as run:
        (sensor,) = [s for s in run.backend.describe().sensors if s.key == keys.POSE]
        assert sensor.delay_s == delay_s
        run.run(20)
        late = [
            (s.joints.stamp_ns, pose.stamp_ns) for s in run.samples if isinstance(pose := s.others.get(keys.POSE), Pose)
        ]
        assert {now_ns - captured_ns for now_ns, captured_ns in late} == {round(delay_s * 1e9)}
        assert len(late) == 20 - round(delay_s / 0.01)


def test_what_is_wrong_is_told_even_when_the_bus_no_longer_takes_the_stop() -> None:
    """The cause is not lost to the error of the bus."""
    with loop() as run:
        armed(run)
        module_of(run, 2).inside.leak = True
        wire = WIRES[0]

        def breaks(frame: Frame) -> bool:
            if is_action(frame, Action.STOP):
                raise BackendError("the bus is broken")
            return False

        wire.refuses = breaks
        with pytest.raises(BackendError, match="the bus is broken"):  # by the next tick, which tries again
            run.run(3, run.waving)
        told = {fault.what: fault.cause for fault in run.faults}
        assert "leak" in told["module_leak"] and told["stop_not_sent"] == "the bus is broken"


def test_the_log_holds_everything_that_went_over_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    with loop(log=str(path)) as run:
        backend = run.backend
        for tick in range(30):
            samples = backend.sample(tick, tick * 10**7)
            backend.enact(run.staying(samples), "armed")
            backend.advance()
        assert backend.faults() == []
    lines = [line.split() for line in path.read_text().splitlines()]
    assert [line[2] for line in lines] == [f"{f.id:03X}#{f.data.hex().upper()}" for f in WIRES[0].all]
    assert {line[1] for line in lines} == {WIRES[0].channel}
    opcodes = {int(line[2][:3], 16) >> 6 for line in lines}
    assert opcodes > {*FROM_HOST} - {Opcode.EMERGENCY} and Opcode.JOINT_STATE in opcodes
    last = [line[2] for line in lines if int(line[2][:3], 16) >> 6 in FROM_HOST][-1]
    assert last.startswith("040#02"), "which is disarm"
