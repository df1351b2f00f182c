"""`python benchmarks/tick.py`: what a lockstep tick takes of the processors, step by step, in every process of a run.

Each step is without those that it calls and that have a line of their own; reading the clock is some 0.5 us of each
call. Zenoh's own threads are in no step, but in the CPU by thread. Interpreters are watched as they start, so any
checkout can be measured: run this file in its folder, with its interpreter.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

FOLDER = "SNAKESIM_TICK_FOLDER"  # where watched processes write to
SKIPPED, AT_ONCE = 100, 50  # ticks: of the start; between two writings

HOST, SERVICE, RECORDER = "snakesim_hal.host_process", "snakesim_hal.serve", "snakesim_operator.recording.process"
# Module, what is called once a tick; then each step: its name, module, functions.
TICK = {
    HOST: ("snakesim_hal.host.host", "Host._finish_tick"),
    SERVICE: ("snakesim_hal.network.client", "Client._take_clock"),
    RECORDER: ("snakesim_operator.recording.robot_time", "RobotTime._tick"),
}
STEPS = {
    HOST: [
        ("sensors of the simulator", "snakesim_sim_backend.backend", "SimBackend.sample"),
        ("samples encoded and checked", "snakesim_hal.host.guarded_backend", "GuardedBackend.sample"),
        ("the clock made", "snakesim_hal.host.host", "Host._publish"),
        ("samples judged", "snakesim_hal.host.host", "Host._judge"),
        ("samples judged", "snakesim_hal.safety.authority", "Authority.observe"),
        ("waiting for the services", "snakesim_hal.network.mailbox", "Mailbox.get"),
        ("answers taken in", "snakesim_hal.host.host", "Host._wait_for_answers"),
        ("gate", "snakesim_hal.safety.authority", "Authority.decide"),
        ("black box", "snakesim_hal.record.black_box", "BlackBox.record"),
        ("set-points to the simulator", "snakesim_sim_backend.backend", "SimBackend.enact"),
        ("physics", "snakesim_sim_backend.backend", "SimBackend._step"),
        ("around the physics", "snakesim_sim_backend.backend", "SimBackend.advance"),
        ("messages given to Zenoh", "snakesim_hal.host.outbox", "Outbox.put"),
        ("the rest of the tick", "snakesim_hal.host.host", "Host._finish_tick"),
    ],
    SERVICE: [
        ("waiting for a clock", "snakesim_hal.network.mailbox", "Mailbox.get"),
        ("clocks taken, in Zenoh's thread", "snakesim_hal.network.client", "Client._take_clock"),
        ("samples read", "snakesim_hal.network.client", "Feed.take_in"),
        ("the controller", "snakesim_gnc.control.guarded", "Guarded.update"),
        ("command made and sent", "snakesim_hal.network.client", "Commander.send"),
        ("other output checked and sent", "snakesim_hal.network.client", "Client.put"),
        ("the rest of its turn", "snakesim_hal.service", "ServiceLoop._act"),
    ],
    RECORDER: [
        ("messages taken, in Zenoh's thread", "snakesim_operator.recording.tap", "Tap._put"),
        ("robot time", "snakesim_operator.recording.robot_time", "RobotTime.of"),
        ("made for viewers", "snakesim_operator.recording.foxglove", "FoxgloveChannels.take"),
        ("added to the file", "snakesim_operator.recording.mcap_file", "McapFile.add"),
        ("compressed and written", "snakesim_operator.recording.mcap_file", "McapFile.flush"),
        ("compressed and written", "snakesim_operator.recording.mcap_file", "McapFile._end_chunk"),
        ("the rest of it", "snakesim_operator.recording.recording", "Recording.take"),
    ],
}


class Watch:
    """Times of the steps in this process."""

    def __init__(self, program: str) -> None:
        self.took_ns: Counter[str] = Counter()
        self._inner, self._ticks = threading.local(), 0
        self._cpu_s = self._began_s = 0.0
        self._threads_ns = Counter[str]()
        self._file = Path(os.environ[FOLDER]) / f"{program}.{os.getpid()}.json"
        for step, module, name in STEPS[program]:
            self._around(module, name, lambda call, step=step: self._timed(step, call))
        self._around(*TICK[program], self._counted)

    def _around(self, module: str, name: str, wrap: Callable[[Any], Any]) -> None:
        try:
            owner: Any = importlib.import_module(module)
        except ModuleNotFoundError:  # an older checkout has it elsewhere
            owner = importlib.import_module(module.replace(".record.", ".host."))
        *path, last = name.split(".")
        for part in path:
            owner = getattr(owner, part)
        if hasattr(owner, last):
            setattr(owner, last, wrap(getattr(owner, last)))

    def _timed(self, step: str, call: Callable[..., Any]) -> Callable[..., Any]:
        inner, took_ns, now_ns = self._inner, self.took_ns, time.thread_time_ns

        def timed(*arguments: Any, **named: Any) -> Any:
            outer_ns, inner.ns, began_ns = getattr(inner, "ns", 0), 0, now_ns()
            try:
                return call(*arguments, **named)
            finally:
                all_ns = now_ns() - began_ns
                took_ns[step] += all_ns - inner.ns
                inner.ns = outer_ns + all_ns

        return timed

    def _counted(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **named: Any) -> Any:
            self._ticks += 1
            if self._ticks == SKIPPED:
                self.took_ns.clear()
                self._cpu_s, self._began_s = time.process_time(), time.monotonic()
                self._threads_ns = _threads_ns()
            elif self._ticks % AT_ONCE == 0:
                self._write()
            return call(*arguments, **named)

        return counted

    def _write(self) -> None:
        ticks = self._ticks - SKIPPED
        if ticks <= 0:
            return
        found = {step: ns / ticks / 1000 for step, ns in self.took_ns.items()}
        whole = (time.monotonic() - self._began_s) / ticks * 1e6
        cpu = (time.process_time() - self._cpu_s) / ticks * 1e6
        ran = _threads_ns()
        ran.subtract(self._threads_ns)
        threads = {name: ns / ticks / 1000 for name, ns in ran.items()}
        about = {"program": sys.orig_argv, "whole": whole, "cpu": cpu, "steps": found, "threads": threads}
        self._file.write_text(json.dumps(about))


def _threads_ns() -> Counter[str]:
    """CPU time of this process by name of its threads."""
    found = Counter[str]()
    for task in Path("/proc/self/task").iterdir():
        found[(task / "comm").read_text().strip()] += int((task / "schedstat").read_text().split()[0])
    return found


def watch() -> None:
    """In every process of the run, before anything else."""
    for program in STEPS:
        if program in sys.orig_argv:
            Watch(program)


def main() -> int:
    """Run, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("more", nargs="*", help="further arguments for `snakesim run`, after --")
    more = parser.parse_args().more
    with tempfile.TemporaryDirectory() as folder:
        hook = Path(folder) / "sitecustomize.py"
        hook.write_text(
            "from importlib.util import module_from_spec, spec_from_file_location\n"
            f"spec = spec_from_file_location('tick', {str(Path(__file__).resolve())!r})\n"
            "module = module_from_spec(spec)\nspec.loader.exec_module(module)\nmodule.watch()\n"
        )
        typed = [sys.executable, "-m", "snakesim_operator", "run", "triplet", "--pace", "lockstep", "--duration", "8"]
        subprocess.run(
            [*typed, "--out", f"{folder}/run", *more],
            env={**os.environ, FOLDER: folder, "PYTHONPATH": folder},
            stdout=subprocess.DEVNULL,
            check=False,
        )
        for file in sorted(Path(folder).glob("*.json")):
            tell(json.loads(file.read_text()))
    return 0


def tell(found: dict[str, Any]) -> None:
    """One process."""
    print(f"\n{' '.join(found['program'][2:5])}: a tick in {found['whole']:.0f} us, {found['cpu']:.0f} us of CPU")
    for step, took_us in sorted(found["steps"].items(), key=lambda one: -one[1]):
        print(f"{took_us:8.1f} us  {step}")
    listed = sorted(found["threads"].items(), key=lambda one: -one[1])
    print("    CPU by thread: " + ", ".join(f"{name} {took_us:.0f}" for name, took_us in listed if took_us >= 1.0))


if __name__ == "__main__":
    raise SystemExit(main())
