"""Randomized values of an episode, such as a friction that differs from one random scene to the next."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import KeyOverride


class Randomization(FileStruct, frozen=True, kw_only=True):
    """A uniform distribution of one value, which all keys in `set` get. The number of a random scene decides it."""

    set: Annotated[list[str], Meta(min_length=1)]
    """Dotted keys that all get the same random value, such as `scene.ground.friction`."""

    low: float
    """Lower bound of the value, in the unit of the keys."""

    high: float
    """Upper bound of the value, in the unit of the keys."""

    def __post_init__(self) -> None:
        """Check the bounds. Raises ValueError, for the file reader."""
        are_finite = math.isfinite(self.low) and math.isfinite(self.high)
        if not are_finite or self.low > self.high:
            raise ValueError(
                f"`low` = {self.low:g} must be at most `high` = {self.high:g}, and both finite"
            )

    def sample_overrides(
        self, scene_number: int, origin: str = "[[randomize]]"
    ) -> list[KeyOverride]:
        """Sample the random value for one scene, and return an override with it for every key.

        Only the number of the scene and the first key seed the value, so that an additional `Randomization` does not
        change the values of the others.

        Args:
            scene_number: Number of the random scene.
            origin: File or flag that the distribution comes from, for error messages.
        """
        first_key = self.set[0]
        rng = np.random.default_rng([scene_number, *first_key.encode()])
        value = round(float(rng.uniform(self.low, self.high)), 6)
        return [KeyOverride(key, value, origin) for key in self.set]


def parse_randomizations(bounds_by_keys: Mapping[str, Sequence[Any]] | None) -> list[Randomization]:
    """Parse the argument `randomize` of environments, `{"key": (low, high)}`, into uniform distributions.

    Args:
        bounds_by_keys: Lower and upper bound of each distribution. Comma-separated keys share one sampled value. None
            is the same as an empty mapping.

    Raises:
        ConfigError: The bounds of a key are not two finite numbers in order.
    """
    randomizations: list[Randomization] = []
    for joined_keys, bounds in (bounds_by_keys or {}).items():
        try:
            low, high = (float(bound) for bound in bounds)
            keys = [key.strip() for key in joined_keys.split(",")]
            randomizations.append(Randomization(set=keys, low=low, high=high))
        except (TypeError, ValueError):
            raise ConfigError(
                f"randomize {joined_keys}: {shorten(str(bounds))}: give the lowest and the highest number, both finite",
                code="command/invalid-option",
            ) from None
    return randomizations


def parse_randomize_option(text: str) -> tuple[str, list[str]]:
    """Split the text `key=low:high` of a --randomize option into keys and bounds, for `parse_randomizations`.

    Returns:
        The comma-separated keys, and the texts of the bounds.

    Raises:
        ConfigError: A part of the text is missing.
    """
    keys, equals, bounds = (part.strip() for part in text.partition("="))
    if not (keys and equals and bounds):
        raise ConfigError(
            f"--randomize {shorten(text)}: give KEY=LOW:HIGH, such as scene.ground.friction=0.1:0.4",
            code="command/invalid-option",
        )
    return keys, bounds.split(":")
