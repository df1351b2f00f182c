"""Every module is found, checked and given its parameters, and nothing is enabled meanwhile."""

import re
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count

import pytest

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.bus.load import plan_reports
from snakesim_can_backend.driver.bring_up import (
    DUPLICATE_WAIT_S,
    REQUEST_PERIOD_S,
    ModuleBus,
    ModuleIdentity,
    configure_modules,
    find_discovery_errors,
    find_modules,
)
from snakesim_can_backend.driver.parameters import plan_parameters
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    ModuleParameter,
    Opcode,
    ParameterOperation,
    ParameterResult,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.can.frames import decode_signals, make_heartbeat_frame
from snakesim_testing.can.module_rig import make_chain
from snakesim_testing.messages import raises_error

NAMES = [f"joint_{i}" for i in range(1, 5)]
Spoil = Callable[[CanFrame], list[CanFrame]]


def as_it_is(frame: CanFrame) -> list[CanFrame]:
    return [frame]


class Modules:
    """Four stepped emulators at the other end of a bus. to_modules, to_host: what becomes of each frame."""

    def __init__(self) -> None:
        self.chain = make_chain()
        self.channel = f"bring-up-{uuid.uuid4().hex[:8]}"
        self.far = VirtualWire(self.channel)
        self.near = VirtualWire(self.channel, self)
        self.to_modules: Spoil = as_it_is
        self.to_host: Spoil = as_it_is
        self.beside: Callable[[], None] = lambda: None
        self.heard: list[CanFrame] = []
        self.bus = ModuleBus(self.near, range(1, 5))

    def __call__(self) -> float | None:
        for frame in self.far.receive():
            self.heard.append(frame)
            for passed in self.to_modules(frame):
                self.chain.receive(0, passed)
        for frame in self.chain.pop_frames(0):
            for passed in self.to_host(frame):
                self.far.send(passed)
        self.beside()
        return 0.001

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.far.close()


@pytest.fixture
def modules() -> Iterator[Modules]:
    made = Modules()
    yield made
    made.near.close()


def losing(number: int, which: Callable[[CanFrame], bool] = lambda _frame: True) -> Spoil:
    """Of the frames that are meant, the one of this number gets lost; the first is 1."""
    met = count(1)
    return lambda frame: [] if which(frame) and next(met) == number else [frame]


def actions(frames: list[CanFrame]) -> list[float]:
    return [decode_signals(f)["action"] for f in frames if parse_opcode(f.id) == Opcode.COMMAND]


# --- who is there ------------------------------------------------------------------------------------------


def test_bring_up_finds_every_module_with_identity_requests_only(modules: Modules) -> None:
    found = find_modules([modules.bus], 5.0)
    assert [i.node_id for i in found] == [1, 2, 3, 4]
    assert {i.channel for i in found} == {modules.channel}
    assert [i.serial for i in found] == [slot.module.serial for slot in modules.chain.slots]
    assert {(i.firmware, i.protocol, i.is_emulated, i.is_stepped) for i in found} == {
        ("1.0", 1, True, True)
    }
    assert set(actions(modules.heard)) == {CommandAction.IDENTIFY}
    assert {parse_opcode(frame.id) for frame in modules.heard} == {Opcode.COMMAND}
    assert find_discovery_errors([modules.bus], found, NAMES, is_lockstep=True) == []


def test_bring_up_duplicate_module_id_is_detected_after_first_answer(modules: Modules) -> None:
    answered_at: list[float] = []

    def watch_the_last(frame: CanFrame) -> list[CanFrame]:
        if parse_opcode(frame.id) == Opcode.IDENTITY and parse_node(frame.id) == 4:
            answered_at.append(time.monotonic())
        return [frame]

    def later() -> None:
        if answered_at and time.monotonic() > answered_at[0] + DUPLICATE_WAIT_S / 2:
            modules.far.send(load_layouts()[Opcode.IDENTITY].encode(2, serial=0xBAD, protocol=1))

    modules.to_host, modules.beside = watch_the_last, later
    found = find_modules([modules.bus], 5.0)
    assert 0xBAD in [i.serial for i in found if i.node_id == 2]
    assert len(found) == 5


def test_bring_up_ends_when_all_answered_or_at_timeout(modules: Modules) -> None:
    began = time.monotonic()
    find_modules([modules.bus], 5.0)
    assert time.monotonic() - began < 2.0
    began = time.monotonic()
    found = find_modules([ModuleBus(modules.near, range(1, 6))], 0.25)
    assert 0.2 < time.monotonic() - began < 2.0
    assert len(found) == 4
    assert 2 <= len(actions(modules.heard)) <= 6, "asks again, but not all the time"


