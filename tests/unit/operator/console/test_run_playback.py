"""The console shows a recorded run with the messages of the chosen time, as the live page does."""

from pathlib import Path

import pytest
from pytest import approx

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.page.camera_tab import draw_picture
from snakesim_operator.features.console.robot_data.run_playback import RunPlayback
from snakesim_operator.run.in_process import simulate


def test_playback_state_faults_and_power_match_the_time(tmp_path: Path) -> None:
    changes = [parse_set_option("duration_s=2"), parse_set_option('faults=["nan:joint_3@1"]')]
    simulate(load_scenario("triplet", changes).config, tmp_path / "run")
    playback = RunPlayback(tmp_path / "run")
    moving = playback.make_snapshot(0.5)
    assert moving.status is not None
    assert moving.status.lifecycle == "armed"
    assert not moving.status.faults
    assert moving.power is not None
    assert "armed by" in page_html.format_header(moving, recorded="run")
    _, end_s = playback.span_s
    stopped = playback.make_snapshot(end_s)
    assert stopped.status is not None
    assert stopped.status.lifecycle == "fault"
    assert "joint_3" in page_html.format_state_table(stopped)
    assert "FAULT" in page_html.format_header(stopped, recorded="run")
    assert any("robot fault" in line for line in stopped.log[:3])
    assert any("control Locomoting" in line for line in moving.log)
    assert len(moving.log) < len(stopped.log), "a snapshot contains no later entries"


@pytest.mark.slow
def test_playback_cameras_rates_and_charts_match_the_time(tmp_path: Path) -> None:
    simulate(
        load_scenario("clutter", [parse_set_option("duration_s=1.5")]).config, tmp_path / "run"
    )
    playback = RunPlayback(tmp_path / "run")
    early = playback.make_snapshot(0.3)
    late = playback.make_snapshot(1.4)
    (early_image,) = early.images.values()
    (late_image,) = late.images.values()
    assert [*early.images] == ["sensor/depth/head"]
    assert abs(early_image.timestamp_ns * 1e-9 - 0.3) < 0.1
    assert draw_picture(early_image).std() > 0
    assert (draw_picture(late_image) != draw_picture(early_image)).any()
    assert late.streams["sensor/joints"].rate_hz == approx(100, abs=2)
    chart_times_s = [snapshot.time_s or 0.0 for snapshot in playback.iterate_snapshots_before(1.0)]
    assert chart_times_s == sorted(chart_times_s)
    assert chart_times_s[0] == playback.span_s[0]
    assert 0.98 < chart_times_s[-1] < 1.0
