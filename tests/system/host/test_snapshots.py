"""Camera images are computed beside the control cycle: they arrive on time or not at all, and delay no tick."""

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
CAMERA_MODELS = """
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


def make_camera_rig(camera=None, **top):
    """Return a simulated robot with one depth camera before a wall.

    Args:
        camera: Settings of the camera that differ from CAMERA.
        top: Settings of the run.
    """
    return SimulatorRig(
        make_config({"sensors": {"depth": [{**CAMERA, **(camera or {})}]}}, WALL, **top)
    )


def record_arrivals(run, ticks):
    """Simulate a number of ticks, and return a pair of tick and image for each image that arrived."""
    images = []
    for _ in range(ticks):
        samples = run.sample().by_key
        if HEAD in samples:
            images.append((run.tick, samples[HEAD]))
        run.advance()
    run.sim.close()
    return images


@pytest.mark.parametrize(("delay_s", "delay_ticks"), [(0.0, 1), (0.01, 1), (0.03, 3), (0.12, 12)])
def test_snapshot_shows_past_scene_and_arrives_after_delay(delay_s, delay_ticks):
    run = make_camera_rig({"delay_s": delay_s})
    run.sim.data.qvel[0] = 1.0  # The robot slides on ice toward the wall, 1 cm in each tick.
    initial_distance_m = 3.75 - (float(run.sim.data.qpos[0]) + 13 * 0.11 + 0.04)
    (sensor,) = (sensor for sensor in run.sim.describe().sensors if sensor.key == HEAD)
    assert sensor.rate_hz == 20.0
    assert sensor.delay_s == pytest.approx(delay_ticks * 0.01)
    images = record_arrivals(run, 30)
    assert [tick for tick, _ in images] == [
        tick + delay_ticks for tick in range(0, 30, 5) if tick + delay_ticks < 30
    ]
    for tick, image in images:
        assert isinstance(image, DepthImage)
        snapshot_tick = tick - delay_ticks
        assert image.tick == tick
        assert image.timestamp_ns == snapshot_tick * 10_000_000
        middle_m = np.frombuffer(image.depth, "<u2").reshape(30, 40)[10, 20] * image.scale_m
        assert middle_m == pytest.approx(initial_distance_m - 0.01 * snapshot_tick, abs=0.001)


def record_sample_bytes(robot, seed=3):
    """Simulate 40 ticks, and return the encoded samples of each key, one after the other."""
    config = load_scenario("peg_row", [KeyOverride("robot", robot, "--robot")]).config
    run = SimulatorRig(msgspec.structs.replace(config, seed=seed))
    bytes_by_key = {}
    for tick in range(40):
        samples = run.sample()
        for key, message in (("joints", samples.joints), *samples.by_key.items()):
            bytes_by_key[key] = bytes_by_key.get(key, b"") + encode(message)
        run.command(
            [JointMode.POSITION] * 13,
            [0.5 * np.sin(0.1 * tick + 0.6 * joint) for joint in range(13)],
        )
        run.advance()
    run.sim.close()
    return bytes_by_key


def test_snapshot_depends_only_on_seed_and_changes_nothing_else():
    first = record_sample_bytes("planar13_camera", seed=3)
    repeated = record_sample_bytes("planar13_camera", seed=3)
    other = record_sample_bytes("planar13_camera", seed=4)
    assert first == repeated
    image = first.pop(HEAD)
    assert image
    assert image != other[HEAD]
    assert first["joints"] != other["joints"]
    assert first == record_sample_bytes("planar13")


def test_snapshot_thread_is_absent_without_cameras():
    def list_sensor_threads():
        return [
            thread.name for thread in threading.enumerate() if thread.name.startswith("sensors")
        ]

    threads_before = list_sensor_threads()
    without_camera = SimulatorRig(make_config())
    assert list_sensor_threads() == threads_before
    with_camera = make_camera_rig()
    assert len(list_sensor_threads()) == len(threads_before) + 1
    with_camera.sim.close()
    assert list_sensor_threads() == threads_before
    without_camera.sim.close()


def write_camera_model(tmp_path, sleep_s, name="Slow"):
    """Write a file with camera models, and return the setting that selects one.

    Args:
        tmp_path: Folder of the file.
        sleep_s: How long the model `Slow` takes for an image.
        name: Class of the model.
    """
    path = tmp_path / f"slow_{name}.py"
    path.write_text(CAMERA_MODELS.replace("{sleep_s}", str(sleep_s)))
    return {"model": f"{path}:{name}"}


def test_snapshot_late_in_real_time_is_dropped_and_reported_rarely(tmp_path):
    run = make_camera_rig(
        {**write_camera_model(tmp_path, 1.0), "delay_s": 0.01, "rate_hz": 100.0},
        clock_mode="realtime",
    )
    faults = []
    for _ in range(40):
        assert HEAD not in run.sample().by_key
        faults += [*run.sim.faults(), *run.sim.faults()]  # A second call reports nothing new.
        run.advance()
    run.sim.close()
    assert run.sim._sensors.dropped_counts == {HEAD: 39}  # pyright: ignore[reportPrivateUsage]
    assert {(fault.what, fault.scope) for fault in faults} == {("sample_late", "none")}
    assert [int(fault.cause.split()[1]) for fault in faults] == [1, 2, 4, 8, 16, 32]


def test_snapshot_late_in_lockstep_is_awaited(tmp_path):
    run = make_camera_rig({**write_camera_model(tmp_path, 0.05), "delay_s": 0.01})
    assert [tick for tick, _ in record_arrivals(run, 10)] == [1, 6]


def test_snapshot_model_that_raises_is_a_backend_error(tmp_path):
    run = make_camera_rig(write_camera_model(tmp_path, 0, "Broken"))
    with raises_error(OSError):
        record_arrivals(run, 10)
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


def test_snapshot_model_with_wrong_type_is_refused(tmp_path):
    with raises_error(ConfigError, code="plugin/not-loadable"):
        make_camera_rig(write_camera_model(tmp_path, 0, "Mute"))
    with pytest.raises(ConfigError, match=r"class Plain in .* does not derive from SensorModel"):
        make_camera_rig(write_camera_model(tmp_path, 0, "Plain"))
