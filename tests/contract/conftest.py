"""The benches that our own backends have to stand on."""

import os
from pathlib import Path
from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import CanFrame, parse_node
from snakesim_drivers.kit.mixed import MixedBackend
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import ClockMode
from snakesim_native.compile import NO_COMPILER, list_compilers
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType, ModuleDrives
from snakesim_testing.benches.firmware_drives import FirmwareDrives
from snakesim_testing.benches.homing_drives import HomingBackend
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.kit_drives import KitDrives, mute_joint

VCAN = "SNAKESIM_VCAN"  # set by deploy/vm/with_vcan.py: the kernel here has vcan0, and it is up
IN_AN_EMULATED_MACHINE = (  # an opening takes half a minute there: `-m ""` runs the other clauses, too
    "every_joint_is_valid",
    "position_mode",
    "leaving_armed",
    "a_silent_joint",
    "falls_silent",
    "a_closed_backend",
)
WHISKER = Path(__file__).parents[2] / "examples" / "whisker.py"
MINIMAL_DRIVER = Path(__file__).parents[2] / "examples" / "minimal_driver.py"
# Clauses that a camera may concern.
OF_SENSORS = "sensor", "sample", "contradicts_itself", "listed"
LOOKS_AHEAD = (
    'robot.sensors.depth=[{name="head", width=32, height=24, pitch_rad=0.4}]',
    'robot.sensors.range=[{name="front", beams=9, fov_rad=2.0}]',
    f'robot.sensors.custom=[{{name="whisker", model="{WHISKER}:WhiskerModel"}}]',
)
# ODrive has the same kit, Dynamixel no velocity mode.
AS_ANOTHER = "moteus", "sim-position", "threads"
# moteus does it otherwise; for buses in threads see tests/system/drives/test_buses.py
WITHOUT_THE_DRIVER = "test_drives_"
POSITION_ONLY = ('robot.drive.modes=["position"]', "robot.drive.measures=[]")
HEAD_OF_SERVOS = (
    'robot.drive.driver="odrive"',
    'robot.joints.joint_3.driver="dynamixel"',
    'robot.joints.joint_4.driver="dynamixel"',
)
ALL_FAMILIES = (
    'robot.drive.driver="odrive"',
    'robot.joints.joint_2.driver="moteus"',
    'robot.joints.joint_3.driver="dynamixel"',
    'robot.joints.joint_4.driver="dynamixel"',
)
ON_VCAN = ('backend.channels=["vcan0"]', 'backend.emulators="process"')


class InRealTime(MixedBackend):
    """Each bus in a thread of its own, where emulated drives in this process would let it be in turn."""

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[ClockMode, ...]:
        super().check(config, settings)
        return ("realtime",)


IN_REAL_TIME: Any = InRealTime


@pytest.hookimpl(optionalhook=True)
def pytest_snakesim_benches() -> list[Bench]:
    """Simulator, also with a camera; CAN on a bus inside the process, or on the kernel's with modules as processes."""
    if os.environ.get(VCAN):  # `make test-can`
        return [Bench("can-vcan", "can", overrides=ON_VCAN, mute_joint=cut_off)]
    return [
        Bench("sim", "sim"),
        Bench("sim-camera", "sim", overrides=LOOKS_AHEAD),
        Bench("sim-position", "sim", overrides=POSITION_ONLY),
        Bench("can-virtual", "can", mute_joint=cut_off, make_emulated_drives=ModuleDrives),
        Bench(
            "can-firmware",
            "can",
            overrides=('backend.emulators="firmware"',),
            mute_joint=cut_off,
            make_emulated_drives=FirmwareDrives,
            unavailable_reason=find_reason_against_firmware(),
        ),
        Bench("odrive", "odrive", mute_joint=cut_drive_off, make_emulated_drives=DrivesOfAnyType),
        Bench("moteus", "moteus", mute_joint=cut_drive_off, make_emulated_drives=DrivesOfAnyType),
        Bench("cia402", "cia402", mute_joint=cut_drive_off, make_emulated_drives=DrivesOfAnyType),
        Bench(
            "dynamixel", "dynamixel", mute_joint=cut_drive_off, make_emulated_drives=DrivesOfAnyType
        ),
        Bench("feetech", "feetech", mute_joint=cut_drive_off, make_emulated_drives=DrivesOfAnyType),
        Bench(
            "minimal-driver",
            f"{MINIMAL_DRIVER}:MinimalBackend",
            mute_joint=mute_joint,
            make_emulated_drives=KitDrives,
        ),
        Bench(
            "homing-driver", HomingBackend, mute_joint=mute_joint, make_emulated_drives=KitDrives
        ),
        Bench(
            "mixed",
            "mixed",
            overrides=HEAD_OF_SERVOS,
            mute_joint=cut_drive_off,
            make_emulated_drives=DrivesOfAnyType,
        ),
        Bench(
            "threads",
            IN_REAL_TIME,
            overrides=ALL_FAMILIES,
            mute_joint=cut_drive_off,
            make_emulated_drives=DrivesOfAnyType,
        ),
    ]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Only clauses that depend on what the bench is for: the camera, the bus. All are for `make verify`."""
    for item in items:
        is_special = WITHOUT_THE_DRIVER in item.name and "[moteus" in item.name
        if any(f"[{bench}" in item.name for bench in AS_ANOTHER) and not is_special:
            item.add_marker(pytest.mark.slow)
        if "sim-camera" in item.name and not any(words in item.name for words in OF_SENSORS):
            item.add_marker(pytest.mark.slow)
    if os.environ.get(VCAN) != "guest":
        return
    for item in items:
        if item.path.name == "test_contract.py" and not any(
            words in item.name for words in IN_AN_EMULATED_MACHINE
        ):
            item.add_marker(pytest.mark.slow)


def find_reason_against_firmware() -> str | None:
    """Why the reference firmware cannot be compiled here. CI has a compiler, and must run its clauses."""
    if list_compilers() or os.environ.get("CI"):
        return None
    return f"the reference firmware of joint modules is in C, and {NO_COMPILER}"


def cut_off(backend: Any, joint: int) -> None:
    """From now on the driver hears nothing of a joint's module."""
    process_frame = backend.modules.module_reports.process_frame

    def receive(frame: CanFrame) -> None:
        if parse_node(frame.id) != joint + 1:
            process_frame(frame)

    backend.modules.module_reports.process_frame = receive


def cut_drive_off(backend: Any, joint: int) -> None:
    """From now on the driver hears nothing of a joint's drive."""
    bus = next(bus for bus in backend._drives.buses if joint in bus.spec.joints)
    drives, silent = bus.drives, bus.spec.joints.index(joint)
    handle_response = drives.handle_response

    def heard(i: int, said: Any) -> None:
        if i != silent:
            handle_response(i, said)

    drives.handle_response = heard
