"""`python -m benchmarks.cameras`: the cost of a depth camera of 160 x 120 pixels, in CPU time for busy machines."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from snakesim_hal.backend import SetPoints
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Mode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings

FIELD = """
name = "field"
[ground]
friction = 0.1
[route]
kind = "sine"
amplitude_m = 0.08
wavelength_m = 0.9
length_m = 5.0
[[random_field]]
seed = 11
low_m = [-0.5, -0.8]
high_m = [5.3, 0.8]
density_per_m2 = 8.0
radius_m = [0.03, 0.06]
clearance_m = 0.12
route_clearance_m = 0.06
"""
IMAGES, TICKS = 30, 400


def config_of(robot: str, scene: str, *sets: str) -> RunConfig:
    """A run of the row of pegs, elsewhere."""
    return load("peg_row", [parse_set(text) for text in (f"robot={robot}", f"scene={scene}", *sets)]).config


def image_ms(config: RunConfig) -> tuple[float, int]:
    """Median CPU time of an image, and how many geoms there are."""
    backend, times = SimBackend(config, SimSettings()), list[float]()
    for tick in range(IMAGES):
        period = config.period_ns * round(config.rate_hz / 20)
        began = time.process_time()
        backend.sample(5 * tick, tick * period)  # due
        backend.sample(5 * tick + 3, tick * period + 3 * config.period_ns)  # arrives
        times.append(time.process_time() - began)
    geoms = backend.sim.model.ngeom
    backend.close()
    return 1e3 * float(np.median(times)), geoms


def ticks(config: RunConfig) -> str:
    """Sample, enact, advance: CPU time of the loop's thread, and of everything; images, and those that were late."""
    backend, own, images = SimBackend(config, SimSettings()), list[float](), 0
    joints, limit = config.robot.chain.modules, config.robot.limits.torque_nm
    started, all_s = time.perf_counter(), time.process_time()
    for tick in range(TICKS):
        began = time.thread_time()
        images += keys.depth("head") in backend.sample(tick, tick * config.period_ns).others
        targets = [0.2 * float(np.sin(0.05 * tick + 0.6 * i)) for i in range(joints)]
        backend.enact(SetPoints([Mode.POSITION] * joints, targets, [limit] * joints), "armed")
        backend.advance()
        own.append(time.thread_time() - began)
        if config.pace == "realtime":
            time.sleep(max(started + (tick + 1) * config.period_ns * 1e-9 - time.perf_counter(), 0.0))
    all_s = time.process_time() - all_s
    late = sum(int(fault.cause.split()[1]) for fault in backend.faults()[-1:])
    backend.close()
    p50, p99 = 1e3 * np.percentile(own, [50, 99])
    return f"{p50:.2f} | {p99:.2f} | {all_s:.2f} | {images} | {late}"


def main() -> int:
    """Print two tables."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        field = Path(folder) / "field.toml"
        field.write_text(FIELD)
        print("| scene | geoms | ms an image |\n|---|---|---|")
        for scene in ("peg_row", str(field), "mamba_hills"):
            ms, geoms = image_ms(config_of("planar13_camera", scene))
            print(f"| {Path(scene).stem} | {geoms} | {ms:.1f} |", flush=True)
        print("\n| robot | pace | own ms a tick, p50 | p99 | CPU s of 400 ticks | images | late |")
        print("|---|---|---|---|---|---|---|")
        for pace in ("lockstep", "realtime"):
            for robot in ("planar13", "planar13_camera") * 2:
                print(f"| {robot} | {pace} | {ticks(config_of(robot, str(field), f'pace={pace}'))} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
