"""`make bench-peers`: state -> command of 13 joints at 100 Hz, ours with all safety, and over other middleware.

All run in turn, in namespaces with nothing but loopback, from which no process escapes. dora-rs is installed from PyPI
into build/peers, rospy from Debian into the system's Python; what cannot be installed is named, and left out.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.echo import measure_echo_times_us
from benchmarks.physics import encode_tick, load_config
from benchmarks.whole import run
from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.safety.authority import CommandAuthority

HERE = Path(__file__).parent
RESULTS = HERE.parent / "PEERS.md"
LOOP = HERE / "loop.toml"  # host and control alone
DORA = Path("build/peers")
ROS_PYTHON = "/usr/bin/python3"
ROS_PACKAGES = ("python3-rospy", "python3-rosmaster", "python3-sensor-msgs")
WHOLE = "SnakeSIM, with guidance and navigation beside it"
RATE_HZ = 100
ROUNDS = 500
REPEATS = 3
PRIORITY = ("chrt", "--fifo", "19")  # as our own processes have it, where the system allows it
ISOLATED = ("unshare", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
START_LIMIT_S = 60

# What the authority does with a command: check it, expire the lease, and limit the setpoints.
AUTHORITY_METHODS = (
    CommandAuthority.process_command,
    CommandAuthority.latch_faults_and_expire_lease,
    CommandAuthority.compute_setpoints,
)

Percentiles = tuple[float, float]  # p50, p99 in microseconds


def main() -> int:
    """Install, enter the namespaces, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside:
        return _measure(write=arguments.write)
    _install()
    again = make_python_command(
        "-m", "benchmarks.peers", "--inside", *(["--write"] if arguments.write else [])
    )
    user = () if os.geteuid() == 0 else ("--map-root-user",)
    shell = ["sh", "-c", 'ip link set lo up && exec "$@"', "sh"]
    return subprocess.call([*ISOLATED, *user, *shell, *again], env=make_child_environment())


def _install() -> None:
    if not (DORA / "bin/dora").exists():
        subprocess.run(
            make_python_command("-m", "venv", str(DORA)), env=make_child_environment(), check=True
        )
        packages = ("dora-rs", "dora-rs-cli", "pyarrow", "numpy")
        subprocess.run(
            [DORA / "bin/python", "-m", "pip", "install", "--quiet", *packages], check=True
        )
    if not _has_rospy():
        install = [
            "apt-get",
            "install",
            "--yes",
            "--quiet",
            "--no-install-recommends",
            *ROS_PACKAGES,
        ]
        if os.geteuid() != 0 or subprocess.call(install, stdout=subprocess.DEVNULL) != 0:
            print(f"rospy is left out; to have it: sudo {' '.join(install)}", file=sys.stderr)


def _has_rospy() -> bool:
    return (
        subprocess.call(
            [ROS_PYTHON, "-c", "import rospy, rosmaster, sensor_msgs"], stderr=subprocess.DEVNULL
        )
        == 0
    )


def _measure(*, write: bool) -> int:
    state, command = encode_tick(load_config())
    prefix = (
        PRIORITY if subprocess.call([*PRIORITY, "true"], stderr=subprocess.DEVNULL) == 0 else ()
    )
    loop = f"{len(state)} {len(command)} {ROUNDS} {1 / RATE_HZ}"
    candidates: dict[str, Callable[[], list[float]]] = {
        "raw zenoh-python, bytes only": lambda: _zenoh(state, command, prefix),
        "dora-rs, bytes only": lambda: _dora(loop, prefix),
    }
    if _has_rospy():
        candidates["rospy, `sensor_msgs/JointState` both ways"] = lambda: _rospy(loop, prefix)
    ours: list[Percentiles] = []
    whole: list[Percentiles] = []
    theirs: dict[str, list[Percentiles]] = {name: [] for name in candidates}
    for _ in range(REPEATS):
        ours.append(_ours(str(LOOP)))
        whole.append(_ours("triplet"))
        for name, times_us in candidates.items():
            p50, p99 = np.percentile(times_us(), (50, 99)).tolist()
            theirs[name].append((p50, p99))
    lines = _table(ours, {WHOLE: whole} | theirs, len(state), len(command))
    print("\n".join(lines))
    if write:
        RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


