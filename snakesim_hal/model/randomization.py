"""Randomized values of an episode, such as a friction that differs from one random scene to the next."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import Override


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
            raise ValueError(f"`low` = {self.low:g} must be at most `high` = {self.high:g}, and both finite")

    def overrides_for_scene(self, field: int, origin: str = "[[randomize]]") -> list[Override]:
        """Return the value of every key for one random scene.

        Only the number of the scene and the first key seed the value, so that an additional `Randomization` does not
        change the values of the others.

        Args:
            field: number of the random scene.
            origin: where the distribution comes from, for error messages.
        """
        first_key = self.set[0]
        random = np.random.default_rng([field, *first_key.encode()])
        value = round(float(random.uniform(self.low, self.high)), 6)
        return [Override(key, value, origin) for key in self.set]


def make_randomizations(bounds_by_keys: Mapping[str, Sequence[Any]] | None) -> list[Randomization]:
    """Return the distributions of `{"key": (low, high)}`; keys that a comma separates get the same value.

    Raises:
        ConfigError: The bounds of a key are not two finite numbers in order.
    """
    randomizations: list[Randomization] = []
    for keys, bounds in (bounds_by_keys or {}).items():
        try:
            low, high = (float(bound) for bound in bounds)
            key_list = [key.strip() for key in keys.split(",")]
            randomizations.append(Randomization(set=key_list, low=low, high=high))
        except (TypeError, ValueError):
            raise ConfigError(
                f"randomize {keys}: {shorten(str(bounds))}: give the lowest and the highest number, both finite",
                code="command/invalid-option",
            ) from None
    return randomizations


def parse_randomization(text: str) -> tuple[str, list[str]]:
    """Return keys and bounds of the `key=low:high` of a --randomize option, for `make_randomizations`.

    Raises:
        ConfigError: A part of it is missing.
    """
    keys, equals, bounds = (part.strip() for part in text.partition("="))
    if not (keys and equals and bounds):
        raise ConfigError(
            f"--randomize {shorten(text)}: give KEY=LOW:HIGH, such as scene.ground.friction=0.1:0.4",
            code="command/invalid-option",
        )
    return keys, bounds.split(":")
