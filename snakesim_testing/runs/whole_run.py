"""Simulates whole runs in the process of the test, and records the telemetry of the controller at every tick."""

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
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import simulate


@dataclass
class RecordedTicks:
    """The record of a run, and the telemetry of its controller in each tick."""

    record: RunRecord
    reports: list[Telemetry]
    update_us: list[float]  # duration of each update of the controller

    @property
    def path_s_m(self) -> Floats:
        """Arc length of the tail along the route, projected from the measured pose, (ticks,)."""
        route = self.record.route
        assert route is not None
        arc_lengths_m: list[float] = []
        near_m: float | None = None  # the search starts at the previous point
        for point in self.record.position_w_m[:, :2]:
            near_m = route.project_point(point, near_m)
            arc_lengths_m.append(near_m)
        return np.array(arc_lengths_m)

    @property
    def advance_m(self) -> float:
        """The distance that the tail moved along the route."""
        return float(self.path_s_m[-1] - self.path_s_m[0])

    @property
    def states(self) -> list[str]:
        """The state that control had reported at each tick."""
        return [state.state for state in self._list_newest_states()]

    @property
    def reasons(self) -> list[str]:
        """The reason of the state that control had reported at each tick."""
        return [state.reason for state in self._list_newest_states()]

    def _list_newest_states(self) -> list[ControlState]:
        """Return the newest control state at each tick. Control does not report one in every tick."""
        state_by_tick = {state.tick: state for state in self.record.control_states}
        newest = state_by_tick[0]
        newest_states: list[ControlState] = []
        for tick in range(len(self.reports)):
            newest = state_by_tick.get(tick, newest)
            newest_states.append(newest)
        return newest_states

    @property
    def propulsion_joints(self) -> list[int | None]:
        """The propulsion joints in their order. None: no joint pushed."""
        joints: list[int | None] = []
        for report in self.reports:
            if not joints or joints[-1] != report.propulsion_joint:
                joints.append(report.propulsion_joint)
        return joints


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

    class RecordingController(controller_class):
        def update(self, observation: Observation) -> ControllerCommand:
            if observation.tick in ticks_without_world:
                observation = dataclasses.replace(observation, world=None)
            if observation.tick in ticks_without_trajectory:
                observation = dataclasses.replace(observation, trajectory=None)
            start_s = time.perf_counter()
            command = super().update(observation)  # pyright: ignore[reportAbstractUsage] - not abstract here
            update_durations_us.append((time.perf_counter() - start_s) * 1e6)
            telemetry.append(command.telemetry)
            return command

    return RecordingController


def load_run_config(scenario: str, *sets: str) -> RunConfig:
    """Load a bundled scenario, with changes such as "duration_s=2", as the option `--set` expects them."""
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
    recording_controller = _make_recording_controller(
        load_controller(config.controller),
        ticks_without_world,
        ticks_without_trajectory,
        telemetry,
        update_us,
    )
    with register_plugin_temporarily(CONTROLLERS, config.controller, recording_controller):
        result = simulate(config)
    assert result.summary.ended == "complete", result.summary.ended
    assert len(telemetry) == len(result.record.time_s)
    return RecordedTicks(result.record, telemetry, update_us)
