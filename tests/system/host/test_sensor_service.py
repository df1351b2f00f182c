"""The sensor service simulates the cameras of a robot on the CAN backend, from the scene file or from a recording."""

import json
from base64 import b64encode
from pathlib import Path

import msgspec
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import SERVICES, register_plugin_temporarily
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.network.client import HostClient
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import DepthImage
from snakesim_sim_backend.sensor_service import SensorService
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig

HEAD = keys.depth_key("head")
DECIMATION = 5  # ticks from one image to the next
LATENCY_TICKS = 3
MAX_MEDIAN_DIFFERENCE_MM = 3  # the service estimates pose and angles from measurements
NOISE_FREE = ("noise_m=0", "noise_m_per_m2=0", "dropout=0")


def load_camera_config(*sets: str) -> RunConfig:
    """Load a scenario of a robot with a noise-free camera and a sensor service, with more `--set` options."""
    noise_free = [f"robot.sensors.depth.0.{text}" for text in NOISE_FREE]
    schedule = [
        f"services.sensor.decimation={DECIMATION}",
        f"services.sensor.latency_ticks={LATENCY_TICKS}",
        "duration_s=0.4",
    ]
    return load_scenario(
        "peg_row",
        [
            parse_set_option(text)
            for text in ("robot=planar13_camera", *noise_free, *schedule, *sets)
        ],
    ).config


def record_images(config: RunConfig) -> list[DepthImage]:
    """Run a configuration, and return the images that a client reads which acts at every tick."""
    images_by_tick: dict[int, DepthImage] = {}
    with (
        register_plugin_temporarily(SERVICES, "sensor", SensorService),
        InProcessRun(config) as run,
    ):
        client = HostClient(run.network.create_session(), "onlooker")
        images = client.subscribe(HEAD, DepthImage)
        ticks = client.iterate_ticks(0.0)
        for _ in run.iterate_ticks():
            while (clock := next(ticks)) is not None:
                image = client.read(images)
                if image is not None and clock.arm_session:
                    newest_tick = max(clock.tick - LATENCY_TICKS, 0) // DECIMATION * DECIMATION
                    assert image.tick == newest_tick
                    images_by_tick[image.tick] = image
        assert not run.failed_services
    return list(images_by_tick.values())


@pytest.mark.slow
def test_sensor_service_on_can_measures_the_simulator_image() -> None:
    can_images = record_images(load_camera_config("backend=can"))
    assert [image.tick for image in can_images] == list(range(0, 40, DECIMATION))[: len(can_images)]
    assert len(can_images) >= 7
    simulated = SimulatorRig(load_camera_config())
    simulated.sample()
    simulated.advance(0.03)
    simulated_image = simulated.sample_only_sensor(DepthImage)
    simulated.sim.close()
    can_mm = np.frombuffer(can_images[0].depth, "<u2").astype(int)
    simulated_mm = np.frombuffer(simulated_image.depth, "<u2").astype(int)
    is_near = (can_mm > 0) & (simulated_mm > 0) & (simulated_mm < 1000)
    assert is_near.mean() > 0.3
    median_difference_mm = np.median(np.abs(can_mm - simulated_mm)[is_near])
    assert median_difference_mm <= MAX_MEDIAN_DIFFERENCE_MM
    assert record_images(load_camera_config("backend=can")) == can_images


def test_sensor_service_with_simulated_camera_reads_nothing_itself() -> None:
    config = load_camera_config()
    with (
        register_plugin_temporarily(SERVICES, "sensor", SensorService),
        InProcessRun(config) as run,
    ):
        service = run._loop_by_service["sensor"].service  # pyright: ignore[reportPrivateUsage]
        assert isinstance(service, SensorService)
        assert service._readers == []  # pyright: ignore[reportPrivateUsage]


def write_recording(path: Path, images: list[DepthImage]) -> str:
    """Write images as `snakesim topic echo` prints them, and return the path of the file."""
    messages = [
        {**msgspec.to_builtins(image), "depth": b64encode(image.depth).decode()} for image in images
    ]
    path.write_text(
        "".join(
            json.dumps({"key": f"planar13/{HEAD}", "message": message}) + "\n"
            for message in messages
        )
    )
    return str(path)


@pytest.mark.heavy
def test_sensor_service_replays_recording_with_timestamps_of_this_run(tmp_path: Path) -> None:
    recorded = record_images(load_camera_config("backend=can"))
    file = write_recording(tmp_path / "head.jsonl", recorded[2:5])
    replayed = record_images(
        load_camera_config(
            "backend=can",
            "robot.sensors.depth.0.model=recorded",
            f'robot.sensors.depth.0.settings.file="{file}"',
        )
    )
    # The service repeats the three images of the recording.
    expected = [recorded[2 + i % 3].depth for i in range(len(replayed))]
    assert [image.depth for image in replayed] == expected
    assert [image.timestamp_ns for image in replayed] == [
        image.tick * 10_000_000 for image in replayed
    ]


def test_camera_with_unreadable_recording_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "head.jsonl"
    for text in ("{", ""):
        file.write_text(text)
        config = load_camera_config(
            "robot.sensors.depth.0.model=recorded", f'robot.sensors.depth.0.settings.file="{file}"'
        )
        with raises_error(ConfigError, code="recording/not-readable"):
            SimulatorRig(config)
