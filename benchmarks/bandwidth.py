"""`python -m benchmarks.bandwidth [--write]`: what a robot puts on the wire, key by key, and commands on a full link.

The robot runs in one network namespace, its viewers in another; a veth pair is the link between them. So the counters
of the link are those of the named subscriber alone, with Zenoh, TCP, IP and Ethernet. Needs root; touches no other
network.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from snakesim_hal.process import die_with_parent
from snakesim_hal.wire import keys

PAGE = Path(__file__).parents[1] / "docs" / "bandwidth.md"
MARK = "<!-- measured: python -m benchmarks.bandwidth --write -->\n"
SCENARIO, RATE_HZ = "clutter", 100
ROBOT_AT, FAR_AT = "10.203.113.1", "10.203.113.2"  # only ever seen inside the two namespaces
ENDPOINT = f"tcp/{ROBOT_AT}:7447"
DEPTH, PREVIEW = keys.depth("head"), keys.preview(keys.depth("head"))
READ = (
    keys.JOINTS, keys.CONTACTS, keys.IMU, keys.POSE, keys.POWER, DEPTH, keys.JOINT_COMMAND, keys.CLOCK, keys.APPLIED,
    keys.STATUS, keys.WORLD, keys.TRAJECTORY, keys.CONTROL_STATE, keys.DONE_ALL, PREVIEW,
)  # fmt: skip
READ_S, PING_S, ROUNDS = 5.0, 15.0, 3
STATE_BYTES, COMMAND_BYTES = 460, 340  # about those of 13 joints, as the table says
SHORT_BUFFER = "#so_rcvbuf=4096"  # of a reader's endpoint: TCP then keeps less under way
LINK = "rate 4mbit burst 16kb latency 50ms"  # the images alone need 6 Mbit/s


def main() -> int:
    """Print both tables as they come."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep them in docs/{PAGE.name}")
    write = parser.parse_args().write
    text: list[str] = []

    def tell(line: str) -> None:
        print(line, flush=True)
        text.append(line)

    with ExitStack() as stack:
        lab = stack.enter_context(Lab.made())
        stack.enter_context(lab.robot())
        for line in by_key(lab):
            tell(line)
        tell("")
        for line in on_a_full_link(lab):
            tell(line)
    if write:
        kept = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
        PAGE.write_text(kept + MARK + "\n" + "\n".join(text) + "\n", encoding="utf-8")
    return 0


