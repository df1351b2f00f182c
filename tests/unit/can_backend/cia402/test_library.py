"""The PyPI library `canopen` commands our emulated drives, and our driver commands drives of the library."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import canopen
import pytest
from canopen.emcy import EmcyError
from canopen.objectdictionary import ODVariable
from canopen.profiles.p402 import BaseNode402, OperationMode, State402
from canopen.sdo.exceptions import SdoAbortedError

from snakesim_can_backend.can_drives.drives import CanDrivesContext
from snakesim_can_backend.cia402 import objects
from snakesim_can_backend.cia402.backend import Cia402Backend
from snakesim_can_backend.cia402.drives import Cia402Drives
from snakesim_can_backend.cia402.eds import BUNDLED, SIZES, read_eds
from snakesim_can_backend.cia402.frames import ABORTS, SYNC_ID, describe_error
from snakesim_can_backend.cia402.state_machine import (
    ControlwordCommand,
    PowerState,
    decode_statusword,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.driver_loop import make_can_config

JOINTS = 2
CONFIG = make_can_config(JOINTS, backend="cia402")
EDS = str(BUNDLED)


class LibraryWire:
    """A bus between our code and a network of the library. Frames are delivered immediately, in the same thread."""

    channel = "library"

    def __init__(self) -> None:
        self.network = LibraryNetwork(self)
        self.received_frames: list[CanFrame] = []
        self.on_sent: Callable[[CanFrame], None] = lambda _frame: None
        self.on_received: Callable[[], None] = lambda: None

    def send(self, frame: CanFrame) -> bool:
        self.network.notify(frame.id, bytearray(frame.data), 0.0)
        self.on_sent(frame)
        return True

    def receive(self) -> list[CanFrame]:
        frames = self.received_frames
        self.received_frames = []
        return frames

    def errors(self) -> list[Any]:
        return []

    def fileno(self) -> None:
        return None

    def idle(self) -> float | None:
        return 0.0 if self.received_frames else None

    def inject(self, kind: str, *, begins: bool) -> None:
        raise NotImplementedError(kind, begins)

    def close(self) -> None:
        return


class LibraryNetwork(canopen.Network):
    """A network of the library that delivers its frames to our end of the wire."""

    def __init__(self, wire: LibraryWire) -> None:
        super().__init__()
        self._wire = wire

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        assert not remote
        self._wire.received_frames.append(CanFrame(can_id, bytes(data)))
        self._wire.on_received()

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        """Send nothing: a heartbeat would need a thread."""
        del can_id, data, period, remote
        return SimpleNamespace(stop=lambda: None, update=lambda _data: None)


class LibraryMaster:
    """The library as the master of our emulated drives."""

    def __init__(self) -> None:
        self.wire = LibraryWire()
        self.clock = DriverClock(CONFIG)
        settings = Cia402Backend.Settings(physics_model="inertia")
        self.emulator: Any = Cia402Backend.make_emulator(
            CONFIG, settings, [self.wire], self.clock, None
        )
        self.wire.on_received = self.emulator
        self.node: Any = BaseNode402(1, EDS)
        self.wire.network.add_node(self.node)
        self.pass_time(0.02)

    @property
    def drive(self) -> Any:
        return self.emulator.drives[0]

    def pass_time(self, seconds: float) -> None:
        self.clock.robot_time_ns += round(seconds * 1e9)
        self.emulator()

    def enable(self, mode: str) -> None:
        """Enable the drive in an operation mode."""
        self.node.sdo["Modes of operation"].raw = OperationMode.NAME2CODE[mode]
        self.node.state = "OPERATION ENABLED"


@pytest.fixture
def master() -> Iterator[LibraryMaster]:
    opened = LibraryMaster()
    yield opened
    opened.emulator.close()


def test_states_and_controlwords_equal_those_of_the_library() -> None:
    for name, (_, bits) in State402.SW_MASK.items():
        state = decode_statusword(bits)
        assert state.value.upper().removesuffix(" ACTIVE") == name.removesuffix(" ACTIVE"), name
        assert decode_statusword(bits | 0xFF90) == state, "bits that do not belong to the state"
    assert {ControlwordCommand(controlword) for controlword in State402.CW_CODE_COMMANDS} == set(
        ControlwordCommand
    )


def test_abort_codes_and_error_texts_equal_those_of_the_library() -> None:
    assert set(ABORTS) <= set(SdoAbortedError.CODES)
    for code in (0x2310, 0x3210, 0x4210, 0x8130):
        library_text = EmcyError(code, 0, b"", 0.0).get_desc().lower()
        assert library_text.split()[0] in describe_error(code) or library_text == "monitoring"


def test_bundled_eds_is_read_equally_by_the_library() -> None:
    library_objects = canopen.import_od(EDS, 5)
    our_eds = read_eds(EDS)
    for (index, sub), our_object in our_eds.objects.items():
        entry: Any = library_objects[index]
        variable: Any = entry if isinstance(entry, ODVariable) else entry[sub]
        assert our_object.size == SIZES[variable.data_type], variable.name
        assert our_object.mappable == variable.pdo_mappable, variable.name
        assert our_object.default_value(5) == (variable.default or 0), variable.name
    device: Any = library_objects.device_information
    assert (our_eds.vendor, our_eds.product) == (device.vendor_number, device.product_number)


def test_object_entries_of_driver_have_the_types_of_the_eds() -> None:
    library_objects = canopen.import_od(EDS, 5)
    for entry in vars(objects).values():
        if not isinstance(entry, objects.ObjectEntry):
            continue
        described: Any = library_objects[entry.index]
        variable: Any = described if isinstance(described, ODVariable) else described[entry.sub]
        assert (variable.data_type in (2, 3, 4)) == entry.format.islower(), entry.name
        assert SIZES[variable.data_type] == entry.size, entry.name


def test_library_reads_identity_and_limits_of_an_emulated_drive(master: LibraryMaster) -> None:
    sdo = master.node.sdo
    assert sdo[0x1000].raw & 0xFFFF == 402
    assert sdo["Identity object"]["Serial number"].raw == 0x4020_0001
    assert master.node.is_op_mode_supported("CYCLIC SYNCHRONOUS POSITION")
    rated_nm = sdo["Motor rated torque"].raw / 1000
    assert rated_nm * sdo["Max torque"].raw / 1000 == pytest.approx(CONFIG.robot.limits.torque_nm)
    with pytest.raises(SdoAbortedError) as refusal:
        sdo.download(0x6041, 0, b"\0\0")
    assert refusal.value.code == 0x0601_0002
    with pytest.raises(SdoAbortedError) as missing_object:
        sdo.upload(0x6099, 1)
    assert missing_object.value.code == 0x0602_0000


def test_library_enables_and_stops_an_emulated_drive(master: LibraryMaster) -> None:
    master.enable("CYCLIC SYNCHRONOUS TORQUE")
    assert master.drive.state == PowerState.ENABLED
    master.node.sdo["Target torque"].raw = 100
    master.pass_time(0.05)
    assert master.node.sdo["Torque actual value"].raw == pytest.approx(100, abs=10)
    master.node.controlword = ControlwordCommand.QUICK_STOP
    master.pass_time(0.5)
    assert master.drive.state == PowerState.SWITCH_ON_DISABLED
    assert master.node.sdo["Torque actual value"].raw == 0


def test_library_maps_pdos_and_receives_them_after_sync(master: LibraryMaster) -> None:
    node = master.node
    node.nmt.state = "PRE-OPERATIONAL"
    pdo = node.tpdo[1]
    pdo.read()
    pdo.clear()
    pdo.add_variable("Statusword")
    pdo.add_variable("Position actual value")
    pdo.trans_type = 1
    pdo.enabled = True
    pdo.save()
    node.nmt.state = "OPERATIONAL"
    received: list[int] = []
    pdo.add_callback(lambda mapping: received.append(mapping["Statusword"].raw))
    master.wire.network.sync.transmit()
    assert [decode_statusword(statusword) for statusword in received] == [
        PowerState.SWITCH_ON_DISABLED
    ]
    with pytest.raises(SdoAbortedError) as refusal:
        node.sdo[0x1A00][1].raw = 0x6041_0010
    assert refusal.value.code == 0x0800_0022, "a mapping in use"


def test_drive_without_heartbeats_stops_and_reports_an_emergency(master: LibraryMaster) -> None:
    node = master.node
    node.sdo[0x1016][1].raw = 127 << 16 | 100
    node.sdo["Abort connection option code"].raw = 1
    master.enable("CYCLIC SYNCHRONOUS POSITION")
    for _ in range(5):
        master.wire.network.send_message(0x700 + 127, b"\x05")
        master.pass_time(0.05)
    assert master.drive.state == PowerState.ENABLED
    master.pass_time(0.15)
    assert node.state == "FAULT"
    [error] = node.emcy.active
    assert (error.code, error.register) == (0x8130, 0x11)
    assert node.sdo["Error code"].raw == 0x8130
    node.sdo["Controlword"].raw = ControlwordCommand.ENABLE_OPERATION
    assert node.state == "FAULT", "only a fault reset ends it"
    node.sdo["Controlword"].raw = ControlwordCommand.FAULT_RESET
    assert node.state == "SWITCH ON DISABLED"
    assert node.emcy.active == []


class LibraryDrives:
    """Drives of the library that our driver configures and commands."""

    def __init__(self) -> None:
        self.wire = LibraryWire()
        joints = CONFIG.robot.joint_table
        self.nodes: list[Any] = [canopen.LocalNode(joint.id, EDS) for joint in joints]
        self.statuswords = [0x0040] * JOINTS
        for i, node in enumerate(self.nodes):
            self.wire.network.add_node(node)
            node.sdo["Identity object"]["Serial number"].raw = 7 + i
            node.sdo["Motor rated torque"].raw = 5000
            node.sdo["Motor rated current"].raw = 5000
            node.sdo["Max torque"].raw = 900
            node.sdo["Max motor speed"].raw = 3000
            node.sdo["Position encoder resolution"]["Encoder increments"].raw = 4096
            node.sdo["Statusword"].raw = 0x0040
            node.sdo["Error code"].raw = 0
        self.readings = DriveReadings(joints, lambda: 0)
        self.driver = Cia402Drives(
            CanDrivesContext(
                all_joints=joints,
                joints=joints,
                settings=Cia402Backend.Settings(),
                wire=self.wire,
                readings=self.readings,
                emulator=None,
                emulated=False,
                response_timeout_s=0.1,
                bring_up_timeout_s=2.0,
                cycle_ns=10_000_000,
                report_period_ns=100_000_000,
                clock_ns=lambda: 0,
            )
        )
        self.wire.on_sent = self._answer_sync

    def _answer_sync(self, frame: CanFrame) -> None:
        """Send the PDOs of all operational nodes after a SYNC."""
        if frame.id != SYNC_ID:
            return
        for i, node in enumerate(self.nodes):
            if node.nmt.state != "OPERATIONAL":
                continue
            node.tpdo.read()
            node.tpdo[1]["Statusword"].raw = self.statuswords[i]
            node.tpdo[1]["Position actual value"].raw = 1024
            node.tpdo[1]["Torque actual value"].raw = -500
            node.tpdo[2]["Velocity actual value"].raw = 2048
            node.tpdo[2]["Modes of operation display"].raw = 8
            node.tpdo[2]["Error code"].raw = 0
            node.tpdo[1].transmit()
            node.tpdo[2].transmit()


def test_our_driver_configures_drives_of_the_library() -> None:
    drives = LibraryDrives()
    drives.driver.bring_up()
    for node in drives.nodes:
        assert node.nmt.state == "OPERATIONAL"
        assert node.sdo[0x1016][1].raw == 127 << 16 | 100
        assert node.sdo["Producer heartbeat time"].raw == 100
        node.rpdo.read()
        mapped = {
            pdo.cob_id - node.id: [variable.name for variable in pdo] for pdo in node.rpdo.values()
        }
        assert mapped == {
            0x200: ["Controlword", "Target position", "Max torque"],
            0x300: ["Controlword", "Target velocity", "Max torque"],
            0x400: ["Controlword", "Target torque", "Max torque"],
            0x500: ["Modes of operation"],
        }
        assert [pdo.trans_type for pdo in node.rpdo.values()] == [255] * 4
        assert [node.tpdo[number].trans_type for number in (1, 2)] == [1, 1]
        assert not node.tpdo[3].enabled
    assert drives.readings.angle_rad == pytest.approx([1.5708] * JOINTS, abs=1e-4)
    assert drives.readings.velocity_rad_s == pytest.approx([3.1416] * JOINTS, abs=1e-4)
    assert drives.readings.torque_nm == pytest.approx([-2.5] * JOINTS)
    assert drives.readings.serials == ["00000000-00000402-00000007", "00000000-00000402-00000008"]


def test_our_setpoints_are_decoded_by_drives_of_the_library() -> None:
    drives = LibraryDrives()
    drives.driver.bring_up()
    received: list[tuple[int, ...]] = []
    node = drives.nodes[0]
    node.rpdo.read()
    node.rpdo[1].add_callback(lambda pdo: received.append(tuple(variable.raw for variable in pdo)))
    all_joints = frozenset(range(JOINTS))
    targets = drives.readings.angle_rad * 0 + 3.14159265
    limits = drives.readings.angle_rad * 0 + 2.0
    command = BusCommand(
        all_joints, [JointMode.POSITION] * JOINTS, targets, limits, may_enable=True, emergency=False
    )
    for statusword in (0x0040, 0x0021, 0x0023, 0x0027):
        drives.statuswords = [statusword] * JOINTS
        drives.readings.start_request()
        drives.driver.read()
        drives.driver.send_setpoints(command)
    controlwords = [values[0] for values in received]
    assert controlwords == [
        0x00,
        ControlwordCommand.SWITCH_ON,
        ControlwordCommand.ENABLE_OPERATION,
        ControlwordCommand.ENABLE_OPERATION,
    ]
    assert {values[1:] for values in received} == {(2048, 400)}