def test_bring_up_lost_identity_answer_is_requested_again(modules: Modules) -> None:
    modules.to_host = losing(
        1, lambda frame: parse_opcode(frame.id) == Opcode.IDENTITY and parse_node(frame.id) == 3
    )
    assert [i.node_id for i in find_modules([modules.bus], 5.0)] == [1, 2, 3, 4]
    assert len(actions(modules.heard)) > 1, "asked again"


def test_bring_up_foreign_frames_are_forwarded_and_truncated_ones_ignored(modules: Modules) -> None:
    beat = make_heartbeat_frame(3, 1.0)
    cut = CanFrame(load_layouts()[Opcode.IDENTITY].encode(9).id, b"\x01\x02")
    for frame in (beat, cut):
        modules.far.send(frame)
    handed_on: list[CanFrame] = []
    assert [i.node_id for i in find_modules([modules.bus], 5.0, handed_on.append)] == [1, 2, 3, 4]
    assert [frame for frame in handed_on if parse_opcode(frame.id) != Opcode.HEARTBEAT] == [cut]
    assert beat in handed_on


# --- what is wrong with them -------------------------------------------------------------------------------

A, B = "can_a", "can_b"
GOOD = [
    ModuleIdentity(n, A if n < 3 else B, 0x1000 + n, "1.0", 1, False, False) for n in (1, 2, 3, 4)
]


class Named(VirtualWire):
    """A wire that has a name, and is on no bus."""

    def __init__(self, channel: str) -> None:
        self.channel = channel


def two_buses() -> list[ModuleBus]:
    wires = {name: Named(name) for name in (A, B)}
    return [ModuleBus(wires[A], range(1, 3)), ModuleBus(wires[B], range(3, 5))]


def wrong_with(found: list[ModuleIdentity], *, lockstep: bool = False) -> list[str]:
    return find_discovery_errors(two_buses(), found, NAMES, is_lockstep=lockstep)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (GOOD[:2] + GOOD[3:], "joint_3 (node 3 on can_b) does not answer"),
        (
            [*GOOD, replace(GOOD[1], serial=0xBEEF)],
            "joint_2 (node 2 on can_a) answers 2 times, serials 00001002 and 0000BEEF: give each module its own",
        ),
        (
            [*GOOD, replace(GOOD[0], node_id=9)],
            "node 9 with serial 00001001 on can_a is not a joint of this robot",
        ),
        (
            [*GOOD[:2], replace(GOOD[2], channel=A), GOOD[3]],
            "joint_3 (node 3 on can_b) does not answer; a node 3 answers on can_a",
        ),
        (
            [*GOOD, replace(GOOD[2], channel=A, serial=0xF)],
            "joint_3 (node 3 on can_b) is duplicated on can_a, serial",
        ),
        (
            [replace(GOOD[0], protocol=2), *GOOD[1:]],
            "joint_1 (node 1 on can_a) has protocol version 2, this driver 1",
        ),
        (
            [replace(GOOD[0], is_stepped=True), *GOOD[1:]],
            "joint_1 (node 1 on can_a) is an emulator whose time is paused",
        ),
    ],
)
def test_bring_up_error_names_joint_node_and_bus(found: list[ModuleIdentity], words: str) -> None:
    (reported,) = wrong_with(found)
    assert reported.startswith(words)


def test_modules_that_cannot_wait_are_no_good_for_lockstep() -> None:
    reported = wrong_with([replace(i, is_stepped=i.node_id > 1) for i in GOOD], lockstep=True)
    assert reported == [
        "joint_1 (node 1 on can_a) does not support lockstep: use --clock-mode realtime"
    ]


def test_bring_up_lists_all_problems_in_one_error() -> None:
    found = [
        replace(GOOD[0], protocol=3),
        replace(GOOD[0], protocol=3, serial=5),
        replace(GOOD[2], channel=A),
        replace(GOOD[3], is_stepped=True),
        replace(GOOD[3], node_id=62),
    ]
    reported = wrong_with(found)
    assert len(reported) == 7
    for words in (
        "answers 2 times",
        "version 3",
        "joint_2 .*does not answer$",
        "answers on can_a",
        "--stepped",
        "62",
    ):
        assert any(re.search(words, line) for line in reported), words