class Lab:
    """Two network namespaces with a veth pair."""

    def __init__(self, robot: str, far: str, folder: Path) -> None:
        self.names, self._folder = (robot, far), folder

    @classmethod
    @contextmanager
    def made(cls) -> Iterator["Lab"]:
        """Make them, and remove them at the end."""
        robot, far = (f"snakesim-{name}-{os.getpid()}" for name in ("robot", "far"))
        with tempfile.TemporaryDirectory() as folder:
            try:
                for name in (robot, far):
                    _ip("netns", "add", name)
                    _ip("-n", name, "link", "set", "lo", "up")
                _ip(
                    "link", "add", "dev", "link0", "netns", robot, "type", "veth", "peer", "name", "link0", "netns", far
                )
                for name, at in ((robot, ROBOT_AT), (far, FAR_AT)):
                    _ip("-n", name, "address", "add", f"{at}/24", "dev", "link0")
                    _ip("-n", name, "link", "set", "link0", "up")
                yield cls(robot, far, Path(folder))
            finally:
                for name in (robot, far):
                    subprocess.run(["ip", "netns", "del", name], stderr=subprocess.DEVNULL, check=False)

    def command(self, where: int, module: str, *arguments: str) -> list[str]:
        """A command line in one of the namespaces. where: 0 robot, 1 far."""
        return ["ip", "netns", "exec", self.names[where], sys.executable, "-m", module, *arguments]

    @contextmanager
    def running(self, where: int, module: str, *arguments: str) -> Iterator[None]:
        """A process in the background; it dies with this one."""
        process = subprocess.Popen(
            self.command(where, module, *arguments),
            stdout=subprocess.DEVNULL,
            env={**os.environ, "XDG_STATE_HOME": str(self._folder)},
            preexec_fn=lambda: die_with_parent(),
        )
        try:
            yield
        finally:
            process.kill()
            process.wait()

    def asked(self, where: int, *arguments: str) -> dict[str, Any]:
        """What `benchmarks.far` measures in one of the namespaces."""
        done = subprocess.run(
            self.command(where, "benchmarks.far", *arguments), check=True, capture_output=True, timeout=120
        )
        return json.loads(done.stdout)

    @contextmanager
    def robot(self) -> Iterator[None]:
        """The scenario, with previews; until it moves."""
        out = str(self._folder / "run")
        run = ("run", SCENARIO, "--pace", "lockstep", "--duration", "3600", "--stay", "--out", out)
        with self.running(0, "snakesim_operator", *run, "--endpoint", ENDPOINT, "--insecure"):
            time.sleep(15.0)
            with self.running(0, "snakesim_operator", "preview", "--endpoint", ENDPOINT):
                time.sleep(3.0)
                yield

    @contextmanager
    def slow(self) -> Iterator[None]:
        """The link from the robot is limited."""
        on = ("tc", "-n", self.names[0], "qdisc", "add", "dev", "link0", "root", "tbf", *LINK.split())
        subprocess.run(on, check=True)
        try:
            yield
        finally:
            subprocess.run(("tc", "-n", self.names[0], "qdisc", "del", "dev", "link0", "root"), check=True)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def by_key(lab: Lab) -> Iterator[str]:
    """The table of keys. Rates are in robot time, since a busy machine runs in less than real time."""
    yield "| key | messages/s | bytes each | payload kB/s | bytes each on the wire | on the wire kB/s |"
    yield "|---|---|---|---|---|---|"
    payload_s = wire_s = 0.0
    for key in READ:
        seen = lab.asked(1, "read", ENDPOINT, key, str(READ_S))
        count = int(seen["messages"])
        if count == 0:
            yield f"| `{key}` | 0 | | | | |"
            continue
        # Telemetry without a tick, and previews, are bound to wall time.
        by_tick = key != PREVIEW and seen["ticks"] and key not in (keys.STATUS,)
        rate_hz = (count - 1) * RATE_HZ / seen["ticks"] if by_tick else count / seen["wall_s"]
        each, on_wire = seen["payload"] / count, seen["wire"] / count
        if key not in (DEPTH, PREVIEW):
            payload_s, wire_s = payload_s + rate_hz * each, wire_s + rate_hz * on_wire
        kilo = rate_hz / 1000
        yield f"| `{key}` | {rate_hz:.0f} | {each:.0f} | {kilo * each:.1f} | {on_wire:.0f} | {kilo * on_wire:.1f} |"
    yield f"| all but images | | | {payload_s / 1000:.1f} | | {wire_s / 1000:.1f} |"


def on_a_full_link(lab: Lab) -> Iterator[str]:
    """Round trip of a state to the far end and a command back, through the robot's host."""
    yield f"| `tc tbf {LINK}` from the robot, and a viewer of | p50 ms | p99 ms | p99 against quiet | lost |"
    yield "|---|---|---|---|---|"
    viewers = (
        ("nothing", None, ENDPOINT),
        ("the full images", DEPTH, ENDPOINT),
        (f"the full images, at `{SHORT_BUFFER}`", DEPTH, ENDPOINT + SHORT_BUFFER),
        ("their previews", PREVIEW, ENDPOINT),
    )
    found: dict[str, list[tuple[float, float, float]]] = {what: [] for what, _, _ in viewers}
    with lab.slow(), lab.running(0, "benchmarks.far", "pong", ENDPOINT, str(STATE_BYTES)):
        for what, key, endpoint in viewers * ROUNDS:
            with ExitStack() as stack:
                if key is not None:
                    stack.enter_context(lab.running(1, "benchmarks.far", "watch", endpoint, key))
                seen = lab.asked(1, "ping", ENDPOINT, str(COMMAND_BYTES), str(PING_S))
            times, lost = seen["took_ms"], seen["lost"]
            p99_ms = statistics.quantiles(times, n=100)[98]
            found[what].append((statistics.median(times), p99_ms, lost / (lost + len(times))))
    quiet = [p99_ms for _, p99_ms, _ in found["nothing"]]
    for what, rounds in found.items():
        medians, p99s, shares = zip(*rounds, strict=True)
        ratio = statistics.median(p99_ms / still for p99_ms, still in zip(p99s, quiet, strict=True))
        p50, p99, lost = map(statistics.median, (medians, p99s, shares))
        yield f"| {what} | {p50:.1f} | {p99:.1f} | {ratio:.2f} | {lost:.1%} |"


if __name__ == "__main__":
    raise SystemExit(main())
