"""Run one controller, unchanged, on the simulator and on emulated drives of every type. See docs/hardware/README.md."""

import statistics
import sys

import snakesim

DURATION_S = float(sys.argv[1]) if len(sys.argv) > 1 else 8.0
# Such as ./mine.py:Mine; else the scenario's.
CONTROLLER = {"controller": sys.argv[2]} if len(sys.argv) > 2 else {}

simulated = None
for backend in ("sim", "can", "odrive", "moteus", "cia402", "dynamixel", "mixed"):
    robot = "planar13_mixed" if backend == "mixed" else "planar13"
    run = snakesim.run(
        "triplet", duration=DURATION_S, backend=backend, set={"robot": robot}, **CONTROLLER
    )
    simulated = run if simulated is None else simulated
    rows = min(len(run.time_s), len(simulated.time_s))
    torques = [one["torque_nm"][:rows].ravel().tolist() for one in (simulated, run)]
    alike = statistics.correlation(*torques)
    joints = (
        " ".join(joint.removeprefix("joint_") for joint in run.summary.propulsion_joints) or "none"
    )
    moved_m = run.metrics["path_distance_m"]
    print(
        f"{backend:9} moved {moved_m:.3f} m, propulsion joints {joints}, torque correlation {alike:.2f}, {run.status}"
    )
