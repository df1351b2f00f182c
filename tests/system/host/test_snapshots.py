"""Sensors that look around work beside the tick: they arrive when they should, or not at all, and delay nothing."""

import threading

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import KeyOverride, load_scenario
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import DepthImage, JointMode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

HEAD = keys.depth_key("head")
CAMERA = {"name": "head", "width": 40, "height": 30, "rate_hz": 20.0}
WALL = {"ground": {"friction": 0.0}, "box": [{"position_m": [4.0, 0.0], "size_m": [0.5, 9.0, 3.0]}]}
SLOW = """
import time
from snakesim_sim_backend.sensors.depth import RayCamera
from snakesim_hal.wire.messages import RangeScan

class Slow(RayCamera):
    def read(self, tick, timestamp_ns):
        time.sleep({sleep_s})
        return super().read(tick, timestamp_ns)

class Broken(RayCamera):
    def read(self, tick, timestamp_ns):
        raise OSError("lens cap on")

class Mute(RayCamera):
    message = RangeScan

class Plain:
    message = RangeScan
"""


def run_with(camera=None, **top):
    return SimulatorRig(
        make_config({"sensors": {"depth": [{**CAMERA, **(camera or {})}]}}, WALL, **top)
    )


def arrivals(run, ticks):
    """(tick, image) of everything that came."""
    found = []
    for _ in range(ticks):
        others = run.sample().by_key
        if HEAD in others:
            found.append((run.tick, others[HEAD]))
        run.advance()
    run.sim.close()
    return found


@pytest.mark.parametrize(("delay_s", "ticks"), [(0.0, 1), (0.01, 1), (0.03, 3), (0.12, 12)])
def test_snapshot_shows_past_scene_and_arrives_after_delay(delay_s, ticks):
    run = run_with({"delay_s": delay_s})
    run.sim.data.qvel[0] = 1.0  # slides towards the wall on ice, by 1 cm a tick
    before_m = 3.75 - (float(run.sim.data.qpos[0]) + 13 * 0.11 + 0.04)
    (sensor,) = (s for s in run.sim.describe().sensors if s.key == HEAD)
    assert sensor.rate_hz == 20.0
    assert sensor.delay_s == pytest.approx(ticks * 0.01)
    found = arrivals(run, 30)
    assert [tick for tick, _ in found] == [
        tick + ticks for tick in range(0, 30, 5) if tick + ticks < 30
    ]
    for tick, image in found:
        assert isinstance(image, DepthImage)
        taken = tick - ticks
        assert image.tick == tick
        assert image.timestamp_ns == taken * 10_000_000
        middle_m = np.frombuffer(image.depth, "<u2").reshape(30, 40)[10, 20] * image.scale_m
        assert middle_m == pytest.approx(before_m - 0.01 * taken, abs=0.001)


def bytes_of_a_run(robot, seed=3):
    config = load_scenario("peg_row", [KeyOverride("robot", robot, "--robot")]).config
    run = SimulatorRig(msgspec.structs.replace(config, seed=seed))
    reported = {}
    for tick in range(40):
        samples = run.sample()
        for key, message in (("joints", samples.joints), *samples.by_key.items()):
            reported[key] = reported.get(key, b"") + encode(message)
        run.command(
            [JointMode.POSITION] * 13, [0.5 * np.sin(0.1 * tick + 0.6 * i) for i in range(13)]
        )
        run.advance()
    run.sim.close()
    return reported


def test_snapshot_depends_only_on_seed_and_changes_nothing_else():
    first, again, other = (bytes_of_a_run("planar13_camera", seed) for seed in (3, 3, 4))
    assert first == again
    image = first.pop(HEAD)
    assert image
    assert image != other[HEAD]
    assert first["joints"] != other["joints"]
    assert first == bytes_of_a_run("planar13")


def test_snapshot_thread_is_absent_without_cameras():
    def looking():
        return [
            thread.name for thread in threading.enumerate() if thread.name.startswith("sensors")
        ]

    before = looking()
    plain = SimulatorRig(make_config())
    assert looking() == before
    seeing = run_with()
    assert len(looking()) == len(before) + 1
    seeing.sim.close()
    assert looking() == before
    plain.sim.close()


def slow(tmp_path, sleep_s, name="Slow"):
    path = tmp_path / f"slow_{name}.py"
    path.write_text(SLOW.replace("{sleep_s}", str(sleep_s)))
    return {"model": f"{path}:{name}"}


def test_snapshot_late_in_real_time_is_dropped_and_reported_rarely(tmp_path):
    run = run_with(
        {**slow(tmp_path, 1.0), "delay_s": 0.01, "rate_hz": 100.0}, clock_mode="realtime"
    )
    reported = []
    for _ in range(40):
        assert HEAD not in run.sample().by_key
        reported += [*run.sim.faults(), *run.sim.faults()]  # once for the same number
        run.advance()
    run.sim.close()
    assert run.sim._sensors.dropped_counts == {HEAD: 39}  # pyright: ignore[reportPrivateUsage]
    assert {(fault.what, fault.scope) for fault in reported} == {("sample_late", "none")}
    assert [int(fault.cause.split()[1]) for fault in reported] == [1, 2, 4, 8, 16, 32]


def test_in_lockstep_a_late_image_is_waited_for(tmp_path):
    run = run_with({**slow(tmp_path, 0.05), "delay_s": 0.01})
    assert [tick for tick, _ in arrivals(run, 10)] == [1, 6]


def test_a_model_that_breaks_is_an_error_of_the_backend(tmp_path):
    run = run_with(slow(tmp_path, 0, "Broken"))
    with raises_error(OSError):
        arrivals(run, 10)
    run.sim.close()


@pytest.mark.parametrize(
    "camera",
    [
        {"model": "radar"},
        {"model": "./nothing.py:Radar"},
        {"settings": {"gain": 2}},
    ],
)
def test_snapshot_impossible_model_is_refused_before_opening_anything(camera):
    config = make_config({"sensors": {"depth": [{**CAMERA, **camera}]}})
    with raises_error(
        ConfigError, code=("config/unknown-key", "plugin/not-found", "plugin/not-loadable")
    ):
        SimBackend.check(config, SimSettings())


def test_a_model_that_makes_something_else_is_refused(tmp_path):
    with raises_error(ConfigError, code="plugin/not-loadable"):
        run_with(slow(tmp_path, 0, "Mute"))
    with pytest.raises(ConfigError, match=r"class Plain in .* does not derive from SensorModel"):
        run_with(slow(tmp_path, 0, "Plain"))
