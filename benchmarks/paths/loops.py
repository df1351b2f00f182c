"""Measures the loop of host and controller, and the echo of raw Zenoh, over one way through a lab.

All functions return percentiles of the latency in microseconds.
"""

import json
import subprocess
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.paths.ways import ConnectionWay
from snakesim_hal.network.private_channel import StarterEnd, socket_pair
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import make_arm_request

LOOP_SCENARIO = Path(__file__).parents[1] / "peers" / "loop.toml"  # host and control alone
CAMERA_OPTIONS = ("--set", "robot=planar13_camera")
IMAGE_KEYS = "planar13_camera/sensor/depth/*"
RAW_MODULE = "benchmarks.paths.raw"
HOST_MODULE = "snakesim_hal.programs.host_program"
SERVICE_MODULE = "snakesim_hal.programs.service_program"
PERIOD_S = 0.01
START_TIMEOUT_S = 30.0
ROUTER_START_S = 1.0
LISTEN_START_S = 0.5  # until a direct session listens
IMAGE_LEAD_S = 6.0  # images flow for so long before the raw loop begins, and about as long after it
BITS_PER_BYTE = 8

Percentiles = tuple[float, float]  # p50, p99 in microseconds


@dataclass(frozen=True)
class LoopBenchmark:
    """Settings that all measurements share."""

    folder: Path  # for logs and results
    duration_s: float
    state: bytes  # with the size of all messages of a tick
    command: bytes


def measure_loop(
    way: ConnectionWay, benchmark: LoopBenchmark, extra_options: Sequence[str] = ()
) -> Percentiles:
    """Run host and controller once, and return the time from a state to the arrival of its command.

    Args:
        way: Way between host and controller.
        benchmark: Duration and folder.
        extra_options: Further options of host and service.

    Raises:
        RuntimeError: The run stopped early.
    """
    folder = benchmark.folder
    options = [str(LOOP_SCENARIO), *extra_options, "--duration", str(benchmark.duration_s)]
    log = folder / "ours.log"
    with ExitStack() as stack:
        _start_routers(way, stack, folder)
        service = way.workstation.start_module(
            SERVICE_MODULE, "control", *options, *way.service, log=log
        )
        stack.callback(_kill, service)
        starter_socket, host_socket = socket_pair()
        with host_socket:
            host = way.robot.start_module(
                HOST_MODULE,
                *options,
                *way.host,
                "--end-after-duration",
                "--end-after-fault",
                "1",
                "--out",
                str(folder),
                "--parent-socket",
                str(host_socket.fileno()),
                log=log,
                inherits=[host_socket.fileno()],
            )
        stack.callback(_kill, host)
        _arm_until_end(StarterEnd(starter_socket), host, benchmark.duration_s)
        record = msgspec.json.decode((folder / "host.json").read_bytes(), type=HostRecord)
    p50_us = record.state_to_command_us["p50"]
    p99_us = record.state_to_command_us["p99"]
    if record.ended != "complete" or p50_us is None or p99_us is None:
        armed_s = record.armed_ticks * PERIOD_S
        raise RuntimeError(f"stopped after {armed_s:.1f} s: {record.ending_reason}")
    return p50_us, p99_us


def _arm_until_end(channel: StarterEnd, host: subprocess.Popen[bytes], duration_s: float) -> None:
    """Arm the robot once when it is ready, and wait until the host has ended.

    Raises:
        TimeoutError: The host did not end in time.
    """
    is_requested = False
    deadline_s = time.monotonic() + START_TIMEOUT_S + duration_s
    while host.poll() is None:
        channel.receive()
        robot = channel.description
        status = channel.status
        is_ready = robot is not None and status is not None and status.ready_to_arm
        if robot is not None and is_ready and not is_requested:
            channel.send_request(make_arm_request(robot, "paths"))
            is_requested = True
        if time.monotonic() > deadline_s:
            reason = status.reason if status is not None else "the host has sent no status"
            raise TimeoutError(f"not done: {reason}")
        time.sleep(0.02)
    channel.close()


def measure_raw_echo(way: ConnectionWay, benchmark: LoopBenchmark) -> Percentiles:
    """Return the round trip of as many bytes with raw Zenoh, at the same rate and priority.

    Raises:
        RuntimeError: A process of the echo failed.
    """
    log = benchmark.folder / "raw.log"
    out = benchmark.folder / "times.json"
    with ExitStack() as stack:
        _start_routers(way, stack, benchmark.folder)
        ask = way.robot.start_module(
            RAW_MODULE,
            "ask",
            str(way.robot_file),
            "--bytes",
            str(len(benchmark.state)),
            "--rounds",
            str(round(benchmark.duration_s / PERIOD_S)),
            "--out",
            str(out),
            log=log,
        )
        stack.callback(_kill, ask)
        time.sleep(LISTEN_START_S)
        answer = way.workstation.start_module(
            RAW_MODULE,
            "answer",
            str(way.workstation_file),
            "--bytes",
            str(len(benchmark.command)),
            log=log,
        )
        stack.callback(_kill, answer)
        if ask.wait(START_TIMEOUT_S + 2 * benchmark.duration_s) != 0:
            raise RuntimeError(f"{way.name}: {log.read_text()[-300:]}")
        times_us = json.loads(out.read_text())
    return float(np.percentile(times_us, 50)), float(np.percentile(times_us, 99))


def measure_loop_with_images(
    way: ConnectionWay, benchmark: LoopBenchmark
) -> tuple[Percentiles, float]:
    """Measure the loop of a robot with a camera while a client reads its images over the same way.

    Returns:
        The latency of the loop, and the images that arrive in Mbit/s.
    """
    counts = benchmark.folder / "seen.json"
    with ExitStack() as stack:
        viewer = way.workstation.start_module(
            RAW_MODULE,
            "read",
            str(way.workstation_file),
            "--key",
            IMAGE_KEYS,
            "--out",
            str(counts),
            log=Path("/dev/null"),
        )
        stack.callback(_kill, viewer)
        latency = measure_loop(way, benchmark, CAMERA_OPTIONS)
        _, byte_count = json.loads(counts.read_text())
    return latency, byte_count * BITS_PER_BYTE * 1e-6 / benchmark.duration_s


def measure_raw_echo_with_images(way: ConnectionWay, benchmark: LoopBenchmark) -> Percentiles:
    """Measure raw Zenoh while a client reads the images of a robot that runs on the same way."""
    longer = replace(benchmark, duration_s=benchmark.duration_s + 2 * IMAGE_LEAD_S)
    with ThreadPoolExecutor(1) as pool:
        images = pool.submit(measure_loop_with_images, way, longer)
        time.sleep(IMAGE_LEAD_S)
        # The routers of the robot with the camera serve the echo, too.
        latency = measure_raw_echo(replace(way, routers=[]), benchmark)
        images.result()
    return latency


def _start_routers(way: ConnectionWay, stack: ExitStack, folder: Path) -> None:
    """Start the routers of a way, and wait until they listen."""
    for machine, path in way.routers:
        router = machine.start_module(RAW_MODULE, "router", str(path), log=folder / "router.log")
        stack.callback(_kill, router)
    if way.routers:
        time.sleep(ROUTER_START_S)


def _kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(10)
