"""A run in one process does to the bit what processes do over a network."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.model.files import list_shipped_names
from snakesim_hal.model.scenario import load_scenario, parse_set_option, read_config
from snakesim_hal.network.client import HostClient
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, DepthImage, WorldModel
from snakesim_operator.results.run_log import RunRecord as Record
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.runs.command import run_to_summary

pytestmark = pytest.mark.e2e


def same_both_ways(out: Path, scenario: str, *arguments: str) -> InProcessResult:
    """Run it in processes, then its effective configuration in this one; both must agree in every tick."""
    ended, summary = run_to_summary(out, scenario, *arguments)
    assert ended.code == 0, ended.out + ended.err
    theirs, ours = Record.load(out), simulate(read_config(out / CONFIG_FILENAME))
    assert ours.summary.ended == "complete"
    assert ours.summary.command_digest == summary.command_digest
    assert ours.summary.path_distance_m == summary.path_distance_m
    for name in ("angle_rad", "torque_nm", "target", "position_w_m", "contact_peak_n"):
        assert np.array_equal(getattr(ours.record, name), getattr(theirs, name), equal_nan=True), (
            name
        )
    # Not every tick's: on a busy computer a network drops some, and control reports that time is paused.
    for name in ("control_states", "worlds"):
        mine, other = (
            {said.tick: said for said in getattr(record, name)} for record in (ours.record, theirs)
        )
        shared = [t for t in mine.keys() & other.keys() if t and not _stands(other[t])]
        assert len(shared) > 0.8 * len(mine) - 3 and all(mine[t] == other[t] for t in shared), name
    return ours


def _stands(said: ControlState | WorldModel) -> bool:
    return isinstance(said, ControlState) and said.reason.startswith("robot time is paused")


def test_processes_and_one_process_drive_the_motors_alike(tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", "clutter", "--duration", "0.5")  # camera, map and planner too


@pytest.mark.slow
@pytest.mark.parametrize("scenario", list_shipped_names("scenarios"))
def test_so_they_do_in_every_shipped_scenario(scenario: str, tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", scenario)


@pytest.mark.slow  # above is a robot with a camera, too
def test_in_process_digest_of_robot_is_unchanged_by_camera(tmp_path: Path) -> None:
    """An image of the camera is named by the clock, and is there for whoever reads it at that tick."""
    seeing = same_both_ways(
        tmp_path / "run", "peg_row", "--duration", "1", "--set", "robot=planar13_camera"
    )
    blind = simulate(load_scenario("peg_row", [parse_set_option("duration_s=1")]).config)
    assert seeing.summary.command_digest == blind.summary.command_digest
    config = load_scenario(
        "peg_row", [parse_set_option("duration_s=0.5"), parse_set_option("robot=planar13_camera")]
    ).config
    with InProcessRun(config) as run:
        client = HostClient(run.network.create_session(), "onlooker")
        images, client_ticks = (
            client.subscribe(keys.depth_key("head"), DepthImage),
            client.iterate_ticks(0.0),
        )
        read: list[tuple[int, int]] = []
        for _ in run.iterate_ticks():
            while (clock := next(client_ticks)) is not None:
                image = client.read(images)
                if image is not None and clock.newest[keys.depth_key("head")] == clock.tick:
                    read.append((clock.tick, image.tick))
    assert len(read) == 10
    assert all(tick == of for tick, of in read)


@pytest.mark.slow
def test_so_do_joint_modules_behind_their_bus(tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", "triplet", "--duration", "1", "--backend", "can")


@pytest.mark.slow
def test_faults_on_request_are_the_same_too(tmp_path: Path) -> None:
    faults = [
        "--fault",
        "wrong:joint_3@0.3-0.5=0.01",
        "--fault",
        "duplicate:guidance/world@0.2-0.6",
    ]
    result = same_both_ways(tmp_path / "run", "triplet", "--duration", "1", *faults)
    assert any("wrong:joint_3" in text for text in result.record.host.injected)
