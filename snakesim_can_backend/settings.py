"""The schema of a scenario's `[backends.can]` section."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from snakesim_can_backend.protocol.definitions import LAST_NODE
from snakesim_drivers.emulation.mounted import MountedDrive
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import from_zero


class MountedModule(MountedDrive, frozen=True, kw_only=True):
    """How an emulated module is really mounted and wired, where that differs from the robot file."""

    id: Annotated[int, Meta(ge=1, le=LAST_NODE)] | None = None
    """Id that the emulated module has instead of the one in the robot file. None: as in the robot file."""

    connected: bool = True
    """False: the motor of the emulated module gets no current."""


class CanSettings(FileStruct, frozen=True, kw_only=True):
    """Buses, modules on them, and their reports."""

    channels: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)
    ] = []
    """CAN buses, tail to head: SocketCAN interfaces such as can0, INTERFACE:CHANNEL of python-can, or local:FOLDER for
    emulated modules. Empty: a virtual bus in this process with emulated joint modules.
    """

    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = (
        1_000_000
    )
    """Bit rate of the buses, for which loads are computed and to which adapters are set. A kernel interface has that of
    `ip link`.
    """

    joints_per_channel: Annotated[
        list[Annotated[int, Meta(ge=1, le=LAST_NODE)]], Meta(max_length=8)
    ] = []
    """Number of joints of each channel, tail to head. Empty: joints are distributed evenly."""

    emulators: Literal["here", "process", "firmware", "none"] | None = None
    """Where emulated joint modules run: `here`, in a `process` that the driver starts, in one with the reference
    `firmware` in C, or `none` for real modules and those of `snakesim drive emulate can`. Default: `here` without
    channels, `none` with them.
    """

    physics_model: str = "mujoco"
    """Body that the emulators' motors move: `mujoco`, `inertia`, or another installed physics model."""

    physics_model_settings: dict[str, Any] = {}
    """Settings of the physics model, which checks them."""

    mounted: dict[str, MountedModule] = {}
    """For joints of emulated modules, how each is really mounted, to see what a wrong robot file does."""

    faults: list[str] = []
    """Faults of the emulators, such as "mute:joint_3@2". `snakesim drive emulate can --help` lists them."""

    contact_rate_hz: Annotated[float, from_zero(1e4, "Hz")] | None = None
    """Rate at which modules report contacts. None: that of the contact sensor in the robot file."""

    imu_rate_hz: Annotated[float, from_zero(1e4, "Hz")] = 5.0
    """Rate at which modules report their IMU. 0: they do not report it."""

    watchdog_s: Annotated[float, Meta(ge=0.02, le=0.1, extra_json_schema={"unit": "s"})] = 0.1
    """Time without a setpoint after which a module stops by itself."""

    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    """Time limit for finding the modules and reading their parameters at the start."""

    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None
    """UDP address HOST:PORT at which the pose from motion capture arrives. None: a free port for emulators that this
    process starts, otherwise no motion capture.
    """

    log: str = ""
    """Candump file of all frames that are sent and received. Empty: no file is written."""

    @property
    def emulators_run(self) -> Literal["here", "process", "firmware", "none"]:
        """Where the emulated joint modules run."""
        return self.emulators or ("none" if self.channels else "here")
