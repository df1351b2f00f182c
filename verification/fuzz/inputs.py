"""Everything that reads bytes of others beside the wire's messages: datagrams, files, flags.

Each input has valid examples to start from, and takes a payload the way the product does. What it may answer with are
its own refusals; anything else that it raises is a finding.
"""

import fcntl
import random
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import pytest

from snakesim_can_backend.emulator import faults as twin_faults
from snakesim_drivers.emulation.emulator_control import parse_typed_fault
from snakesim_drivers.motion_capture.mocap import MAX_DATAGRAM_BYTES, MocapReceiver
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.host.latch import ESTOP, EstopLatch
from snakesim_hal.model import fault_kinds as injection
from snakesim_hal.model import files, scenario
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scene import SceneFile
from snakesim_hal.network.local_registry import LocalRobot, list_local_robots
from snakesim_hal.network.router import read_router_settings
from snakesim_hal.network.stop_port import (
    REQUEST_HEADER,
    open_stop_port,
    request_stop,
    start_stop_server,
)
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import EstopRequest, Pose
from snakesim_operator.results.last_run import read_last_run
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.runs.command import snakesim
from verification.fuzz.texts import LARGEST, TextMaker

LAST_RUN = "snakesim/last-run.json"
STOP_EVERY = 20  # payloads
LONGEST_S = 10.0  # for one payload, on a machine that does something else as well
LONGEST_REASON = 1500  # characters of a refusal, whatever it quotes
FLAGS = [
    b"rate_hz=50",
    b"robot.limits.torque_nm=3.5",
    b"controllers.hold={}",
    b"faults=['mute:joint_3@1']",
    b"start.tail_s_m = 0.1",
]
FAULTS = [
    b"mute:joint_3@2.0-3.5",
    b"slow:simulator=0.1@1",
    b"delay:actuator/joints=0.05@2",
    b"kill:control@3",
    b"cut:bus_1@1-2",
]


@dataclass(frozen=True)
class DecoderInput:
    """One decoder, as the product reaches it."""

    name: str
    seeds: list[bytes]
    take: Callable[[bytes], str]  # what became of a payload, in a word or two
    max_bytes: int = LARGEST


@dataclass
class PayloadOutcomes:
    """What became of one input's payloads."""

    words: Counter[str] = field(default_factory=Counter[str])
    longest_s: float = 0.0


def run(inputs: list[DecoderInput], payload_count: int, seed: int) -> dict[str, PayloadOutcomes]:
    """So many payloads into each. Raises whatever an input raises that it must not."""
    outcomes: dict[str, PayloadOutcomes] = {}
    for number, one in enumerate(inputs):
        maker = TextMaker(random.Random(seed * 1000 + number), one.seeds, one.max_bytes)
        outcome = outcomes[one.name] = PayloadOutcomes()
        for _ in range(payload_count):
            kind, payload = maker.make()
            started = time.monotonic()
            try:
                word = one.take(payload)
            except ConfigError as error:
                word = "refused"
                assert len(str(error)) <= LONGEST_REASON, (
                    f"{one.name}, {kind}: a long reason for {payload[:300]!r}"
                )
            except Exception as error:
                error.add_note(f"{one.name}, {kind}: {len(payload)} bytes: {payload[:300]!r}")
                raise
            outcome.words[word] += 1
            took_s = time.monotonic() - started
            outcome.longest_s = max(outcome.longest_s, took_s)
            assert took_s < LONGEST_S, (
                f"{one.name}, {kind}: {took_s:.1f} s for {len(payload)} bytes: {payload[:300]!r}"
            )
    return outcomes


@contextmanager
def all_inputs(folder: Path) -> Iterator[list[DecoderInput]]:
    """Every input, with `folder` for its files. It takes a short run of the product to have a record to spoil."""
    record = folder / "record"
    done = snakesim("run", "triplet", "--duration", "0.3", "--out", str(record), cwd=folder)
    assert done.code == 0, done.out + done.err
    read_again = [
        path
        for path in sorted(record.iterdir())
        if path.suffix not in (".log", ".html") and path.is_file()
    ]
    with mocap() as poses, stop_port() as stops, pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_STATE_HOME", str(folder))  # where what outlives a run is kept
        yield [
            poses,
            stops,
            *texts(),
            *written(folder),
            *(recorded(record, path) for path in read_again),
        ]


