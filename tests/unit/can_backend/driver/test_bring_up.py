"""Bring-up finds, checks and configures every module, and enables none of them."""

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

JOINT_NAMES = [f"joint_{i}" for i in range(1, 5)]
FrameFilter = Callable[[CanFrame], list[CanFrame]]


def pass_frame(frame: CanFrame) -> list[CanFrame]:
    return [frame]


class EmulatedModules:
    """Four stepped emulators at the other end of a bus.

    `to_modules` and `to_host` receive each frame, and return the frames that arrive instead of it.
    """

    def __init__(self) -> None:
        self.chain = make_chain()
        self.channel = f"bring-up-{uuid.uuid4().hex[:8]}"
        self.far = VirtualWire(self.channel)
        self.near = VirtualWire(self.channel, self)
        self.to_modules: FrameFilter = pass_frame
        self.to_host: FrameFilter = pass_frame
        self.on_poll: Callable[[], None] = lambda: None
        self.received_by_modules: list[CanFrame] = []
        self.bus = ModuleBus(self.near, range(1, 5))

    def __call__(self) -> float | None:
        for frame in self.far.receive():
            self.received_by_modules.append(frame)
            for delivered in self.to_modules(frame):
                self.chain.receive(0, delivered)
        for frame in self.chain.pop_frames(0):
            for delivered in self.to_host(frame):
                self.far.send(delivered)
        self.on_poll()
        return 0.001

    def inject(self, injection: FaultInjection, *, begins: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.far.close()


@pytest.fixture
def modules() -> Iterator[EmulatedModules]:
    opened = EmulatedModules()
    yield opened
    opened.near.close()


def drop_selected_frame(
    number: int, is_selected: Callable[[CanFrame], bool] = lambda _frame: True
) -> FrameFilter:
    """Return a filter that drops one of the selected frames. The first one has the number 1."""
    numbers = count(1)

    def drop_frame(frame: CanFrame) -> list[CanFrame]:
        if is_selected(frame) and next(numbers) == number:
            return []
        return [frame]

    return drop_frame


def list_actions(frames: list[CanFrame]) -> list[float]:
    """Return the actions of the commands among frames."""
    return [
        decode_signals(frame)["action"]
        for frame in frames
        if parse_opcode(frame.id) == Opcode.COMMAND
    ]


# --- discovery ---------------------------------------------------------------------------------------------


def test_bring_up_finds_every_module_with_identity_requests_only(modules: EmulatedModules) -> None:
    identities = find_modules([modules.bus], 5.0)
    assert [identity.node_id for identity in identities] == [1, 2, 3, 4]
    assert {identity.channel for identity in identities} == {modules.channel}
    assert [identity.serial for identity in identities] == [
        slot.module.serial for slot in modules.chain.slots
    ]
    assert {
        (identity.firmware, identity.protocol, identity.is_emulated, identity.is_stepped)
        for identity in identities
    } == {("1.0", 1, True, True)}
    assert set(list_actions(modules.received_by_modules)) == {CommandAction.IDENTIFY}
    assert {parse_opcode(frame.id) for frame in modules.received_by_modules} == {Opcode.COMMAND}
    assert find_discovery_errors([modules.bus], identities, JOINT_NAMES, is_lockstep=True) == []


def test_bring_up_duplicate_module_id_is_detected_after_first_answer(
    modules: EmulatedModules,
) -> None:
    answer_times_s: list[float] = []

    def note_last_answer(frame: CanFrame) -> list[CanFrame]:
        if parse_opcode(frame.id) == Opcode.IDENTITY and parse_node(frame.id) == 4:
            answer_times_s.append(time.monotonic())
        return [frame]

    def send_duplicate_identity() -> None:
        if answer_times_s and time.monotonic() > answer_times_s[0] + DUPLICATE_WAIT_S / 2:
            modules.far.send(load_layouts()[Opcode.IDENTITY].encode(2, serial=0xBAD, protocol=1))

    modules.to_host = note_last_answer
    modules.on_poll = send_duplicate_identity
    identities = find_modules([modules.bus], 5.0)
    assert 0xBAD in [identity.serial for identity in identities if identity.node_id == 2]
    assert len(identities) == 5


def test_bring_up_ends_when_all_answered_or_at_timeout(modules: EmulatedModules) -> None:
    start_s = time.monotonic()
    find_modules([modules.bus], 5.0)
    assert time.monotonic() - start_s < 2.0
    start_s = time.monotonic()
    identities = find_modules([ModuleBus(modules.near, range(1, 6))], 0.25)
    assert 0.2 < time.monotonic() - start_s < 2.0
    assert len(identities) == 4
    assert 2 <= len(list_actions(modules.received_by_modules)) <= 6, (
        "the driver requests again, but not all the time"
    )


def test_bring_up_lost_identity_answer_is_requested_again(modules: EmulatedModules) -> None:
    modules.to_host = drop_selected_frame(
        1, lambda frame: parse_opcode(frame.id) == Opcode.IDENTITY and parse_node(frame.id) == 3
    )
    assert [identity.node_id for identity in find_modules([modules.bus], 5.0)] == [1, 2, 3, 4]
    assert len(list_actions(modules.received_by_modules)) > 1, "the driver requested again"


def test_bring_up_foreign_frames_are_forwarded_and_truncated_ones_ignored(
    modules: EmulatedModules,
) -> None:
    foreign_frame = make_heartbeat_frame(3, 1.0)
    truncated_frame = CanFrame(load_layouts()[Opcode.IDENTITY].encode(9).id, b"\x01\x02")
    for frame in (foreign_frame, truncated_frame):
        modules.far.send(frame)
    forwarded: list[CanFrame] = []
    assert [
        identity.node_id for identity in find_modules([modules.bus], 5.0, forwarded.append)
    ] == [1, 2, 3, 4]
    assert [frame for frame in forwarded if parse_opcode(frame.id) != Opcode.HEARTBEAT] == [
        truncated_frame
    ]
    assert foreign_frame in forwarded


# --- errors of discovery -----------------------------------------------------------------------------------

CHANNEL_A = "can_a"
CHANNEL_B = "can_b"
IDENTITIES = [
    ModuleIdentity(n, CHANNEL_A if n < 3 else CHANNEL_B, 0x1000 + n, "1.0", 1, False, False)
    for n in (1, 2, 3, 4)
]


class NamedWire(VirtualWire):
    """A wire that has only a channel name, and is connected to no bus."""

    def __init__(self, channel: str) -> None:
        self.channel = channel


def make_two_buses() -> list[ModuleBus]:
    """Return two buses with the nodes 1 and 2, and 3 and 4."""
    wires = {name: NamedWire(name) for name in (CHANNEL_A, CHANNEL_B)}
    return [ModuleBus(wires[CHANNEL_A], range(1, 3)), ModuleBus(wires[CHANNEL_B], range(3, 5))]


def find_errors(identities: list[ModuleIdentity], *, is_lockstep: bool = False) -> list[str]:
    """Return the errors of discovery on two buses."""
    return find_discovery_errors(make_two_buses(), identities, JOINT_NAMES, is_lockstep=is_lockstep)


@pytest.mark.parametrize(
    ("identities", "expected_start"),
    [
        (IDENTITIES[:2] + IDENTITIES[3:], "joint_3 (node 3 on can_b) does not answer"),
        (
            [*IDENTITIES, replace(IDENTITIES[1], serial=0xBEEF)],
            "joint_2 (node 2 on can_a) answers 2 times, serials 00001002 and 0000BEEF: give each module its own",
        ),
        (
            [*IDENTITIES, replace(IDENTITIES[0], node_id=9)],
            "node 9 with serial 00001001 on can_a is not a joint of this robot",
        ),
        (
            [*IDENTITIES[:2], replace(IDENTITIES[2], channel=CHANNEL_A), IDENTITIES[3]],
            "joint_3 (node 3 on can_b) does not answer; a node 3 answers on can_a",
        ),
        (
            [*IDENTITIES, replace(IDENTITIES[2], channel=CHANNEL_A, serial=0xF)],
            "joint_3 (node 3 on can_b) is duplicated on can_a, serial",
        ),
        (
            [replace(IDENTITIES[0], protocol=2), *IDENTITIES[1:]],
            "joint_1 (node 1 on can_a) has protocol version 2, this driver 1",
        ),
        (
            [replace(IDENTITIES[0], is_stepped=True), *IDENTITIES[1:]],
            "joint_1 (node 1 on can_a) is an emulator whose time is paused",
        ),
    ],
)
def test_bring_up_error_names_joint_node_and_bus(
    identities: list[ModuleIdentity], expected_start: str
) -> None:
    (error,) = find_errors(identities)
    assert error.startswith(expected_start)


def test_bring_up_module_without_stepping_is_refused_for_lockstep() -> None:
    errors = find_errors(
        [replace(identity, is_stepped=identity.node_id > 1) for identity in IDENTITIES],
        is_lockstep=True,
    )
    assert errors == [
        "joint_1 (node 1 on can_a) does not support lockstep: use --clock-mode realtime"
    ]


def test_bring_up_lists_all_problems_in_one_error() -> None:
    identities = [
        replace(IDENTITIES[0], protocol=3),
        replace(IDENTITIES[0], protocol=3, serial=5),
        replace(IDENTITIES[2], channel=CHANNEL_A),
        replace(IDENTITIES[3], is_stepped=True),
        replace(IDENTITIES[3], node_id=62),
    ]
    errors = find_errors(identities)
    assert len(errors) == 7
    for pattern in (
        "answers 2 times",
        "version 3",
        "joint_2 .*does not answer$",
        "answers on can_a",
        "--stepped",
        "62",
    ):
        assert any(re.search(pattern, error) for error in errors), pattern


# --- parameters --------------------------------------------------------------------------------------------


def make_parameters(**changed: float) -> dict[int, dict[ModuleParameter, float]]:
    """Return the parameters of every node. The changes apply to node 2."""
    run = make_can_config()
    parameters = plan_parameters(run.robot, CanSettings(), plan_reports(run, CanSettings()))
    parameters[2] |= {ModuleParameter[name.upper()]: value for name, value in changed.items()}
    return parameters


def test_bring_up_writes_every_parameter_and_reads_the_ratings(modules: EmulatedModules) -> None:
    applied = configure_modules([modules.bus], make_parameters(stiffness=12.5), 5.0)
    assert set(applied) == {1, 2, 3, 4}
    for node, values in applied.items():
        assert set(values) == set(ModuleParameter)
        assert values == pytest.approx(modules.chain.slots[node - 1].module.parameters.values)
    assert applied[2][ModuleParameter.STIFFNESS] == 12.5
    assert applied[1][ModuleParameter.STIFFNESS] == 40.0
    assert [applied[node][ModuleParameter.TAIL] for node in (1, 2, 3, 4)] == [1, 0, 0, 0]
    assert applied[1][ModuleParameter.RATED_TORQUE] == pytest.approx(4.0)
    requests = [decode_signals(frame) for frame in modules.received_by_modules]
    assert {parse_opcode(frame.id) for frame in modules.received_by_modules} == {
        Opcode.PARAMETER_REQUEST
    }
    read_only = [
        request["index"] for request in requests if request["operation"] == ParameterOperation.READ
    ]
    assert set(read_only) == {ModuleParameter.RATED_TORQUE, ModuleParameter.RATED_SPEED}
    assert len(requests) == 4 * len(ModuleParameter)


@pytest.mark.parametrize("direction", ["to_modules", "to_host"])
def test_bring_up_lost_parameter_answer_is_requested_again(
    modules: EmulatedModules, direction: str
) -> None:
    setattr(modules, direction, drop_selected_frame(5))
    start_s = time.monotonic()
    applied = configure_modules([modules.bus], make_parameters(), 5.0)
    assert all(set(values) == set(ModuleParameter) for values in applied.values())
    assert len(modules.received_by_modules) == 4 * len(ModuleParameter) + 1
    assert time.monotonic() - start_s > REQUEST_PERIOD_S


def test_bring_up_repeated_truncated_or_foreign_answers_are_ignored(
    modules: EmulatedModules,
) -> None:
    def add_noise(frame: CanFrame) -> list[CanFrame]:
        foreign_answer = load_layouts()[Opcode.PARAMETER_ANSWER].encode(
            parse_node(frame.id), index=200, result=ParameterResult.UNKNOWN_INDEX
        )
        return [CanFrame(frame.id, frame.data[:3]), foreign_answer, frame, frame]

    modules.to_host = add_noise
    applied = configure_modules([modules.bus], make_parameters(damping=0.5), 5.0)
    assert applied[2][ModuleParameter.DAMPING] == 0.5
    assert applied[2][ModuleParameter.STIFFNESS] == 40.0
    assert applied[1][ModuleParameter.DAMPING] == 1.0


def test_bring_up_frames_received_during_configuration_are_forwarded(
    modules: EmulatedModules,
) -> None:
    foreign_frame = make_heartbeat_frame(3, 9.0)
    modules.far.send(foreign_frame)
    forwarded: list[CanFrame] = []
    configure_modules([modules.bus], make_parameters(), 5.0, forwarded.append)
    assert foreign_frame in forwarded


def test_bring_up_value_out_of_range_names_node_and_range(modules: EmulatedModules) -> None:
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], make_parameters(stiffness=2e5), 5.0)


def test_bring_up_armed_module_refuses_parameters(modules: EmulatedModules) -> None:
    modules.chain.receive(0, make_command(CommandAction.ARM))
    modules.chain.pop_frames(0)
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], make_parameters(), 5.0)


def test_bring_up_unknown_result_code_counts_as_refusal(modules: EmulatedModules) -> None:
    def change_result_code(frame: CanFrame) -> list[CanFrame]:
        if parse_opcode(frame.id) != Opcode.PARAMETER_ANSWER:
            return [frame]
        return [
            CanFrame(frame.id, frame.data[:1] + bytes((frame.data[1] | 0xF0,)) + frame.data[2:])
        ]

    modules.to_host = change_result_code
    with raises_error(BackendError, code="drive/parameter-refused"):
        configure_modules([modules.bus], make_parameters(), 5.0)


def test_bring_up_silent_module_is_named_at_the_end(modules: EmulatedModules) -> None:
    modules.to_host = lambda frame: [] if parse_node(frame.id) in (2, 4) else [frame]
    with raises_error(BackendError, code="drive/silent"):
        configure_modules([modules.bus], make_parameters(), 0.3)
    request_count = sum(parse_node(frame.id) == 2 for frame in modules.received_by_modules)
    assert 2 <= request_count <= 5
