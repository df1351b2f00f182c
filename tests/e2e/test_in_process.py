"""A run in one process: to the bit what processes do over a network, the same folder, and what it cannot do said."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.errors import ConfigError
from snakesim_hal.in_process import InProcessRun
from snakesim_hal.model.files import shipped
from snakesim_hal.model.scenario import Override, load, parse_set, read
from snakesim_hal.network.client import Client
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import DepthImage
from snakesim_operator.results.record import BLACK_BOX, CONFIG, DESCRIPTION, HOST_RECORD, REPORT, SUMMARY, TELEMETRY
from snakesim_operator.results.record import RunRecord as Record
from snakesim_operator.run.in_process import WORDS, Result, simulate
from tests.e2e.command import nothing_left, run_to_summary, snakesim

pytestmark = pytest.mark.e2e
LEFT = {BLACK_BOX, CONFIG, DESCRIPTION, HOST_RECORD, REPORT, SUMMARY, TELEMETRY}


def same_both_ways(out: Path, scenario: str, *arguments: str) -> Result:
    """Run it in processes, then its effective configuration in this one; both must agree in every tick."""
    ended, summary = run_to_summary(out, scenario, *arguments)
    assert ended.code == 0, ended.out + ended.err
    theirs, ours = Record.load(out), simulate(read(out / CONFIG))
    assert ours.summary.ended == "complete"
    assert ours.summary.command_digest == summary.command_digest
    assert ours.summary.path_distance_m == summary.path_distance_m
    for name in ("angle_rad", "torque_nm", "target", "position_w", "contact_peak_n"):
        assert np.array_equal(getattr(ours.record, name), getattr(theirs, name), equal_nan=True), name
    # How often tick 0 is shown until the arming is chance, and whether the last one still comes while the host ends.
    for name in ("control", "worlds"):
        mine, other = ([told for told in getattr(record, name) if told.tick] for record in (ours.record, theirs))
        assert mine[: len(other)] == other and len(mine) - len(other) in (0, 1), name
    return ours


@pytest.mark.parametrize("scenario", shipped("scenarios"))
def test_every_shipped_scenario_drives_the_motors_alike(scenario: str, tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", scenario, "--duration", "1")


@pytest.mark.slow
@pytest.mark.parametrize("scenario", shipped("scenarios"))
def test_so_does_its_whole_length(scenario: str, tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", scenario)


def test_so_does_a_robot_with_a_camera_like_the_robot_without(tmp_path: Path) -> None:
    """An image of the camera is named by the clock, and is there for whoever reads it at that tick."""
    seeing = same_both_ways(tmp_path / "run", "peg_row", "--duration", "1", "--set", "robot=planar13_camera")
    blind = simulate(load("peg_row", [parse_set("duration_s=1")]).config)
    assert seeing.summary.command_digest == blind.summary.command_digest
    config = load("peg_row", [parse_set("duration_s=0.5"), parse_set("robot=planar13_camera")]).config
    with InProcessRun(config) as run:
        client = Client(run.network.session(), "onlooker")
        images, client_ticks = client.subscribe(keys.depth("head"), DepthImage), client.ticks(0.0)
        read: list[tuple[int, int]] = []
        for _ in run.turns():
            while (clock := next(client_ticks)) is not None:
                image = client.read(images)
                if image is not None and clock.newest[keys.depth("head")] == clock.tick:
                    read.append((clock.tick, image.tick))
    assert len(read) == 10 and all(tick == of for tick, of in read)


def test_so_do_joint_modules_behind_their_bus(tmp_path: Path) -> None:
    same_both_ways(tmp_path / "run", "triplet", "--duration", "1", "--backend", "can")


def test_faults_on_request_are_the_same_too(tmp_path: Path) -> None:
    faults = ["--fault", "wrong:joint_3@0.3-0.5=0.01", "--fault", "duplicate:guidance/world@0.2-0.6"]
    result = same_both_ways(tmp_path / "run", "triplet", "--duration", "1", *faults)
    assert any("wrong:joint_3" in text for text in result.record.host.injected)


def test_the_command_leaves_the_folder_of_a_run(tmp_path: Path) -> None:
    out = tmp_path / "run"
    ended = snakesim("run", "triplet", "--in-process", "--duration", "1", "--out", str(out), cwd=tmp_path)
    assert ended.code == 0, ended.out + ended.err
    assert {path.name for path in out.iterdir()} == LEFT | {WORDS}
    assert "in one process" in ended.out and str(out / REPORT) in ended.out and not ended.err
    again = snakesim("run", str(out / CONFIG), "--out", str(tmp_path / "again"), cwd=tmp_path)
    digests = [Record.load(folder).host.command_digest for folder in (out, tmp_path / "again")]
    assert again.code == 0 and digests[0] == digests[1]
    nothing_left(out)


def test_a_program_may_have_the_folder_too(tmp_path: Path) -> None:
    config = load("triplet", [parse_set("duration_s=0.5")]).config
    simulate(config, tmp_path / "run")
    assert {path.name for path in (tmp_path / "run").iterdir()} == LEFT | {WORDS}


FAILING = """
from snakesim_gnc.control.hold import Hold


class Failing(Hold):
    def update(self, view):
        if view.tick == 20:
            raise ValueError("no idea")
        return super().update(view)
"""


def test_a_controller_that_fails_ends_the_run_in_a_safe_stop(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text(FAILING)
    result = simulate(load("triplet", [Override("controller", f"{tmp_path}/failing.py:Failing", "the test")]).config)
    assert "control ended: controller" in result.summary.ended and "no idea" in result.summary.ended
    assert [fault.what for fault in result.summary.faults] == ["service_lost", "lease_expired"]
    assert result.record.host.lifecycle == "fault"


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        (["pace=realtime"], "pace is 'realtime', must be 'lockstep'; add --pace lockstep"),
        (["services.control.external=true"], "it needs a control service that is not external"),
        (["services.guidance.external=true"], "services.guidance is external, and there is no network to meet it"),
        (['faults=["kill:control@1"]'], "fault 'kill:control@1' needs processes of their own"),
    ],
)
def test_what_needs_processes_or_a_network_is_refused(sets: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        simulate(load("triplet", [parse_set(text) for text in sets]).config)


def test_the_command_refuses_what_needs_a_network(tmp_path: Path) -> None:
    for flags in (["--stay"], ["--endpoint", "tcp/127.0.0.1:7500"], ["--namespace", "lab"], ["--with-router"]):
        ended = snakesim("run", "triplet", "--in-process", *flags, cwd=tmp_path)
        assert ended.code == 2 and f"--in-process and {flags[0]}: there is no network" in ended.err
    assert not (tmp_path / "runs").exists()
