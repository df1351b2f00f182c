"""The benches with which our own backends run the contract suite."""

import os
from collections.abc import Collection
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

# deploy/vm/with_vcan.py sets this variable if the kernel has vcan0, and it is up.
VCAN_VARIABLE = "SNAKESIM_VCAN"
# Opening a backend takes half a minute in an emulated machine. `-m ""` runs the other clauses, too.
EMULATED_MACHINE_CLAUSES = (
    "every_joint_is_valid",
    "position_mode",
    "leaving_armed",
    "a_silent_joint",
    "falls_silent",
    "a_closed_backend",
)
WHISKER = Path(__file__).parents[2] / "examples" / "whisker.py"
MINIMAL_DRIVER = Path(__file__).parents[2] / "examples" / "minimal_driver.py"
# Parts of the names of clauses that may depend on a camera.
SENSOR_CLAUSES = ("sensor", "sample", "contradicts_itself", "listed")
CAMERA_OVERRIDES = (
    'robot.sensors.depth=[{name="head", width=32, height=24, pitch_rad=0.4}]',
    'robot.sensors.range=[{name="front", beams=9, fov_rad=2.0}]',
    f'robot.sensors.custom=[{{name="whisker", model="{WHISKER}:WhiskerModel"}}]',
)
# Benches whose clauses other benches cover: moteus and ODrive use the same kit, Dynamixel has position mode alone.
COVERED_BENCHES = ("moteus", "sim-position")
# In real time, with the leases of a robot: only a quiet computer keeps them.
REAL_TIME_BENCH = "threads"
# Driver types that share the kit with others. CI runs their clauses, and `make test` leaves them out.
HEAVY_BENCHES = ("can-firmware", "cia402", "dynamixel", "feetech", "homing-driver")
# These clauses are special for moteus. tests/system/drives/test_buses.py tests buses in threads.
DRIVER_FAILURE_CLAUSES = "test_drives_"
POSITION_ONLY_OVERRIDES = ('robot.drive.modes=["position"]', "robot.drive.measures=[]")
MIXED_OVERRIDES = (
    'robot.drive.driver="odrive"',
    'robot.joints.joint_3.driver="dynamixel"',
    'robot.joints.joint_4.driver="dynamixel"',
)
ALL_DRIVER_TYPES_OVERRIDES = (
    'robot.drive.driver="odrive"',
    'robot.joints.joint_2.driver="moteus"',
    'robot.joints.joint_3.driver="dynamixel"',
    'robot.joints.joint_4.driver="dynamixel"',
)
VCAN_OVERRIDES = ('backend.channels=["vcan0"]', 'backend.emulators="process"')


class RealTimeMixedBackend(MixedBackend):
    """A mixed robot in real time, with a thread for each bus. Emulated drives usually share one thread."""

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[ClockMode, ...]:
        super().check(config, settings)
        return ("realtime",)


REAL_TIME_MIXED_BACKEND: Any = RealTimeMixedBackend


