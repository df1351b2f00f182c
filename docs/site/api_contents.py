"""Which classes and functions are on which page of the Python API, with a text and an example for each page."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Page:
    """One page: a topic with the names that belong to it."""

    file: str
    title: str
    introduction: str
    example: str  # Python; empty: a docstring has it
    names: dict[str, tuple[str, ...]]  # by the module from which a user imports them
    module_text: str = ""  # module whose docstring follows the introduction


BACKEND_EXAMPLE = """\
from snakesim_hal.backend import Backend, Samples
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.robot import describe_robot
from snakesim_hal.wire.messages import JointState


class Settings(FileStruct, frozen=True):
    pass


class StillBackend(Backend):
    \"\"\"A robot whose joints never move.\"\"\"

    Settings = Settings

    @classmethod
    def check(cls, config, settings):
        return ("lockstep", "realtime")

    def __init__(self, config, settings):
        self.joints = config.robot.chain.modules
        self.description = describe_robot(config.robot, backend="still", period_ns=config.period_ns)

    def describe(self):
        return self.description

    def sample(self, tick, timestamp_ns):
        zeros = [0.0] * self.joints
        ages_ns = [0] * self.joints
        return Samples(
            JointState(
                tick=tick,
                timestamp_ns=timestamp_ns,
                angle_rad=zeros,
                velocity_rad_s=zeros,
                torque_nm=zeros,
                valid=[True] * self.joints,
                age_ns=ages_ns,
            )
        )

    def enact(self, setpoints, lifecycle):
        pass

    def advance(self):
        pass

    def close(self):
        pass
"""
SERVICE_EXAMPLE = """\
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointState


class Watch(Service):
    \"\"\"Prints the angle of the first joint, and publishes nothing.\"\"\"

    name = "watch"

    def __init__(self, client, config):
        self.client = client
        self.joints = client.subscribe(keys.JOINTS, JointState)

    def outputs(self, clock):
        joints = self.client.read(self.joints)
        if joints is None:
            return None
        print(f"{joints.angle_rad[0]:.3f} rad")
        return []
"""
SENSOR_EXAMPLE = """\
from typing import Annotated

from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.wire.messages import CustomSample
from snakesim_hal.wire.quantities import bounded, describe
from snakesim_sim_backend.sensors.mount import SensorMount


class Height(CustomSample, frozen=True, kw_only=True):
    height_m: Annotated[float, bounded(-100, 100, "m"), describe("of the sensor above the ground")]


class HeightModel(SensorModel):
    message = Height

    def __init__(self, sensor, scope, settings):
        self.mount = SensorMount(sensor, scope)

    def read(self, tick, timestamp_ns):
        position_w, _ = self.mount.place()
        return Height(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self.mount.link,
            position_l=self.mount.position_l,
            orientation_l_wxyz=self.mount.orientation_l_wxyz,
            height_m=float(position_w[2]),
        )
"""
DRIVER_EXAMPLE = """\
from snakesim_drivers.kit.drive_settings import DriveSettings
from snakesim_drivers.kit.drive_type import DriverTypeBackend, make_bus_specs_by_port


class MySettings(DriveSettings, frozen=True, kw_only=True):
    ports: list[str] = []


class MyBackend(DriverTypeBackend):
    name = "my_drives"
    Settings = MySettings
    supported_modes = ("position", "torque")

    @classmethod
    def list_ports(cls, settings):
        return settings.ports

    @classmethod
    def list_bus_faults(cls, settings):
        return ()

    @classmethod
    def check_drives(cls, config, settings, joints):
        pass

    @classmethod
    def plan_buses(cls, context):
        def open_drives(port, indices, readings):
            raise NotImplementedError("return your subclass of Drives")

        ports = context.settings.ports or ["memory"]  # without ports: emulated in this process
        return make_bus_specs_by_port(context.joints, context.settings, ports, open_drives)
