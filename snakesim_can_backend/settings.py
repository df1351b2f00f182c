"""The schema of a scenario's `[backends.can]` section."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from snakesim_can_backend.protocol.definitions import LAST_NODE
from snakesim_drivers.emulation.mounted import Mounted
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import from_zero


class MountedModule(Mounted, frozen=True, kw_only=True):
    """How an emulated module is really mounted and wired, where that is not what the robot file says."""

    id: Annotated[int, Meta(ge=1, le=LAST_NODE)] | None = None  # that it has: of another joint
    connected: bool = True  # False: its motor gets no current


class CanSettings(FileStruct, frozen=True, kw_only=True):
    """Buses, modules on them, and their reports."""

    # Buses, tail to head: SocketCAN interfaces such as can0, or INTERFACE:CHANNEL of python-can, such as
    # slcan:/dev/ttyACM0. Empty: a virtual bus in this process, with emulated joint modules on it.
    channels: Annotated[list[Annotated[str, Meta(min_length=1, max_length=127)]], Meta(max_length=8)] = []
    # Of the buses: loads are computed for it, and adapters set to it. A kernel interface has that of `ip link`.
    bit_rate: Annotated[int, Meta(ge=10_000, le=1_000_000, extra_json_schema={"unit": "bit/s"})] = 1_000_000
    # Number of joints of each channel, tail to head. Empty: distributed evenly.
    joints_per_channel: Annotated[list[Annotated[int, Meta(ge=1, le=LAST_NODE)]], Meta(max_length=8)] = []
    # Where emulated joint modules run: `here` (virtual bus), as a `process` that this one starts, or `none`: real
    # modules, or `snakesim drive emulate can` in another terminal. Default: `here` without channels, `none` with them.
    emulators: Literal["here", "process", "none"] | None = None
    physics_model: str = (
        "mujoco"  # body that the emulators' motors move: an entry point in the group `snakesim.physics_models`
    )
    physics_model_settings: dict[str, Any] = {}
    # Of the emulators: joint -> how its module is mounted in truth, to see what a wrong robot file does.
    mounted: dict[str, MountedModule] = {}
    faults: list[str] = []  # of the emulators, such as "mute:joint_3@2"; `snakesim drive emulate can --help` lists them
    contact_rate_hz: Annotated[float, from_zero(1e4, "Hz")] | None = None  # default: the robot file's
    imu_rate_hz: Annotated[float, from_zero(1e4, "Hz")] = 5.0
    watchdog_s: Annotated[float, Meta(ge=0.02, le=0.1, extra_json_schema={"unit": "s"})] = 0.1
    # Time limit for discovery and parameters of the modules.
    bring_up_limit_s: Annotated[float, Meta(gt=0, le=600, extra_json_schema={"unit": "s"})] = 10.0
    # UDP address for the base's pose from motion capture: HOST:PORT. Port 0: known only to own emulators.
    # Default: "127.0.0.1:0" with own emulators, none otherwise.
    pose_listen: Annotated[str, Meta(pattern="^[^:]*:[0-9]{1,5}$")] | None = None
    log: str = ""  # candump file of all frames sent and received; empty: none

    @property
    def emulators_run(self) -> Literal["here", "process", "none"]:
        """Where the emulated joint modules run."""
        return self.emulators or ("none" if self.channels else "here")
