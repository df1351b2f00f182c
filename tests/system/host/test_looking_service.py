"""Cameras in a service of their own: the CAN backend's robot sees the world of the scene file, or a recording."""

import json
from base64 import b64encode

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
QUIET = ("noise_m=0", "noise_m_per_m2=0", "dropout=0")


def config_of(*sets: str) -> RunConfig:
    quiet = [f"robot.sensors.depth.0.{text}" for text in QUIET]
    schedule = ["services.sensor.decimation=5", "services.sensor.latency_ticks=3", "duration_s=0.4"]
    return load_scenario(
        "peg_row",
        [parse_set_option(text) for text in ("robot=planar13_camera", *quiet, *schedule, *sets)],
    ).config


def images_of(config: RunConfig) -> list[DepthImage]:
    """What somebody who acts every tick reads, as the clock names it."""
    found: dict[int, DepthImage] = {}
    with (
        register_plugin_temporarily(SERVICES, "sensor", SensorService),
        InProcessRun(config) as run,
    ):
        onlooker = HostClient(run.network.create_session(), "onlooker")
        images, ticks = onlooker.subscribe(HEAD, DepthImage), onlooker.iterate_ticks(0.0)
        for _ in run.iterate_ticks():
            while (clock := next(ticks)) is not None:
                image = onlooker.read(images)
                if image is not None and clock.arm_session:
                    assert image.tick == (max(clock.tick - 3, 0)) // 5 * 5
                    found[image.tick] = image
        assert not run.failed_services
    return list(found.values())


@pytest.mark.slow
def test_looking_service_on_can_sees_what_simulator_sees() -> None:
    can = images_of(config_of("backend=can"))
    assert [image.tick for image in can] == list(range(0, 40, 5))[: len(can)]
    assert len(can) >= 7
    simulated = SimulatorRig(config_of())
    simulated.sample()
    simulated.advance(0.03)
    there = simulated.sample_only_sensor(DepthImage)
    simulated.sim.close()
    mine, other = (np.frombuffer(image.depth, "<u2").astype(int) for image in (can[0], there))
    near = (mine > 0) & (other > 0) & (other < 1000)
    assert near.mean() > 0.3
    assert np.median(np.abs(mine - other)[near]) <= 3  # mm; pose and angles are measured
    assert images_of(config_of("backend=can")) == can


def test_what_the_backend_has_itself_is_left_to_it() -> None:
    config = config_of()
    with (
        register_plugin_temporarily(SERVICES, "sensor", SensorService),
        InProcessRun(config) as run,
    ):
        service = run._loop_by_service["sensor"].service  # pyright: ignore[reportPrivateUsage]
        assert isinstance(service, SensorService)
        assert service._readers == []  # pyright: ignore[reportPrivateUsage]


def recording(path, images) -> str:
    """As `snakesim topic echo` prints it."""
    plain = [
        {**msgspec.to_builtins(image), "depth": b64encode(image.depth).decode()} for image in images
    ]
    path.write_text(
        "".join(json.dumps({"key": f"planar13/{HEAD}", "message": image}) + "\n" for image in plain)
    )
    return str(path)


def test_looking_service_replays_recording_with_times_of_this_run(tmp_path) -> None:
    recorded = images_of(config_of("backend=can"))
    file = recording(tmp_path / "head.jsonl", recorded[2:5])
    played = images_of(
        config_of(
            "backend=can",
            "robot.sensors.depth.0.model=recorded",
            f'robot.sensors.depth.0.settings.file="{file}"',
        )
    )
    wanted = [recorded[2 + i % 3].depth for i in range(len(played))]
    assert [image.depth for image in played] == wanted
    assert [image.timestamp_ns for image in played] == [image.tick * 10_000_000 for image in played]


def test_a_recording_that_is_none_is_told(tmp_path) -> None:
    file = tmp_path / "head.jsonl"
    for text in ("{", ""):
        file.write_text(text)
        config = config_of(
            "robot.sensors.depth.0.model=recorded", f'robot.sensors.depth.0.settings.file="{file}"'
        )
        with raises_error(ConfigError, code="recording/not-readable"):
            SimulatorRig(config)
