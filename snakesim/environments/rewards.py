"""The terms of an environment's reward."""

from collections.abc import Mapping
from dataclasses import dataclass

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word


@dataclass(frozen=True)
class Term:
    """One term of the reward: its default weight, and the quantity that it weighs, with unit and meaning."""

    weight: float
    unit: str
    about: str


TERMS = {
    "advance": Term(1.0, "m", "of the center of mass towards the goal; without a goal along the first heading"),
    "energy": Term(-0.005, "J", "sum over joints of |torque x velocity| over time"),
    "limited": Term(
        -0.001, "1", "fraction of joints whose targets the limiter changed, mean over the ticks of the step"
    ),
    "goal": Term(1.0, "1", "1 in the step that reaches the goal"),
    "stopped": Term(-1.0, "1", "1 in the step in which the robot is stopped by a fault"),
}


def complete_weights(given: Mapping[str, float] | None) -> dict[str, float]:
    """Return the weight of every term.

    Args:
        given: Weights that differ from the defaults, by the name of their term.

    Raises:
        ConfigError: There is no such term, or its weight is no number.
    """
    if given is not None and not isinstance(given, Mapping):
        raise ConfigError(
            f"reward={shorten(repr(given))}: give a dict of weights, such as {{'energy': 0}}, of {', '.join(TERMS)}; "
            "for a reward that you compute yourself, wrap the environment in a gymnasium.Wrapper, see "
            "docs/how-to/environments.md",
            code="python/invalid-argument",
        )
    weights = {name: float(term.weight) for name, term in TERMS.items()}
    for name, weight in (given or {}).items():
        if name not in TERMS:
            hint = suggest_word(str(name), TERMS)
            raise ConfigError(
                f"reward={shorten(str(given))}: no term {name!r}; {hint}there are {', '.join(TERMS)}",
                code="python/invalid-argument",
            )
        if not isinstance(weight, int | float):
            raise ConfigError(
                f"reward[{name!r}]={weight!r:.60}: give a number, the reward per {TERMS[name].unit}",
                code="python/invalid-argument",
            )
        weights[name] = float(weight)
    return weights
