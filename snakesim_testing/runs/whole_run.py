"""Whole runs in one process, with what the controller was shown and what it answered at every tick."""

import dataclasses
import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    load_controller,
)
from snakesim_hal.model.plugins import CONTROLLERS, register_plugin_temporarily
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate


@dataclass
class RecordedTicks:
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
            near = route.project_point(point, near)
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
        reported = [
            state for state in self.record.control_states if state.tick in range(len(self.reports))
        ]
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


def _make_recording_controller(
    controller_class: type[Controller[Any]],
    ticks_without_world: Collection[int],
    ticks_without_trajectory: Collection[int],
    telemetry: list[Telemetry],
    update_durations_us: list[float],
) -> type[Controller[Any]]:
    """Return a subclass of a controller that misses some inputs, and records its telemetry and run times.

    Args:
        controller_class: The controller to extend.
        ticks_without_world: Ticks in which the controller gets no world model.
        ticks_without_trajectory: Ticks in which the controller gets no trajectory.
        telemetry: List to which the telemetry of each tick is added.
        update_durations_us: List to which the duration of each update in µs is added.
    """

    class Watched(controller_class):
        def update(self, observation: Observation) -> ControllerCommand:
            if observation.tick in ticks_without_world:
                observation = dataclasses.replace(observation, world=None)
            if observation.tick in ticks_without_trajectory:
                observation = dataclasses.replace(observation, trajectory=None)
            began = time.perf_counter()
            command = super().update(observation)  # pyright: ignore[reportAbstractUsage] - not abstract here
            update_durations_us.append((time.perf_counter() - began) * 1e6)
            telemetry.append(command.telemetry)
            return command

    return Watched


def load_run_config(scenario: str, *sets: str) -> RunConfig:
    """Load a bundled scenario, with changes as `--set` takes them."""
    return load_scenario(scenario, [parse_set_option(text) for text in sets]).config


def run_controller(
    config: RunConfig,
    *,
    duration_s: float | None = None,
    ticks_without_world: Collection[int] = (),
    ticks_without_trajectory: Collection[int] = (),
) -> RecordedTicks:
    """Run a configuration to its end, and return its record with telemetry and run times of the controller.

    Args:
        config: Configuration of the run.
        duration_s: Duration of the run. If None, that of the configuration.
        ticks_without_world: Ticks in which the controller gets no world model.
        ticks_without_trajectory: Ticks in which the controller gets no trajectory.
    """
    config = msgspec.structs.replace(config, duration_s=duration_s or config.duration_s)
    telemetry: list[Telemetry] = []
    update_us: list[float] = []
    watched = _make_recording_controller(
        load_controller(config.controller),
        ticks_without_world,
        ticks_without_trajectory,
        telemetry,
        update_us,
    )
    with register_plugin_temporarily(CONTROLLERS, config.controller, watched):
        result = simulate(config)
    assert result.summary.ended == "complete", result.summary.ended
    assert len(telemetry) == len(result.record.time_s)
    return RecordedTicks(result.record, telemetry, update_us)
