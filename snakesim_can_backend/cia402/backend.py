"""The backend `cia402`: CiA 402 drives on CANopen, real or emulated."""

from collections.abc import Sequence

from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_can_backend.can_drives.traffic import CycleTraffic
from snakesim_can_backend.cia402.drives import Cia402Drives
from snakesim_can_backend.cia402.eds import read_all_eds
from snakesim_can_backend.cia402.emulator import EmulatedCia402
from snakesim_can_backend.cia402.frames import FIRST_NODE, LAST_NODE
from snakesim_can_backend.cia402.probe import NodeProbe
from snakesim_can_backend.cia402.settings import Cia402Settings
from snakesim_drivers.kit.drive_settings import make_joint_label
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig


class Cia402Backend(CanDriveBackend):
    """The backend on CiA 402 drives, real or emulated."""

    Settings = Cia402Settings
    drives_class = Cia402Drives
    emulator_class = EmulatedCia402
    name = "cia402"
    plural_noun = "CiA 402 drives"
    first_id = FIRST_NODE
    last_id = LAST_NODE - 1
    reserved_ids = "0 means all nodes, and 127 is the host's as shipped"
    # A drive reports with every SYNC, but its way to Operation enabled takes a while.
    report_period_s = 0.1
    # For each drive, a setpoint and two answers to SYNC; a change of the mode is rare. For each cycle, SYNC, the
    # heartbeat, and five reads of health and serial number.
    traffic = CycleTraffic(
        bytes_per_drive=(8, 8, 7),
        bytes_per_cycle=(0, 1, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8),
        heartbeats_hz=10.0,
    )

    @classmethod
    def open_probe(cls, config: RunConfig, settings: Cia402Settings) -> NodeProbe:
        return NodeProbe(config, settings)

    @classmethod
    def validate_joint(cls, config: RunConfig, settings: Cia402Settings, joint: Joint) -> None:
        """Check that no joint has the node id of the host.

        Raises:
            ConfigError: The joint has the node id of the host.
        """
        if joint.id == settings.host_id:
            raise ConfigError(
                f"{make_joint_label(config, joint)}: `id` = {joint.id} is the node id of the host, "
                f"`backends.cia402.host_id`: change one of the two",
                code="drive/unsupported-setting",
            )

    @classmethod
    def check_drives(
        cls, config: RunConfig, settings: Cia402Settings, joints: Sequence[Joint]
    ) -> None:
        """Check also the EDS files that the settings name."""
        read_all_eds(settings.eds)
        super().check_drives(config, settings, joints)
