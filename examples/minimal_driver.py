"""A complete driver type to copy: replace what uses `body` by the protocol of your drives.

See docs/hardware/write-a-driver.md.

Here `body` is the body of a simulated robot, and so the drives obey at once. Try it:

snakesim run triplet --backend ./examples/minimal_driver.py:MinimalBackend --duration 3
"""

from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drive_settings import DriveSettings
from snakesim_drivers.kit.drive_type import DriverTypeBackend, group_by_port
from snakesim_drivers.kit.drives import Drives
from snakesim_hal.wire.messages import Mode


class MinimalDrives(Drives):
    """The drives of one bus; `Drives` describes every method."""

    emulated = True  # nothing real moves

    def __init__(self, body, readings, clock):
        self.body, self.readings, self.clock = body, readings, clock
        self.all_drives = range(len(body.joints))
        self.start_ns = clock.now_ns()

    def bring_up(self):
        for i in self.all_drives:
            self.readings.set_identity(i, serial=f"minimal-{i + 1}", firmware="1.0")

    def read(self):
        self.poll()
        for i in self.all_drives:
            if not self.body.is_silent(i):
                shaft = self.body.read_shaft(i)
                self.readings.set_motion(i, shaft.angle_rad, shaft.velocity_rad_s)
                self.readings.set_torque(i, shaft.torque_nm)
                self.readings.set_supply(i, *self.body.read_supply(i))
                self.readings.set_temperatures(i, *self.body.read_temperatures(i))
                self.readings.mark_checked(i)

    def send_setpoints(self, command):
        for i in self.all_drives:
            mode = command.modes[i] if i in command.following else Mode.PASSIVE
            motor, gear = self.body.joints[i].motor, self.body.joints[i].drive.gear
            damping = motor.velocity_gain_nm_s_per_rad if mode == Mode.VELOCITY else motor.damping_nm_s_per_rad
            stiffness, damping = motor.stiffness_nm_per_rad / gear**2, damping / gear**2
            speed_rad_s = self.body.joints[i].limits.speed_rad_s * gear
            self.body.drive_motor(i, mode, command.targets[i], command.limits_nm[i], stiffness, damping, speed_rad_s)

    def poll(self):
        with self.body.lock:
            self.body.advance_to((self.clock.now_ns() - self.start_ns) / 1000)

    def reset_faults(self, joints):
        pass  # these drives keep no errors and no settings

    def inject(self, injection, *, begins):
        if injection.kind not in FAULTS:
            return False
        self.body.inject(injection, begins=begins)
        return True

    def close(self):
        for i in self.all_drives:
            self.body.drive_motor(i, Mode.PASSIVE, 0.0, 0.0, 0.0, 0.0, 0.0)


class MinimalBackend(DriverTypeBackend):
    """The driver type; `DriverTypeBackend` describes every method."""

    Settings = DriveSettings  # a driver of real drives adds its ports
    name = "MinimalBackend"

    @classmethod
    def list_ports(cls, settings):
        return []

    @classmethod
    def list_bus_faults(cls, settings):
        return []

    @classmethod
    def check_drives(cls, config, settings, joints):
        pass

    @classmethod
    def plan_buses(cls, context):
        def open_drives(port, joints, readings):
            return MinimalDrives(context.body, readings, context.clock)

        return group_by_port(context.joints, context.settings, ["memory"], open_drives)
