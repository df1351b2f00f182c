"""The merged info dicts of many environments, in the form of Gymnasium: for each key an array, and a mask `_key`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]  # (environments,)


class InfoArrays:
    """The info dicts of a number of environments, merged key by key. A value may be a nested group of keys."""

    def __init__(self, count: int) -> None:
        self._count = count
        # An array or InfoArrays, and which environments have it.
        self._values: dict[str, tuple[Any, Mask]] = {}

    def add(self, key: str, values: NDArray[Any], environments: Mask) -> None:
        """Add a key with a value for some environments. `values` has a row for every environment."""
        merged: NDArray[Any] = (
            np.full(self._count, None) if values.dtype == object else np.zeros_like(values)
        )
        np.copyto(merged, values, where=environments)
        self._values[key] = merged, environments

    def add_objects(self, key: str, values: Mapping[int, Any]) -> None:
        """Add a key with an object for some environments: `values` has the objects by the row of the environment."""
        array = np.full(self._count, None, dtype=object)
        environments = np.zeros(self._count, dtype=np.bool_)
        for environment, value in values.items():
            array[environment] = value
            environments[environment] = True
        self._values[key] = array, environments

    def add_group(self, key: str, group: "InfoArrays", environments: Mask) -> None:
        """Add a nested group of keys, which some environments have."""
        self._values[key] = group, environments

    def select(self, environments: Mask) -> "InfoArrays":
        """Return a copy that has only the infos of some environments."""
        selected = InfoArrays(self._count)
        for key, (values, mask) in self._values.items():
            selected_mask = mask & environments
            if not selected_mask.any():
                continue
            if isinstance(values, InfoArrays):
                selected.add_group(key, values.select(selected_mask), selected_mask)
            else:
                selected.add(key, values, selected_mask)
        return selected

    def update(self, other: "InfoArrays", environments: Mask) -> None:
        """Add the infos of other environments to these infos, in place."""
        for key, (values, mask) in other._values.items():
            if key not in self._values:
                self._values[key] = values, mask
                continue
            own_values, own_mask = self._values[key]
            if isinstance(values, InfoArrays):
                own_values.update(values, environments)
                self._values[key] = own_values, own_mask | mask
            else:
                self._values[key] = np.where(mask, values, own_values), own_mask | mask

    def read(self) -> dict[str, Any]:
        """Return the merged info dict. Keys that no environment has are left out."""
        merged: dict[str, Any] = {}
        for key, (values, environments) in self._values.items():
            if not environments.any():
                continue
            merged[key] = values.read() if isinstance(values, InfoArrays) else values
            merged[f"_{key}"] = environments.copy()
        return merged
