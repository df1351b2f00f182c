"""The terms of an environment's reward."""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word


@dataclass(frozen=True)
class RewardTerm:
    """One term of the reward: its default weight, and the quantity that it weighs, with unit and meaning."""

    weight: float
    unit: str
    description: str


REWARD_TERMS = {
    "advance": RewardTerm(
        1.0, "m", "of the center of mass towards the goal; without a goal along the first heading"
    ),
    "energy": RewardTerm(-0.005, "J", "sum over joints of |torque x velocity| over time"),
    "limited": RewardTerm(
        -0.001,
        "1",
        "fraction of joints whose targets the limiter changed, mean over the ticks of the step",
    ),
    "goal": RewardTerm(1.0, "1", "1 in the step that reaches the goal"),
    "stopped": RewardTerm(-1.0, "1", "1 in the step in which the robot is stopped by a fault"),
}


def fill_reward_weights(overrides: Mapping[str, float] | None) -> dict[str, float]:
    """Return the weight of every reward term: the defaults, replaced by the caller's weights.

    Args:
        overrides: Weights that differ from the defaults, by the name of their term. None if there are none.

    Raises:
        ConfigError: `overrides` is not a mapping, has an unknown term, or has a weight that is not a number.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise ConfigError(
            f"reward={shorten(repr(overrides))}: give a dict of weights, such as {{'energy': 0}}, of "
            f"{', '.join(REWARD_TERMS)}; for a reward that you compute yourself, wrap the environment in a "
            "gymnasium.Wrapper, see docs/how-to/environments.md",
            code="python/invalid-argument",
        )
    weights = {name: float(term.weight) for name, term in REWARD_TERMS.items()}
    for name, weight in (overrides or {}).items():
        if name not in REWARD_TERMS:
            hint = suggest_word(str(name), REWARD_TERMS)
            raise ConfigError(
                f"reward={shorten(str(overrides))}: no term {name!r}; {hint}there are {', '.join(REWARD_TERMS)}",
                code="python/invalid-argument",
            )
        if not isinstance(weight, int | float):
            raise ConfigError(
                f"reward[{name!r}]={weight!r:.60}: give a number, the reward per {REWARD_TERMS[name].unit}",
                code="python/invalid-argument",
            )
        weights[name] = float(weight)
    return weights
