"""What the console shows of a recorded run: the robot's own words of that instant, as a live page has them."""

from pathlib import Path

import pytest
from pytest import approx

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.page.camera_tab import draw_picture
from snakesim_operator.features.console.robot_data.run_playback import RunPlayback
from snakesim_operator.run.in_process import simulate


def test_state_faults_and_supply_are_those_of_the_instant(tmp_path: Path) -> None:
    sets = ["duration_s=2", 'faults=["nan:joint_3@1"]']
    simulate(
        load_scenario("triplet", [parse_set_option(one) for one in sets]).config, tmp_path / "run"
    )
    recorded = RunPlayback(tmp_path / "run")
    moving, (_, end_s) = recorded.make_snapshot(0.5), recorded.span_s
    assert moving.status is not None
    assert moving.status.lifecycle == "armed"
    assert not moving.status.faults
    assert moving.power is not None
    assert "armed by" in page_html.format_header(moving, recorded="run")
    over = recorded.make_snapshot(end_s)
    assert over.status is not None
    assert over.status.lifecycle == "fault"
    assert "joint_3" in page_html.format_state_table(over)
    assert "FAULT" in page_html.format_header(over, recorded="run")
    assert any("robot fault" in line for line in over.log[:3])
    assert any("control Locomoting" in line for line in moving.log)
    assert len(moving.log) < len(over.log)  # what came later is not known yet


@pytest.mark.slow
def test_cameras_rates_and_charts_are_those_of_the_instant(tmp_path: Path) -> None:
    simulate(
        load_scenario("clutter", [parse_set_option("duration_s=1.5")]).config, tmp_path / "run"
    )
    recorded = RunPlayback(tmp_path / "run")
    early, late = recorded.make_snapshot(0.3), recorded.make_snapshot(1.4)
    (seen,), (later,) = early.images.values(), late.images.values()
    assert [*early.images] == ["sensor/depth/head"]
    assert abs(seen.timestamp_ns * 1e-9 - 0.3) < 0.1
    assert draw_picture(seen).std() > 0
    assert (draw_picture(later) != draw_picture(seen)).any()
    assert late.streams["sensor/joints"].rate_hz == approx(100, abs=2)
    charted = [snapshot.time_s or 0.0 for snapshot in recorded.iterate_snapshots_before(1.0)]
    assert charted == sorted(charted)
    assert charted[0] == recorded.span_s[0]
    assert 0.98 < charted[-1] < 1.0
