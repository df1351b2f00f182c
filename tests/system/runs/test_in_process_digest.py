"""A run in one process is bit-identical to the same run in several processes that are connected by a network."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.scenario import load_scenario, parse_set_option, read_config
from snakesim_hal.network.client import HostClient
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, DepthImage, WorldModel
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.runs.command import run_to_summary

pytestmark = pytest.mark.e2e


def run_both_ways_and_compare(out: Path, scenario: str, *arguments: str) -> InProcessResult:
    """Run in several processes, then with the same configuration in this one, and compare every tick."""
    finished, summary = run_to_summary(out, scenario, *arguments)
    assert finished.code == 0, finished.out + finished.err
    record = RunRecord.load(out)
    in_process = simulate(read_config(out / CONFIG_FILENAME))
    assert in_process.summary.ended == "complete"
    assert in_process.summary.command_digest == summary.command_digest
    assert in_process.summary.path_distance_m == summary.path_distance_m
    for name in ("angle_rad", "torque_nm", "target", "position_w_m", "contact_peak_n"):
        array = getattr(record, name)
        array_in_process = getattr(in_process.record, name)
        assert np.array_equal(array_in_process, array, equal_nan=True), name
    # On a busy computer the network drops some messages, and control reports that robot time is paused.
    for name in ("control_states", "worlds"):
        messages = {message.tick: message for message in getattr(record, name)}
        messages_in_process = {
            message.tick: message for message in getattr(in_process.record, name)
        }
        common_ticks = [
            tick
            for tick in messages_in_process.keys() & messages.keys()
            if tick and not reports_paused_time(messages[tick])
        ]
        assert len(common_ticks) > 0.8 * len(messages_in_process) - 3, name
        for tick in common_ticks:
            assert messages_in_process[tick] == messages[tick], name
    return in_process


def reports_paused_time(message: ControlState | WorldModel) -> bool:
    """Return whether control reports that robot time is paused."""
    return isinstance(message, ControlState) and message.reason.startswith("robot time is paused")


@pytest.mark.heavy
def test_in_process_digest_of_clutter_equals_that_of_processes(tmp_path: Path) -> None:
    """This scenario also uses the camera, the map and the planner."""
    run_both_ways_and_compare(tmp_path / "run", "clutter", "--duration", "0.5")


@pytest.mark.slow
@pytest.mark.parametrize("scenario", list_shipped_names("scenarios"))
def test_in_process_digest_of_shipped_scenario_equals_that_of_processes(
    scenario: str, tmp_path: Path
) -> None:
    run_both_ways_and_compare(tmp_path / "run", scenario)


@pytest.mark.slow
def test_in_process_digest_of_robot_is_unchanged_by_camera(tmp_path: Path) -> None:
    """The clock names each image of the camera, and a service can read the image in that tick."""
    with_camera = run_both_ways_and_compare(
        tmp_path / "run", "peg_row", "--duration", "1", "--set", "robot=planar13_camera"
    )
    without_camera = simulate(load_scenario("peg_row", [parse_set_option("duration_s=1")]).config)
    assert with_camera.summary.command_digest == without_camera.summary.command_digest
    config = load_scenario(
        "peg_row", [parse_set_option("duration_s=0.5"), parse_set_option("robot=planar13_camera")]
    ).config
    with InProcessRun(config) as run:
        client = HostClient(run.network.create_session(), "onlooker")
        key = keys.depth_key("head")
        images = client.subscribe(key, DepthImage)
        client_ticks = client.iterate_ticks(0.0)
        clock_and_image_ticks: list[tuple[int, int]] = []
        for _ in run.iterate_ticks():
            while (clock := next(client_ticks)) is not None:
                image = client.read(images)
                if image is not None and clock.newest[key] == clock.tick:
                    clock_and_image_ticks.append((clock.tick, image.tick))
    assert len(clock_and_image_ticks) == 10
    for clock_tick, image_tick in clock_and_image_ticks:
        assert image_tick == clock_tick


@pytest.mark.slow
def test_in_process_digest_of_joint_modules_equals_that_of_processes(tmp_path: Path) -> None:
    run_both_ways_and_compare(tmp_path / "run", "triplet", "--duration", "1", "--backend", "can")


@pytest.mark.slow
def test_in_process_digest_with_faults_equals_that_of_processes(tmp_path: Path) -> None:
    faults = [
        "--fault",
        "wrong:joint_3@0.3-0.5=0.01",
        "--fault",
        "duplicate:guidance/world@0.2-0.6",
    ]
    result = run_both_ways_and_compare(tmp_path / "run", "triplet", "--duration", "1", *faults)
    assert any("wrong:joint_3" in text for text in result.record.host.injected)
