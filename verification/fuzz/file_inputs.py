"""Inputs that read text and files: typed options and faults, files of the user and of the product, files of a run."""

import fcntl
from collections.abc import Callable
from pathlib import Path

import msgspec

from snakesim_can_backend.emulator.faults import parse_fault
from snakesim_drivers.emulation.emulator_control import parse_typed_fault
from snakesim_hal.host.latch import ESTOP, EstopLatch
from snakesim_hal.model import files
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_hal.network.local_registry import LocalRobot, list_local_robots
from snakesim_hal.network.router import read_router_settings
from snakesim_operator.results.last_run import read_last_run
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from verification.fuzz.inputs import DecoderInput
from verification.fuzz.text_mutations import MAX_TEXT_BYTES

LAST_RUN_FILENAME = "snakesim/last-run.json"
LIVE_ROBOT_FILENAME = "snakesim/live/4711.json"
MAX_OPTION_BYTES = MAX_TEXT_BYTES // 8
JOINT_COUNT = 13  # of the robot whose typed faults are parsed
# Files in a run's folder that no command reads: results are computed again from the others.
UNREAD_SUFFIXES = (".log", ".html")
UNREAD_FILENAMES = (SUMMARY_FILENAME,)
SET_OPTIONS = [
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
TYPED_FAULTS = [b"mute joint_3 off", b"leak joint_1"]


def list_text_inputs() -> list[DecoderInput]:
    """List the inputs that parse what a user types: options of a command and faults."""
    return [
        DecoderInput("--set", SET_OPTIONS, _make_text_decoder(_parse_set), MAX_OPTION_BYTES),
        DecoderInput("a fault", FAULTS, _make_text_decoder(_parse_fault), MAX_OPTION_BYTES),
        DecoderInput("a typed fault", TYPED_FAULTS, _make_text_decoder(parse_typed_fault)),
    ]


def _make_text_decoder(parse: Callable[[str], object]) -> Callable[[bytes], str]:
    def decode(payload: bytes) -> str:
        # The interpreter passes on arguments that are no UTF-8 in this way.
        parse(payload.decode(errors="surrogateescape"))
        return "accepted"

    return decode


def _parse_set(text: str) -> None:
    load_scenario("triplet", [parse_set_option(text)])


def _parse_fault(text: str) -> None:
    parse_injection(text)
    parse_fault(text, JOINT_COUNT)


def list_file_inputs(folder: Path, run: Path) -> list[DecoderInput]:
    """List the inputs that read files which users write, and files that the product keeps.

    Args:
        folder: Where the files are written; also the folder in which the product keeps what outlives a run.
        run: The folder of a run, for its valid configuration.
    """

    def decode_file(filename: str, read: Callable[[Path], object]) -> Callable[[bytes], str]:
        path = folder / filename

        def decode(payload: bytes) -> str:
            path.write_bytes(payload)
            return "accepted" if read(path) is not None else "ignored"

        return decode

    (folder / LIVE_ROBOT_FILENAME).parent.mkdir(parents=True, exist_ok=True)
    config = (run / "config.json").read_bytes()
    router = files.ROUTER_CONFIG_PATH.read_bytes()
    estop = b'{"requester":"a person","tick":7}'
    last_run = b'{"folder":"/tmp/x","ended":"complete"}'
    return [
        DecoderInput("a robot file", _read_shipped("robots"), decode_file("r.toml", _read_robot)),
        DecoderInput("a scene file", _read_shipped("scenes"), decode_file("s.toml", _read_scene)),
        DecoderInput(
            "a scenario", _read_shipped("scenarios"), decode_file("x.toml", _read_scenario)
        ),
        DecoderInput("config.json", [config], decode_file("x.json", _read_scenario)),
        DecoderInput("router.json5", [router], decode_file("router.json5", read_router_settings)),
        DecoderInput(ESTOP, [estop], decode_file(ESTOP, _read_estop_latch)),
        DecoderInput(
            LAST_RUN_FILENAME,
            [last_run],
            decode_file(LAST_RUN_FILENAME, lambda _path: read_last_run()),
        ),
        DecoderInput(
            "a live robot",
            [_make_live_robot()],
            decode_file(LIVE_ROBOT_FILENAME, _list_live_robots),
        ),
    ]


def _read_shipped(kind: str) -> list[bytes]:
    return [
        files.resolve_file_path(name, kind).read_bytes() for name in files.list_shipped_names(kind)
    ]


def _read_robot(path: Path) -> RobotFile:
    return files.decode_table(files.read_table(path), RobotFile)


def _read_scene(path: Path) -> SceneFile:
    return files.decode_table(files.read_table(path), SceneFile)


def _read_scenario(path: Path) -> object:
    return load_scenario(str(path))


def _read_estop_latch(path: Path) -> bool:
    """Open the latch beside a file. A stop that cannot be read counts as a stop."""
    latch = EstopLatch(path.parent)
    latch.close()
    assert latch.left_by_earlier_host is not None
    return True


def _list_live_robots(path: Path) -> object:
    """List the robots of this computer while a file is locked, as a running robot locks it."""
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        return list_local_robots() or None


def _make_live_robot() -> bytes:
    robot = LocalRobot(
        namespace="worm",
        robot="worm",
        backend="sim",
        endpoint="tcp/127.0.0.1:7447",
        stop_host="127.0.0.1",
        stop_port=7447,
        pid=4711,
    )
    return msgspec.json.encode(robot)


def list_run_inputs(run: Path) -> list[DecoderInput]:
    """List one input for each file in the folder of a run, which reads the run with that file damaged."""
    return [_make_run_input(run, path) for path in sorted(run.iterdir()) if _is_read(path)]


def _is_read(path: Path) -> bool:
    is_unread = path.suffix in UNREAD_SUFFIXES or path.name in UNREAD_FILENAMES
    return path.is_file() and not is_unread


def _make_run_input(run: Path, path: Path) -> DecoderInput:
    valid = path.read_bytes()

    def decode(payload: bytes) -> str:
        path.write_bytes(payload)
        try:
            RunRecord.load(run)
        finally:
            path.write_bytes(valid)
        return "accepted"

    return DecoderInput(f"a run's {path.name}", [valid], decode)