# --- parameters --------------------------------------------------------------------------------------------


def wanted(**changed: float) -> dict[int, dict[ModuleParameter, float]]:
    run = make_can_config()
    given = plan_parameters(run.robot, CanSettings(), plan_reports(run, CanSettings()))
    given[2] |= {ModuleParameter[name.upper()]: value for name, value in changed.items()}
    return given


def test_every_parameter_is_written_and_the_others_are_read(modules: Modules) -> None:
    in_force = configure_modules([modules.bus], wanted(stiffness=12.5), 5.0)
    assert set(in_force) == {1, 2, 3, 4}
    for node, values in in_force.items():
        assert set(values) == set(ModuleParameter)
        assert values == pytest.approx(modules.chain.slots[node - 1].module.parameters.values)
    assert in_force[2][ModuleParameter.STIFFNESS] == 12.5
    assert in_force[1][ModuleParameter.STIFFNESS] == 40.0
    assert [in_force[node][ModuleParameter.TAIL] for node in (1, 2, 3, 4)] == [1, 0, 0, 0]
    assert in_force[1][ModuleParameter.RATED_TORQUE] == pytest.approx(4.0)
    requests = [decode_signals(f) for f in modules.heard]
    assert {parse_opcode(f.id) for f in modules.heard} == {Opcode.PARAMETER_REQUEST}
    read_only = [r["index"] for r in requests if r["operation"] == ParameterOperation.READ]
    assert set(read_only) == {ModuleParameter.RATED_TORQUE, ModuleParameter.RATED_SPEED}
    assert len(requests) == 4 * len(ModuleParameter)


@pytest.mark.parametrize("way", ["to_modules", "to_host"])
def test_bring_up_lost_parameter_answer_is_requested_again(modules: Modules, way: str) -> None:
    setattr(modules, way, losing(5))
    began = time.monotonic()
    in_force = configure_modules([modules.bus], wanted(), 5.0)
    assert all(set(values) == set(ModuleParameter) for values in in_force.values())
    assert len(modules.heard) == 4 * len(ModuleParameter) + 1
    assert time.monotonic() - began > REQUEST_PERIOD_S


def test_bring_up_repeated_truncated_or_foreign_answers_are_ignored(modules: Modules) -> None:
    def noisily(frame: CanFrame) -> list[CanFrame]:
        other = load_layouts()[Opcode.PARAMETER_ANSWER].encode(
            parse_node(frame.id), index=200, result=ParameterResult.UNKNOWN_INDEX
        )
        return [CanFrame(frame.id, frame.data[:3]), other, frame, frame]

    modules.to_host = noisily
    in_force = configure_modules([modules.bus], wanted(damping=0.5), 5.0)
    assert in_force[2][ModuleParameter.DAMPING] == 0.5
    assert in_force[2][ModuleParameter.STIFFNESS] == 40.0
    assert in_force[1][ModuleParameter.DAMPING] == 1.0


def test_other_frames_are_not_lost_while_it_waits(modules: Modules) -> None:
    beat = make_heartbeat_frame(3, 9.0)
    modules.far.send(beat)
    handed_on: list[CanFrame] = []
    configure_modules([modules.bus], wanted(), 5.0, handed_on.append)
    assert beat in handed_on


def test_bring_up_value_out_of_range_names_node_and_range(modules: Modules) -> None:
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], wanted(stiffness=2e5), 5.0)


def test_an_armed_module_refuses(modules: Modules) -> None:
    modules.chain.receive(0, make_command(CommandAction.ARM))
    modules.chain.pop_frames(0)
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], wanted(), 5.0)


def test_bring_up_unknown_result_code_counts_as_refusal(modules: Modules) -> None:
    def oddly(frame: CanFrame) -> list[CanFrame]:
        if parse_opcode(frame.id) != Opcode.PARAMETER_ANSWER:
            return [frame]
        return [
            CanFrame(frame.id, frame.data[:1] + bytes((frame.data[1] | 0xF0,)) + frame.data[2:])
        ]

    modules.to_host = oddly
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], wanted(), 5.0)


def test_bring_up_silent_module_is_named_at_the_end(modules: Modules) -> None:
    modules.to_host = lambda frame: [] if parse_node(frame.id) in (2, 4) else [frame]
    with raises_error(BackendError, code="drive/silent"):
        configure_modules([modules.bus], wanted(), 0.3)
    asked = sum(parse_node(frame.id) == 2 for frame in modules.heard)
    assert 2 <= asked <= 5
