"""Whole runs in one process, with what the controller was shown and what it answered at every tick."""

import dataclasses
import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, load_controller
from snakesim_hal.model.plugins import CONTROLLERS, offer_plugin
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate


@dataclass
class Run:
    """What happened, one row a tick."""

    record: RunRecord
    reports: list[Telemetry]
    update_us: list[float]  # how long the controller took

    @property
    def path_s_m(self) -> Floats:
        """Arc length of the tail along the route, projected from the measured pose, (ticks,)."""
        route = self.record.route
        assert route is not None
        places: list[float] = []
        near: float | None = None
        for point in self.record.position_w_m[:, :2]:
            near = route.project(point, near)
            places.append(near)
        return np.array(places)

    @property
    def moved_m(self) -> float:
        """How far the tail came along the route."""
        return float(self.path_s_m[-1] - self.path_s_m[0])

    @property
    def states(self) -> list[str]:
        """As control reported them."""
        return [state.state for state in self._reported()]

    @property
    def reasons(self) -> list[str]:
        """As control reported them."""
        return [state.reason for state in self._reported()]

    def _reported(self) -> list[Any]:
        reported = [state for state in self.record.control if state.tick in range(len(self.reports))]
        by_tick = {state.tick: state for state in reported}
        now = by_tick[0]
        return [now := by_tick.get(tick, now) for tick in range(len(self.reports))]

    @property
    def turns(self) -> list[int | None]:
        """Propulsion joints in their order; None while nothing pushes."""
        found: list[int | None] = []
        for report in self.reports:
            if not found or found[-1] != report.propulsion_joint:
                found.append(report.propulsion_joint)
        return found


def _make_watched(
    controller_class: type[Controller[Any]],
    blind: Collection[int],
    lost: Collection[int],
    telemetry: list[Telemetry],
    update_us: list[float],
) -> type[Controller[Any]]:
    """Return a controller class that does not get all of its inputs, and that records its telemetry and its run times.

    Args:
        controller_class: The controller that it extends.
        blind: Ticks in which it gets no world model.
        lost: Ticks in which it gets no trajectory.
        telemetry: Gets the telemetry of each tick.
        update_us: Gets the duration of each update in µs.
    """

    class Watched(controller_class):
        def update(self, observation: Observation) -> ControllerCommand:
            if observation.tick in blind:
                observation = dataclasses.replace(observation, world=None)
            if observation.tick in lost:
                observation = dataclasses.replace(observation, trajectory=None)
            began = time.perf_counter()
            command = super().update(observation)  # pyright: ignore[reportAbstractUsage] - not abstract here
            update_us.append((time.perf_counter() - began) * 1e6)
            telemetry.append(command.telemetry)
            return command

    return Watched


def configure(scenario: str, *sets: str) -> RunConfig:
    """A shipped scenario with `--set` texts."""
    return load(scenario, [parse_set(text) for text in sets]).config


def run(
    config: RunConfig, *, duration_s: float | None = None, blind: Collection[int] = (), lost: Collection[int] = ()
) -> Run:
    """Run a configuration. blind, lost: ticks at which the controller gets no world model, and no trajectory."""
    config = msgspec.structs.replace(config, duration_s=duration_s or config.duration_s)
    telemetry: list[Telemetry] = []
    update_us: list[float] = []
    watched = _make_watched(load_controller(config.controller), blind, lost, telemetry, update_us)
    with offer_plugin(CONTROLLERS, config.controller, watched):
        result = simulate(config)
    assert result.summary.ended == "complete", result.summary.ended
    assert len(telemetry) == len(result.record.time_s)
    return Run(result.record, telemetry, update_us)
