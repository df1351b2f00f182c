"""Whole runs in one process, with what the controller was shown and what it answered at every tick."""

import dataclasses
import time
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from snakesim_gnc.control.controller import Action, Controller, Report, View
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.plugins import CONTROLLERS, find_plugin, offer_plugin
from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate


@dataclass
class Run:
    """What happened, one row a tick."""

    record: RunRecord
    reports: list[Report]
    update_us: list[float]  # how long the controller took

    @property
    def path_s_m(self) -> Floats:
        """Arc length of the tail along the route, projected from the measured pose, (ticks,)."""
        route = self.record.route
        assert route is not None
        places: list[float] = []
        near: float | None = None
        for point in self.record.position_w[:, :2]:
            near = route.project(point, near)
            places.append(near)
        return np.array(places)

    @property
    def moved_m(self) -> float:
        """How far the tail came along the route."""
        return float(self.path_s_m[-1] - self.path_s_m[0])

    @property
    def states(self) -> list[str]:
        """As control told them."""
        return [state.state for state in self._reported()]

    @property
    def reasons(self) -> list[str]:
        """As control told them."""
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


@dataclass
class _Watch:
    controller: type[Controller]
    blind: Collection[int]
    lost: Collection[int]
    reports: list[Report] = field(default_factory=list[Report])
    update_us: list[float] = field(default_factory=list[float])

    @property
    def Settings(self) -> type[msgspec.Struct]:  # noqa: N802 - as controllers call it
        return self.controller.Settings

    def __call__(self, robot: Any, settings: Any) -> "_Watched":
        return _Watched(self, self.controller(robot, settings))


class _Watched:
    def __init__(self, watch: _Watch, controller: Controller) -> None:
        self._watch, self._controller = watch, controller

    def update(self, view: View) -> Action:
        watch = self._watch
        if view.tick in watch.blind:
            view = dataclasses.replace(view, world=None)
        if view.tick in watch.lost:
            view = dataclasses.replace(view, trajectory=None)
        began = time.perf_counter()
        action = self._controller.update(view)
        watch.update_us.append((time.perf_counter() - began) * 1e6)
        watch.reports.append(action.report)
        return action


def configure(scenario: str, *sets: str) -> RunConfig:
    """A shipped scenario with `--set` texts."""
    return load(scenario, [parse_set(text) for text in sets]).config


def run(
    config: RunConfig, *, duration_s: float | None = None, blind: Collection[int] = (), lost: Collection[int] = ()
) -> Run:
    """Run a configuration. blind, lost: ticks at which the controller gets no world model, and no trajectory."""
    config = msgspec.structs.replace(config, duration_s=duration_s or config.duration_s)
    watch = _Watch(find_plugin(CONTROLLERS, config.controller), blind, lost)
    with offer_plugin(CONTROLLERS, config.controller, watch):
        result = simulate(config)
    assert result.summary.ended == "complete", result.summary.ended
    assert len(watch.reports) == len(result.record.time_s)
    return Run(result.record, watch.reports, watch.update_us)