def _table(
    ours: list[Percentiles],
    theirs: dict[str, list[Percentiles]],
    state_bytes: int,
    command_bytes: int,
) -> list[str]:
    def row(name: str, latencies: list[Percentiles]) -> str:
        p50, p99 = (statistics.median(values) for values in zip(*latencies, strict=True))
        ratio = statistics.median(
            our_p50 / other_p50
            for (our_p50, _), (other_p50, _) in zip(ours, latencies, strict=True)
        )
        return f"| {name} | {p50:.0f} | {p99:.0f} | {ratio:.2f} |"

    return [
        "# The loop over other middleware",
        "",
        f"Printed by `make bench-peers`: state ({state_bytes} bytes) to another process and a command ({command_bytes} "
        f"bytes) back, 13 joints, {RATE_HZ} Hz, {ROUNDS} rounds, medians of {REPEATS} turns. Read the ratios, not the "
        "times. The others only echo. Ours is a run of the simulator: typed messages, five sensors and a clock, a "
        "controller that holds the pose, lease, limiter and all checks.",
        "",
        "| loop | p50, µs | p99, µs | ours / this, p50 |",
        "|---|---|---|---|",
        row("SnakeSIM, host and control with all safety", ours),
        *(row(name, latencies) for name, latencies in theirs.items()),
    ]


def _ours(scenario: str) -> Percentiles:
    """A run in real time: publishing to arrival of the command, and then its check and the decision."""
    options = (
        "--clock-mode",
        "realtime",
        "--duration",
        str(ROUNDS / RATE_HZ),
        "--controller",
        "hold",
    )
    summary = run(*options, scenario=scenario)
    p50, p99 = (summary.state_to_command_us[name] or 0.0 for name in ("p50", "p99"))
    decided_us = _deciding_us()
    return p50 + decided_us, p99 + decided_us


def _deciding_us() -> float:
    """Mean time that the authority takes for a command: check, expiry, limits."""
    spent = 0.0
    with InProcessRun(load_config("duration_s=2", "controller=hold")) as ran:
        authority = ran.host.authority

        def timed(call: Callable[..., object]) -> Callable[..., object]:
            def wrapped(*arguments: object, **named: object) -> object:
                nonlocal spent
                begin = time.perf_counter()
                try:
                    return call(*arguments, **named)
                finally:
                    spent += time.perf_counter() - begin

            return wrapped

        for method in AUTHORITY_METHODS:
            setattr(authority, method.__name__, timed(method.__get__(authority)))
        for _ in ran.iterate_ticks():
            pass
        return spent / max(ran.host.statistics.ticks, 1) * 1e6


def _zenoh(state: bytes, command: bytes, prefix: tuple[str, ...]) -> list[float]:
    if prefix:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(prefix[-1])))
    try:
        return measure_echo_times_us(state, command, ROUNDS, 1 / RATE_HZ, prefix)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _dora(loop: str, prefix: tuple[str, ...]) -> list[float]:
    python = (DORA / "bin/python").absolute()
    node = HERE / "dora_node.py"

    def part(role: str, gives: str, takes: str) -> str:
        command = [*prefix, str(python), str(node), role]
        return (
            f"  - id: {role}\n    path: {command[0]}\n    args: {' '.join(command[1:])}\n"
            f"    outputs: [{gives}]\n    inputs: {{{takes}}}\n"
        )

    with tempfile.TemporaryDirectory() as folder:
        flow = Path(folder, "dataflow.yml")
        robot = part("robot", "state", "command: controller/command")
        flow.write_text(
            f"nodes:\n{robot}{part('controller', 'command', 'state: robot/state')}",
            encoding="ascii",
        )
        return _timed([str(DORA.absolute() / "bin/dora"), "run", str(flow)], Path(folder), loop)


def _rospy(loop: str, prefix: tuple[str, ...]) -> list[float]:
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {
            "ROS_MASTER_URI": "http://127.0.0.1:11311",
            "ROS_IP": "127.0.0.1",
            "HOME": folder,
        }
        quiet = subprocess.DEVNULL
        environment |= {"PEER_LOOP": loop}
        master = subprocess.Popen(
            ["rosmaster", "--core"], env=environment, stdout=quiet, stderr=quiet
        )
        node = [*prefix, ROS_PYTHON, str(HERE / "rospy_node.py")]
        controller = subprocess.Popen([*node, "controller"], env=environment)
        try:
            return _timed([*node, "robot"], Path(folder), loop, environment)
        finally:
            for process in (controller, master):
                process.kill()
                process.wait()


def _timed(
    command: list[str], folder: Path, loop: str, environment: dict[str, str] | None = None
) -> list[float]:
    """Run the node that measures, and read what it has written."""
    out = folder / "times"
    env = (environment or dict(os.environ)) | {"PEER_LOOP": loop, "PEER_OUT": str(out)}
    subprocess.run(
        command, env=env, cwd=folder, check=True, stdout=subprocess.DEVNULL, timeout=START_LIMIT_S
    )
    return [float(line) for line in out.read_text(encoding="ascii").splitlines()]


if __name__ == "__main__":
    if shutil.which("unshare") is None:
        raise SystemExit(
            "bench-peers: needs `unshare` (Debian: util-linux), so that nothing leaves loopback"
        )
    raise SystemExit(main())
