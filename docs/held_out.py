"""Fields that a policy crosses, each an episode of 40 s: python docs/held_out.py POLICY FIRST COUNT [KEY=VALUE ...]

POLICY is the name of a shipped one or the path of a file; KEY=VALUE as with --set, such as backend=can.
"""

import sys

from snakesim.environments import SnakeEnv  # before NumPy, so that its arithmetic is that of `snakesim run`

# isort: split
import numpy as np

from snakesim_gnc.control.policy import Model
from snakesim_hal.model.scenario import parse_set

STUCK_S, NEARER_M = 12.0, 0.03  # as `snakesim evaluate` ends a run


def main() -> None:
    name, first, count, *changes = sys.argv[1:]
    given = {one.key: one.value for one in map(parse_set, changes)}
    model = Model(SnakeEnv("surveyed_clutter").description, name)
    env = SnakeEnv("surveyed_clutter", observe=tuple(model.parts), frame_skip=model.frame_skip, duration=40, set=given)
    crossed = []
    for field in range(int(first), int(first) + int(count)):
        seen, info = env.reset(seed=field)
        energy_j, nearest_m, since_s, over, goal = 0.0, 0.0, 0.0, False, False
        while not over and info["time_s"] - since_s < STUCK_S:
            seen, _, goal, truncated, info = env.step(np.array(model(np.asarray(seen))))
            over, energy_j = goal or truncated, energy_j + info["energy_j"]
            if info["advance_m"] > nearest_m + NEARER_M:
                nearest_m, since_s = info["advance_m"], info["time_s"]
        ended, advance_m, time_s = info.get("ended", "stuck"), info["advance_m"], info["time_s"]
        print(f"{field}: {ended}, {advance_m:.2f} m in {time_s:.2f} s, {energy_j:.0f} J", flush=True)
        if ended == "goal":
            crossed.append((advance_m / time_s, energy_j / advance_m))
    env.close()
    print(f"{name} {' '.join(changes)}: crossed {len(crossed)} of {count}")
    if crossed:
        print("medians of those: {:.2f} m/s, {:.0f} J/m".format(*np.median(crossed, axis=0)))


if __name__ == "__main__":
    main()
