"""Scenarios as Gymnasium environments: to learn in what a robot would be allowed to do.

    import snakesim.environments
    import gymnasium

    env = gymnasium.make("SnakeSIM/Clutter-v0", action="velocity", frame_skip=5)

Importing this package registers the names; it needs the extra `gym`, and nothing else of SnakeSIM imports it.
`environment` has the environment, `vector` many of them, `stepped` and `assisted` the robot in it,
`rewards` what is paid; what is seen is in `snakesim_gnc.control.observations`. `docs/how-to/environments.md` is the
reference.
"""

from snakesim_operator.base import extras

extras.require("gym", "`snakesim.environments`")

from gymnasium.envs.registration import register  # noqa: E402 - after the check

from snakesim.environments.environment import SnakeEnv  # noqa: E402
from snakesim.environments.vector import SnakeVectorEnv  # noqa: E402

__all__ = ["SCENARIOS", "SnakeEnv", "SnakeVectorEnv"]
SCENARIOS = {"Clutter": "surveyed_clutter", "PegRow": "peg_row", "Flat": "mamba_flat", "Hills": "mamba_hills"}
"""By environment; `SnakeSIM/Scenario-v0` takes any."""
ENTRY, MANY = "snakesim.environments.environment:SnakeEnv", "snakesim.environments.vector:SnakeVectorEnv"
for name, scenario in SCENARIOS.items():
    register(f"SnakeSIM/{name}-v0", ENTRY, kwargs={"scenario": scenario}, vector_entry_point=MANY)
register("SnakeSIM/Scenario-v0", ENTRY, vector_entry_point=MANY)