@pytest.hookimpl(optionalhook=True)
def pytest_snakesim_benches() -> list[Bench]:
    """Return the benches of all our backends, or that of joint modules on vcan0 for `make test-can`."""
    if os.environ.get(VCAN_VARIABLE):  # `make test-can`
        return [Bench("can-vcan", "can", overrides=VCAN_OVERRIDES, mute_joint=mute_module)]
    return [
        Bench("sim", "sim"),
        Bench("sim-camera", "sim", overrides=CAMERA_OVERRIDES),
        Bench("sim-position", "sim", overrides=POSITION_ONLY_OVERRIDES),
        Bench("can-virtual", "can", mute_joint=mute_module, make_emulated_drives=ModuleDrives),
        Bench(
            "can-firmware",
            "can",
            overrides=('backend.emulators="firmware"',),
            mute_joint=mute_module,
            make_emulated_drives=FirmwareDrives,
            unavailable_reason=find_reason_against_firmware(),
        ),
        Bench("odrive", "odrive", mute_joint=mute_drive, make_emulated_drives=DrivesOfAnyType),
        Bench("moteus", "moteus", mute_joint=mute_drive, make_emulated_drives=DrivesOfAnyType),
        Bench("cia402", "cia402", mute_joint=mute_drive, make_emulated_drives=DrivesOfAnyType),
        Bench(
            "dynamixel", "dynamixel", mute_joint=mute_drive, make_emulated_drives=DrivesOfAnyType
        ),
        Bench("feetech", "feetech", mute_joint=mute_drive, make_emulated_drives=DrivesOfAnyType),
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
            overrides=MIXED_OVERRIDES,
            mute_joint=mute_drive,
            make_emulated_drives=DrivesOfAnyType,
        ),
        Bench(
            REAL_TIME_BENCH,
            REAL_TIME_MIXED_BACKEND,
            overrides=ALL_DRIVER_TYPES_OVERRIDES,
            mute_joint=mute_drive,
            make_emulated_drives=DrivesOfAnyType,
        ),
    ]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the clauses that `make test` leaves out. `make verify` runs all, and CI runs the heavy ones.

    Clauses that do not depend on the purpose of a bench are slow.
    """
    # Pytest passes the tests of all folders.
    contract_items = [item for item in items if item.path.is_relative_to(Path(__file__).parent)]
    for item in contract_items:
        is_special_for_moteus = DRIVER_FAILURE_CLAUSES in item.name and is_of_bench(item, "moteus")
        if is_of_bench(item, *COVERED_BENCHES) and not is_special_for_moteus:
            item.add_marker(pytest.mark.slow)
        if is_of_bench(item, REAL_TIME_BENCH):
            item.add_marker(pytest.mark.quiet)
        if is_of_bench(item, *HEAVY_BENCHES):
            item.add_marker(pytest.mark.heavy)
        if is_of_bench(item, "sim-camera") and not has_name_part(item, SENSOR_CLAUSES):
            item.add_marker(pytest.mark.slow)
    if os.environ.get(VCAN_VARIABLE) != "guest":
        return
    for item in contract_items:
        if item.path.name == "test_contract.py" and not has_name_part(
            item, EMULATED_MACHINE_CLAUSES
        ):
            item.add_marker(pytest.mark.slow)


def is_of_bench(item: pytest.Item, *benches: str) -> bool:
    """Return whether a clause runs on one of these benches, whose name begins its parameters."""
    return any(f"[{bench}" in item.name for bench in benches)


def has_name_part(item: pytest.Item, name_parts: Collection[str]) -> bool:
    """Return whether the name of a clause contains one of these parts."""
    return any(name_part in item.name for name_part in name_parts)


def find_reason_against_firmware() -> str | None:
    """Return why the reference firmware cannot be compiled here. CI has a compiler, and must run its clauses."""
    if list_compilers() or os.environ.get("CI"):
        return None
    return f"the reference firmware of joint modules is in C, and {NO_COMPILER}"


def mute_module(backend: Any, joint: int) -> None:
    """Drop all frames from the module of a joint from now on."""
    process_frame = backend.modules.module_reports.process_frame

    def pass_other_frames(frame: CanFrame) -> None:
        if parse_node(frame.id) != joint + 1:
            process_frame(frame)

    backend.modules.module_reports.process_frame = pass_other_frames


def mute_drive(backend: Any, joint: int) -> None:
    """Drop all responses from the drive of a joint from now on."""
    bus = next(bus for bus in backend._drives.buses if joint in bus.spec.joints)
    drives = bus.drives
    silent_index = bus.spec.joints.index(joint)
    handle_response = drives.handle_response

    def pass_other_responses(index: int, response: Any) -> None:
        if index != silent_index:
            handle_response(index, response)

    drives.handle_response = pass_other_responses