@contextmanager
def mocap() -> Iterator[DecoderInput]:
    """Motion capture: a datagram by UDP, as a stranger would send it, and a good one after it."""
    now_ns = 0
    receiver = MocapReceiver("127.0.0.1:0", 0.01, lambda _timestamp_ns: now_ns)
    host, _, port = receiver.address.rpartition(":")
    with closing(receiver), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def reading(payload: bytes) -> str:
            nonlocal now_ns
            now_ns += 10_000_000
            before = receiver.rejected_count_by_reason.copy()
            stranger.sendto(payload, (host, int(port)))
            pose = receiver.read_newest(now_ns // 10_000_000, now_ns)
            if pose is not None:
                assert MessageDecoder(Pose).decode(encode(pose), format_encoding(Pose)) == pose
                return "a pose"
            return next(iter(receiver.rejected_count_by_reason - before), "no velocity yet")

        def take(payload: bytes) -> str:
            word = reading(payload)
            good = reading(_pose(now_ns + 10_000_000))
            assert good in ("a pose", "reordered", "duplicate", "no velocity yet"), (
                f"the next good one: {good}"
            )
            return word

        poses = [*map(_pose, (1, 10**7, 10**9)), _pose(10**8, reported=False)]
        yield DecoderInput("motion capture", poses, take, MAX_DATAGRAM_BYTES + 100)


@contextmanager
def stop_port() -> Iterator[DecoderInput]:
    """The stop port: a datagram by UDP, and now and then a real stop, which must be answered."""
    opened = open_stop_port("127.0.0.1", 0)
    host, port = opened.getsockname()
    heard: list[str] = []
    count = 0

    def stop(who: str, reply: Callable[[str], None]) -> None:
        assert MessageDecoder(EstopRequest).decode(
            encode(EstopRequest(requester=who[:64])), format_encoding(EstopRequest)
        )
        heard.append(who)
        reply("stopped")

    start_stop_server(opened, "worm", stop)
    with opened, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def take(payload: bytes) -> str:
            nonlocal count
            stranger.sendto(payload, (host, port))
            count += 1
            if count % STOP_EVERY == 0:
                answer = request_stop(host, port, "a person", 5.0)
                assert answer is not None and answer.text == "stopped", "the stop port is dead"
            heard_now = len(heard)
            heard.clear()
            return "a stop" if heard_now else "no stop yet"

        yield DecoderInput(
            "stop port",
            [REQUEST_HEADER + bytes(16) + who for who in (b"", b"a person", b"x" * 64)],
            take,
            60_000,
        )


def _pose(timestamp_ns: int, *, reported: bool = True) -> bytes:
    plain = {
        "timestamp_ns": timestamp_ns,
        "position_w": [0.1, 0.2, 0.3],
        "orientation_wxyz": [1, 0, 0, 0],
    }
    velocities = {"velocity_w": [0.0, 0.1, 0.0], "angular_velocity_w": [0.0, 0.0, 1.0]}
    return msgspec.json.encode({**plain, **(velocities if reported else {})})


def texts() -> list[DecoderInput]:
    """What is typed: flags of a command, faults on request."""

    def typed(parse: Callable[[str], object]) -> Callable[[bytes], str]:
        def take(payload: bytes) -> str:
            # As the interpreter hands over what is no text.
            parse(payload.decode(errors="surrogateescape"))
            return "taken"

        return take

    return [
        DecoderInput(
            "--set",
            FLAGS,
            typed(
                lambda text: scenario.load_scenario("triplet", [scenario.parse_set_option(text)])
            ),
            LARGEST // 8,
        ),
        DecoderInput(
            "a fault",
            FAULTS,
            typed(
                lambda text: (injection.parse_injection(text), twin_faults.parse_fault(text, 13))
            ),
            LARGEST // 8,
        ),
        DecoderInput(
            "a typed fault",
            [b"mute joint_3 off", b"leak joint_1"],
            typed(parse_typed_fault),
        ),
    ]


def written(folder: Path) -> list[DecoderInput]:
    """Files that people write, and those that the product keeps for itself."""

    def shipped(kind: str) -> list[bytes]:
        return [
            files.resolve_file_path(name, kind).read_bytes()
            for name in files.list_shipped_names(kind)
        ]

    def file(name: str, read: Callable[[Path], object]) -> Callable[[bytes], str]:
        def take(payload: bytes) -> str:
            (folder / name).write_bytes(payload)
            return "taken" if read(folder / name) is not None else "nothing there"

        return take

    def latch(_path: Path) -> bool:
        found = EstopLatch(folder)
        found.close()
        assert found.left_by_earlier_host is not None, "a stop that cannot be read counts as one"
        return True

    def live(path: Path) -> object:
        with path.open("rb") as held:
            fcntl.flock(held, fcntl.LOCK_EX)  # as by a run that lives
            return list_local_robots() or None

    (folder / "snakesim" / "live").mkdir(parents=True, exist_ok=True)
    robot = LocalRobot(
        namespace="worm",
        robot="worm",
        backend="sim",
        endpoint="tcp/127.0.0.1:7447",
        stop_host="127.0.0.1",
        stop_port=7447,
        pid=4711,
    )
    config = (folder / "record" / "config.json").read_bytes()
    return [
        DecoderInput(
            "a robot file",
            shipped("robots"),
            file("r.toml", lambda p: files.decode_table(files.read_table(p), RobotFile)),
        ),
        DecoderInput(
            "a scene file",
            shipped("scenes"),
            file("s.toml", lambda p: files.decode_table(files.read_table(p), SceneFile)),
        ),
        DecoderInput(
            "a scenario",
            shipped("scenarios"),
            file("x.toml", lambda p: scenario.load_scenario(str(p))),
        ),
        DecoderInput(
            "config.json", [config], file("x.json", lambda p: scenario.load_scenario(str(p)))
        ),
        DecoderInput(
            "router.json5",
            [files.ROUTER_CONFIG_PATH.read_bytes()],
            file("router.json5", read_router_settings),
        ),
        DecoderInput(ESTOP, [b'{"requester":"a person","tick":7}'], file(ESTOP, latch)),
        DecoderInput(
            LAST_RUN,
            [b'{"folder":"/tmp/x","ended":"complete"}'],
            file(LAST_RUN, lambda _: read_last_run()),
        ),
        DecoderInput(
            "a live robot", [msgspec.json.encode(robot)], file("snakesim/live/4711.json", live)
        ),
    ]


def recorded(record: Path, path: Path) -> DecoderInput:
    """A run's folder with one file spoilt."""
    good = path.read_bytes()

    def take(payload: bytes) -> str:
        path.write_bytes(payload)
        try:
            RunRecord.load(record)
        finally:
            path.write_bytes(good)
        return "taken"

    return DecoderInput(f"a run's {path.name}", [good], take)
