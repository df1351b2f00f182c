"""`python -m benchmarks.paths [--write]`: latency of the loop over each way through a lab; needs root.

Ours is the time from the publishing of a state to the arrival of the command that answers it, in a host that runs in
real time at 100 Hz with a controller that holds. Raw is the round trip of as many bytes with bare Zenoh between the
same machines, at the same rate and priority. Both in turn, the median of the ratios counts.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from datetime import date
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.paths.ways import CabledMachines, ConnectionWay
from benchmarks.physics import encode_tick, load_config
from snakesim_hal.network.private_channel import StarterEnd, socket_pair
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import make_arm_request

LOOP = Path(__file__).parents[1] / "peers" / "loop.toml"
RESULTS = Path(__file__).parents[1] / "PATHS.md"
PERIOD_S = 0.01
START_LIMIT_S = 30.0
IMAGES_FIRST_S = 6.0  # so long before the raw loop begins, and about as long after it
CAMERA = (str(LOOP), "--set", "robot=planar13_camera")
IMAGE_MESSAGE_TYPES = "planar13_camera/sensor/depth/*"
RATE_MBIT = 6.0
AIM, AIM_SATURATED = 1.5, 1.3
EXPLAINED = (
    "The table names a run that stops. A lease lasts 50 ms. On such a link a packet of 1500 bytes takes 2 ms, and no",
    "other packet can overtake it. So p99 is longer, also with raw Zenoh. Smaller pieces of an image do not help,",
    "because TCP joins them to whole packets again. With previews instead of images the aim is met: see",
    "[bandwidth](../docs/benchmarks/bandwidth.md).",
    "",
    "The additional time of SnakeSIM is mostly Python that runs once in 10 ms, and so from a cold cache. Half of it is",
    "in the process of control. The five messages of a tick cost little, because those with a reader share a packet.",
)

Percentiles = tuple[float, float]  # p50, p99 in microseconds


def ours(
    way: ConnectionWay, seconds: float, folder: Path, scenario: Sequence[str] = (str(LOOP),)
) -> Percentiles:
    """One run of host and controller."""
    with ExitStack() as stack:
        routers(way, stack, folder)
        log = folder / "ours.log"
        flags = [*scenario, "--duration", str(seconds)]
        service = way.workstation.start_module(
            "snakesim_hal.programs.service_program", "control", *flags, *way.service, log=log
        )
        stack.callback(_end, service)
        mine, its = socket_pair()
        with its:
            out = [
                "--end-after-duration",
                "--end-after-fault",
                "1",
                "--out",
                str(folder),
                "--parent-socket",
                str(its.fileno()),
            ]
            host = way.robot.start_module(
                "snakesim_hal.programs.host_program",
                *flags,
                *way.host,
                *out,
                log=log,
                inherits=[its.fileno()],
            )
        stack.callback(_end, host)
        arm(StarterEnd(mine), host, seconds)
        record = msgspec.json.decode((folder / "host.json").read_bytes(), type=HostRecord)
    p50, p99 = (record.state_to_command_us[name] for name in ("p50", "p99"))
    if record.ended != "complete" or p50 is None or p99 is None:
        raise RuntimeError(
            f"stopped after {record.armed_ticks * PERIOD_S:.1f} s: {record.ending_reason}"
        )
    return p50, p99


def arm(channel: StarterEnd, host: subprocess.Popen[bytes], seconds: float) -> None:
    """Arm it once, and wait for its end."""
    arm_requested, deadline = False, time.monotonic() + START_LIMIT_S + seconds
    while host.poll() is None:
        channel.receive()
        robot, status = channel.description, channel.status
        if robot is not None and status is not None and status.ready_to_arm and not arm_requested:
            channel.send_request(make_arm_request(robot, "paths"))
            arm_requested = True
        if time.monotonic() > deadline:
            raise TimeoutError(f"not done: {status and status.reason}")
        time.sleep(0.02)
    channel.close()


def raw(
    way: ConnectionWay, seconds: float, folder: Path, state: bytes, command: bytes
) -> Percentiles:
    """The same with bare Zenoh."""
    with ExitStack() as stack:
        routers(way, stack, folder)
        log, out = folder / "raw.log", folder / "times.json"
        sizes = (
            "--bytes",
            str(len(state)),
            "--rounds",
            str(round(seconds / PERIOD_S)),
            "--out",
            str(out),
        )
        ask = way.robot.start_module(_RAW, "ask", str(way.robot_file), *sizes, log=log)
        stack.callback(_end, ask)
        time.sleep(0.5)  # direct: it listens
        answer = way.workstation.start_module(
            _RAW, "answer", str(way.workstation_file), "--bytes", str(len(command)), log=log
        )
        stack.callback(_end, answer)
        if ask.wait(START_LIMIT_S + 2 * seconds) != 0:
            raise RuntimeError(f"{way.name}: {(folder / 'raw.log').read_text()[-300:]}")
        times = json.loads(out.read_text())
    return float(np.percentile(times, 50)), float(np.percentile(times, 99))


_RAW = "benchmarks.paths.raw"


def routers(way: ConnectionWay, stack: ExitStack, folder: Path) -> None:
    """Start the routers of a way."""
    for machine, path in way.routers:
        router = machine.start_module(_RAW, "router", str(path), log=folder / "router.log")
        stack.callback(_end, router)
    time.sleep(1.0 if way.routers else 0.0)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(10)


def main() -> None:
    """Print every line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only-slow", action="store_true", help="only the slow link")
    arguments = parser.parse_args()
    state, command = encode_tick(load_config())
    lines = [
        "# The loop through a lab's network",
        "",
        f"Printed by `python -m benchmarks.paths --write --seconds {arguments.seconds:g} "
        f"--repeats {arguments.repeats}` on "
        f"{date.today()}, {os.cpu_count()} cores, Python {platform.python_version()}, load {os.getloadavg()[1]:.1f}.",
        "The machines are network namespaces on one computer. *Ours* is the time from state to command at 100 Hz.",
        f"*Raw* is a Zenoh round trip of {len(state)} and {len(command)} bytes on the same path. Both are measured "
        f"in turn, and are medians of {arguments.repeats}.",
        "",
        "| way | ours p50 / p99, µs | raw p50 / p99, µs | ratio p50 | ratio p99 | aim |",
        "|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        os.environ["XDG_STATE_HOME"] = name
        lab = CabledMachines(folder, stack)
        for way in () if arguments.only_slow else lab.ways():
            pairs = [
                (
                    ours(way, arguments.seconds, folder),
                    raw(way, arguments.seconds, folder, state, command),
                )
                for _ in range(arguments.repeats)
            ]
            lines.append(row(way.name, pairs))
            print(lines[-1], flush=True)
        slow = [
            "",
            f"With a camera whose images a client reads by one router over a link of {RATE_MBIT:g} Mbit/s (`tbf`),",
            "which is less than the images need. *Quiet* is without that client. Before the link is one queue, or",
            "three by priority.",
            "",
            "| queue | watched p50 / p99, µs | quiet p50 / p99, µs | ratio p50 | ratio p99 | aim | images, Mbit/s |",
            "|---|---|---|---|---|---|---|",
        ]
        print("\n".join(slow), flush=True)
        lines += [
            *slow,
            *slow_link(lab, arguments.seconds, arguments.repeats, folder, state, command),
            "",
            *EXPLAINED,
        ]
    if arguments.write:
        RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")


def slow_link(
    lab: CabledMachines,
    seconds: float,
    repeat_count: int,
    folder: Path,
    state: bytes,
    command: bytes,
) -> list[str]:
    """The loop over a slow link while a client behind it watches the camera, against quiet: lines of a table."""
    lab.robot.run(
        *f"tc qdisc add dev robot root handle 1: tbf rate {RATE_MBIT:g}mbit burst 16kb latency 50ms".split()
    )
    rows: list[str] = []
    way = lab.one_router()
    for queue in ("bfifo limit 64kb", "pfifo_fast"):
        lab.robot.run(*f"tc qdisc replace dev robot parent 1:1 {queue}".split())
        pairs: list[tuple[Percentiles, Percentiles]] = []
        stopped: list[str] = []
        shares: list[float] = []
        for _ in range(repeat_count):
            try:
                quiet = ours(way, seconds, folder, CAMERA)
                busy, share = watched(way, seconds, folder)
            except (RuntimeError, TimeoutError) as error:
                stopped.append(str(error))
                continue
            pairs.append((busy, quiet))
            shares.append(share)
        if pairs:
            rows.append(
                row(f"`{queue}`", pairs, AIM_SATURATED) + f" {statistics.median(shares):.1f} |"
            )
        rows += [f"| `{queue}` | {why} | | | | **missed** | |" for why in stopped]
        print("\n".join(rows[-len(stopped) - bool(pairs) :]), flush=True)
    bare = [
        (
            beside_images(way, seconds, folder, state, command),
            raw(way, seconds, folder, state, command),
        )
        for _ in range(repeat_count)
    ]
    rows.append(row(f"`{queue}`, raw Zenoh", bare, AIM_SATURATED) + " |")
    print(rows[-1], flush=True)
    return rows


def watched(way: ConnectionWay, seconds: float, folder: Path) -> tuple[Percentiles, float]:
    """The loop while a client reads the images, and how much of them comes through, in Mbit/s."""
    seen = folder / "seen.json"
    with ExitStack() as stack:
        reading = ("--key", IMAGE_MESSAGE_TYPES, "--out", str(seen))
        viewer = way.workstation.start_module(
            _RAW, "read", str(way.workstation_file), *reading, log=Path("/dev/null")
        )
        stack.callback(_end, viewer)
        busy = ours(way, seconds, folder, CAMERA)
        _, size = json.loads(seen.read_text())
    return busy, size * 8e-6 / seconds


def beside_images(
    way: ConnectionWay, seconds: float, folder: Path, state: bytes, command: bytes
) -> Percentiles:
    """Raw Zenoh while a client reads the images of a robot that runs on the same way."""
    with ThreadPoolExecutor(1) as other:
        images = other.submit(watched, way, seconds + 2 * IMAGES_FIRST_S, folder)
        time.sleep(IMAGES_FIRST_S)
        times = raw(replace(way, routers=[]), seconds, folder, state, command)
        images.result()
    return times


def row(name: str, pairs: Sequence[tuple[Percentiles, Percentiles]], aim: float = AIM) -> str:
    """A line of the table."""
    mine, bare = (
        [statistics.median(one[i] for one in side) for i in (0, 1)]
        for side in zip(*pairs, strict=True)
    )
    ratios = [statistics.median(one[i] / other[i] for one, other in pairs) for i in (0, 1)]
    met = "met" if max(ratios) <= aim else "**missed**"
    return (
        f"| {name} | {mine[0]:.0f} / {mine[1]:.0f} | {bare[0]:.0f} / {bare[1]:.0f} | {ratios[0]:.2f} | {ratios[1]:.2f} "
        f"| <= {aim:g} {met} |"
    )


if __name__ == "__main__":
    main()