"""

PAGES = (
    Page(
        "python.md",
        "snakesim",
        "Run scenarios, read their results, and command a running robot. [Use SnakeSIM from Python]"
        "(../../how-to/python.md) explains the same by task. Names are loaded when they are first used.",
        'import snakesim\n\nresult = snakesim.run("triplet", duration=2, seed=1)\n'
        "print(f\"{result.metrics['advance_m']:.2f} m, digest {result.digest[:16]}\")\n"
        'print(result["angle_rad.joint_7"].max(), result.units["angle_rad"])\n',
        {
            "snakesim": (
                "run",
                "load",
                "Result",
                "Robot",
                "compute_body_points_w",
                "use_common_arithmetic",
            ),
            "snakesim.chart": ("Chart",),
            "snakesim_operator.robot_commands.parameters": ("RobotParameter",),
        },
    ),
    Page(
        "errors.md",
        "Errors",
        "Every error of SnakeSIM derives from `SnakesimError` and also from the matching exception of Python. Each has "
        "a stable `code`, which [errors and faults](../errors.md) explains.",
        'import snakesim\n\ntry:\n    snakesim.run("tripplet")\nexcept snakesim.ConfigError as error:\n'
        "    print(error.code)\n",
        {
            "snakesim": (
                "SnakesimError",
                "ConfigError",
                "NotConnectedError",
                "RefusedError",
                "StalledError",
                "ControllerError",
            ),
            "snakesim_hal.base.errors": ("ServiceError", "BackendError", "WireError"),
        },
    ),
    Page(
        "environments.md",
        "Environments",
        "Scenarios as [Gymnasium](https://gymnasium.farama.org) environments. [Gymnasium environments]"
        "(../../how-to/environments.md) shows how to use them, and [Environments](../environments.md) lists names, "
        "observations and rewards. Needs the extra `gym`.",
        "import gymnasium\n\nimport snakesim.environments\n\n"
        'env = gymnasium.make("SnakeSIM/PegRow-v0", action="velocity", frame_skip=5)\n'
        "observation, info = env.reset(seed=1)\n"
        "observation, reward, terminated, truncated, info = env.step(env.action_space.sample())\nenv.close()\n",
        {"snakesim.environments": ("SnakeEnv", "SnakeVectorEnv")},
    ),
    Page(
        "controller.md",
        "Controller",
        "A controller gets one observation in each control cycle, and returns setpoints for every joint. "
        "[Write a controller](../../tutorials/write-a-controller.md) is the tutorial, and [controllers]"
        "(../controllers.md) lists the shipped ones.",
        "",
        {
            "snakesim": (
                "Controller",
                "Observation",
                "ControllerCommand",
                "Telemetry",
                "Parameters",
                "make_position_setpoints",
            ),
            "snakesim_hal.controller": ("SensorSamples", "Task"),
            "snakesim_hal.wire.setpoints": ("RequestedSetpoints",),
            "snakesim_hal.wire.messages": (
                "JointMode",
                "JointState",
                "WorldModel",
                "WorldContact",
                "Trajectory",
            ),
        },
    ),
    Page(
        "backend.md",
        "Backend",
        "A backend is a robot, real or simulated. Use this interface for a simulator, or for a robot with an interface "
        "of its own. [Write a backend](../../hardware/write-a-backend.md) explains the steps.",
        BACKEND_EXAMPLE,
        {
            "snakesim_hal.backend": ("Backend", "Samples", "SafeSetpoints"),
            "snakesim_hal.model.robot_file.robot": ("describe_robot",),
            "snakesim_hal.wire.messages": ("Fault",),
        },
        "snakesim_hal.backend",
    ),
    Page(
        "service.md",
        "Service",
        "A service reads messages of a robot and publishes others, in step with the robot's clock. "
        "[Write a service](../../how-to/write-a-service.md) has a complete example with motion capture.",
        SERVICE_EXAMPLE,
        {
            "snakesim_hal.service": ("Service",),
            "snakesim_hal.network.client": ("HostClient",),
        },
    ),
    Page(
        "sensor.md",
        "Sensor",
        "A sensor model simulates a sensor that is mounted on a link. [Write a custom sensor]"
        "(../../how-to/custom-sensors.md) explains the steps.",
        SENSOR_EXAMPLE,
        {
            "snakesim_hal.model.robot_file.sensor_model": ("SensorModel",),
            "snakesim_hal.wire.messages": ("CustomSample",),
            "snakesim_hal.wire.quantities": ("bounded", "above", "from_zero", "describe"),
            "snakesim_sim_backend.sensors.scope": ("SensorScope",),
            "snakesim_sim_backend.sensors.mount": ("SensorMount",),
            "snakesim_sim_backend.sensors.rays": ("RayBundle",),
        },
    ),
    Page(
        "driver-kit.md",
        "Driver kit",
        "The driver kit turns the protocol of your drives into a complete backend. You derive from `Drives` and from "
        "`DriverTypeBackend`. [Write a driver](../../hardware/write-a-driver.md) explains the steps, and "
        "[`examples/minimal_driver.py`](../../../examples/minimal_driver.py) is a complete driver type.",
        DRIVER_EXAMPLE,
        {
            "snakesim_drivers.kit.drives": ("Drives", "BusCommand"),
            "snakesim_drivers.kit.drive_type": (
                "DriverTypeBackend",
                "DriverTypeContext",
                "make_bus_specs_by_port",
            ),
            "snakesim_drivers.kit.bus": ("BusSpec",),
            "snakesim_drivers.kit.drive_settings": ("DriveSettings", "compute_response_timeout_s"),
            "snakesim_drivers.kit.start_up": ("StartUp", "StartUpStep", "StepFailedError"),
            "snakesim_drivers.kit.holding_brakes": ("HoldingBrakes", "BrakePlan"),
            "snakesim_drivers.kit.limit_switches": ("LimitSwitches",),
            "snakesim_drivers.kit.findings": ("FaultFinding",),
            "snakesim_drivers.kit.readings": ("DriveReadings",),
            "snakesim_drivers.kit.drive_states": ("DriveStates", "DriveState"),
            "snakesim_drivers.kit.drive_probe": ("DriveProbe", "DriveStatus", "ReadBack"),
            "snakesim_drivers.emulation.drive_emulator": ("DriveEmulator",),
            "snakesim_drivers.emulation.emulated_body": ("EmulatedBody",),
        },
        "snakesim_drivers.kit.drives",
    ),
)
# Public by name, for other packages of this project; not for users.
INTERNAL = {
    "snakesim_hal.controller": (
        "NoParameters",
        "ParametersT",
        "decode_parameters",
        "load_controller",
        "is_motion_requested",
    ),
    "snakesim_hal.service": ("ServiceLoop",),
    "snakesim_hal.model.robot_file.sensor_model": ("NoSettings",),
    "snakesim_drivers.kit.drive_type": ("BusesBackend", "DriverTypePart"),
    "snakesim.environments": ("SCENARIOS",),
}
COMPLETE_MODULES = (
    "snakesim",
    "snakesim.environments",
    "snakesim_hal.backend",
    "snakesim_hal.controller",
    "snakesim_hal.service",
    "snakesim_hal.model.robot_file.sensor_model",
    "snakesim_drivers.kit.drives",
    "snakesim_drivers.kit.drive_type",
)
