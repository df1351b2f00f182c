"""Scenarios as Gymnasium environments: to learn in what a robot would be allowed to do.

    import snakesim.environments
    import gymnasium

    env = gymnasium.make("SnakeSIM/Clutter-v0", action="velocity", frame_skip=5)

Importing this package registers the names; it needs the extra `gym`. `docs/how-to/environments.md` is the guide.

`environment`, `vector`   what Gymnasium sees: one environment, and many
`setup`                   the arguments, checked, and the configuration of each episode
`episodes`                steps the episodes of any number of environments: one environment is a vector of one
`observing`, `rewards`    what agents observe, and the terms of their rewards
`robots`                  the robots as rows of arrays, whatever steps them:
`armed`                   - simulated robots together, limited by `array_limiter`
`stepped`, `assisted`     - a robot alone, on any backend, and one under a controller that is corrected
`limiter_client`          commands the limiter of the HAL for one robot
"""

from snakesim_operator.base import extras

extras.require_extra("gym", "`snakesim.environments`")

from gymnasium.envs.registration import register  # noqa: E402 - after the check

from snakesim.environments.environment import SnakeEnv  # noqa: E402
from snakesim.environments.vector import SnakeVectorEnv  # noqa: E402

__all__ = ["SCENARIOS", "SnakeEnv", "SnakeVectorEnv"]
SCENARIOS = {
    "Clutter": "surveyed_clutter",
    "PegRow": "peg_row",
    "Flat": "mamba_flat",
    "Hills": "mamba_hills",
}
"""By environment; `SnakeSIM/Scenario-v0` takes any."""
ENTRY, MANY = (
    "snakesim.environments.environment:SnakeEnv",
    "snakesim.environments.vector:SnakeVectorEnv",
)
for name, scenario in SCENARIOS.items():
    register(f"SnakeSIM/{name}-v0", ENTRY, kwargs={"scenario": scenario}, vector_entry_point=MANY)
register("SnakeSIM/Scenario-v0", ENTRY, vector_entry_point=MANY)
