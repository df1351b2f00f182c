"""One controller on emulated drives, with sensors and without, side by side: see docs/how-to/run-without-sensors.md.

Distances are those of the emulated motion capture, which is recorded and which guidance does not receive.
"""

import sys

import snakesim

DURATION_S = float(sys.argv[1]) if len(sys.argv) > 1 else 8.0
SEEDS = int(sys.argv[2]) if len(sys.argv) > 2 else 3
SCENARIO = sys.argv[3] if len(sys.argv) > 3 else "triplet"
# Friction of each gear, missing in the robot file.
HIDDEN_NM = float(sys.argv[4]) if len(sys.argv) > 4 else 0.0
HIDDEN = {f"backend.mounted.joint_{i}.friction_nm": HIDDEN_NM for i in range(1, 14) if HIDDEN_NM}
NO_FORCES = {"robot.sensors.contacts": None}
NO_POSE = {"mission.localization": "dead_reckoning"}
BARE = {**NO_FORCES, "robot.sensors.imu": None, **NO_POSE}
ROWS = (
    ("can", "forces, IMUs, motion capture", {}),
    ("can", "no force sensors", NO_FORCES),
    ("can", "no motion capture", NO_POSE),
    ("can", "joints and currents alone", BARE),
    ("odrive", "motion capture, no force sensors", {}),
    ("odrive", "joints and currents alone", BARE),
    ("moteus", "joints and currents alone", BARE),
    ("dynamixel", "joints and currents alone", BARE),
)

for backend, has, changes in ROWS:
    runs = [
        snakesim.run(
            SCENARIO,
            duration=DURATION_S,
            backend=backend,
            set={**HIDDEN, **changes, "seed": seed + 1},
        )
        for seed in range(SEEDS)
    ]
    summaries = [run.summary for run in runs]
    moved = " ".join(f"{one.path_distance_m:5.3f}" for one in summaries)
    off = max(
        (one.dead_reckoning_error_m for one in summaries if one.dead_reckoning_error_m is not None),
        default=None,
    )
    lost = "measured" if off is None else f"at most {100 * off:.1f} cm off"
    torque_nm = max(one.peak_joint_torque_nm or 0.0 for one in summaries)
    energy = sum(one.energy_j or 0.0 for one in summaries)
    energy /= sum(abs(one.path_distance_m or 0.0) + 1e-9 for one in summaries)
    ended = " ".join(sorted({run.status for run in runs}))
    print(
        f"{backend:9} {has:32} moved {moved} m, pose {lost}, contacts from {summaries[0].contacts_from}, "
        f"{energy:.0f} J/m, largest torque {torque_nm:.1f} N·m, {ended}",
        flush=True,
    )
