"""Writes the diagrams of the documentation into docs/pictures: `python -m docs.site.diagrams`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from docs.site.drawing import Drawing, spread
from docs.site.gait_curves import draw_gait_curves
from docs.site.shape_template import make_shape_template

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"


@dataclass(frozen=True)
class Wiring:
    """The words in the picture of a robot's wiring."""

    title: str
    adapter: str
    bus: str
    drive: str
    ends: str  # at both ends of the bus; empty: none
    ports: str  # as they stand in a scenario
    power: str  # a note below the supply
    chained_power: bool = False  # the bus cable carries the power


WIRINGS = {
    "wiring-odrive.svg": Wiring(
        "Wiring of ODrive axes on CAN",
        "CAN adapter\nof python-can",
        "classic CAN, 1 Mbit/s, twisted pair with ground",
        "ODrive",
        "120 Ω",
        'channels = ["can0"]',
        "star or bars; absorbs the power\nthat braking returns",
    ),
    "wiring-moteus.svg": Wiring(
        "Wiring of moteus controllers on CAN FD",
        "CAN FD adapter\nof the kernel",
        "CAN FD, 1 and 5 Mbit/s, twisted pair without stubs",
        "moteus",
        "120 Ω",
        'channels = ["can0"]',
        "star or bars; absorbs the power\nthat braking returns",
    ),
    "wiring-cia402.svg": Wiring(
        "Wiring of CiA 402 drives on CANopen",
        "CAN adapter\nof python-can",
        "classic CAN, 1 Mbit/s, twisted pair with ground",
        "CiA 402",
        "120 Ω",
        'channels = ["can0"]',
        "star or bars; absorbs the power\nthat braking returns",
    ),
    "wiring-dynamixel.svg": Wiring(
        "Wiring of Dynamixel servos on a serial bus",
        "U2D2, or adapter\nfor TTL or RS-485",
        "RS-485 or TTL, 1 Mbit/s, with power in the same cable",
        "Dynamixel",
        "120 Ω (RS-485)",
        'ports = ["/dev/ttyUSB0"]',
        "fed in every few servos,\nabout 3 A for each connector",
        chained_power=True,
    ),
    "wiring-feetech.svg": Wiring(
        "Wiring of Feetech servos on a serial bus, with their supply behind a relay",
        "URT-1, or adapter\nfor TTL",
        "half-duplex TTL, 1 Mbit/s, with power in the same cable",
        "STS3215",
        "",
        'ports = ["/dev/ttyACM0"]',
        "behind the relay: without it\nservos hold if the host dies",
        chained_power=True,
    ),
    "wiring-joint-modules.svg": Wiring(
        "Wiring of joint modules on CAN",
        "CAN adapter\nof the kernel",
        "classic CAN, 1 Mbit/s, 60 Ω between the wires",
        "module",
        "120 Ω",
        'channels = ["can0"]',
        "the switch cuts the motors,\nnot the bus",
    ),
}


def draw_wiring(wiring: Wiring) -> Drawing:
    """Return a computer, its adapter, the drives on their bus, and the power with its switch."""
    drawing = Drawing(920, 330, wiring.title)
    drawing.box(
        20, 40, 170, 80, f"robot's computer\nsnakesim start host\n{wiring.ports}", "computer"
    )
    drawing.box(230, 45, 150, 70, wiring.adapter)
    drawing.line((190, 80), (230, 80))
    drawing.text(210, 72, "USB", anchor="middle")
    centers = [480.0, 595.0, 710.0, 835.0]
    drawing.line((380, 80), (900, 80), kind="bus")
    drawing.text(650, 30, wiring.bus, anchor="middle")
    for x in (400, 900):
        drawing.line((x, 68), (x, 92), kind="bus")
        drawing.text(min(x, 890), 60, wiring.ends.partition(" (")[0], anchor="middle")
    names = (("1", "joint_1, tail"), ("2", "joint_2"), ("3", "joint_3"), ("n", "head"))
    for x, (number, joint) in zip(centers, names, strict=True):
        drawing.line((x, 80), (x, 130), kind="bus")
        drawing.box(x - 54, 130, 108, 56, f"{wiring.drive} {number}\n{joint}", "drive")
    drawing.text(772, 163, "...", "t", "middle")
    fed = (centers[0], centers[2]) if wiring.chained_power else centers
    drawing.line((330, 265), (fed[-1], 265), kind="power")
    for x in fed:
        drawing.line((x, 265), (x, 186), kind="power")
    drawing.box(
        20,
        230,
        130,
        70,
        "motor supply\n" + ("in the bus cable" if wiring.chained_power else "one for all drives"),
    )
    drawing.line((150, 265), (175, 265), kind="power")
    drawing.box(175, 235, 155, 60, "emergency switch\nwithin reach", "stop")
    drawing.text(640, 290, wiring.power.replace("\n", " "), anchor="middle")
    return drawing


def draw_overview() -> Drawing:
    """Return the same controller in front of a simulator, of emulated drives and of real drives."""
    drawing = Drawing(
        920, 300, "One controller in front of a simulator, emulated drives or real drives"
    )
    drawing.box(20, 105, 170, 80, "your controller\nguidance, navigation\nand control", "yours")
    drawing.box(270, 105, 170, 80, "HAL host\nlease, lifecycle,\ncommand limiter", "computer")
    drawing.line((190, 145), (270, 145), arrow=True)
    drawing.text(230, 137, "Zenoh", anchor="middle")
    rows = (
        (20, "--backend sim", "MuJoCo simulator", "plain"),
        (
            118,
            "--backend odrive",
            "driver and emulated drives\nthe real protocol, no motor",
            "drive",
        ),
        (216, 'with channels = ["can0"]', "driver and real drives\nmotors move", "stop"),
    )
    for y, option, text, kind in rows:
        drawing.box(640, y, 260, 64, text, kind)
        drawing.line((440, 145), (480, 145), (480, y + 32), (640, y + 32), arrow=True)
        drawing.text(488, y + 24, option)
    return drawing


def draw_qualification() -> Drawing:
    """Return what takes part in the first hour with a drive: a host, a second program, the drive and the record."""
    drawing = Drawing(
        920,
        250,
        "Qualification of one drive: the command, the host, a second program and the record",
    )
    drawing.box(20, 70, 190, 80, "snakesim drive qualify\ninstructs and measures", "yours")
    drawing.box(300, 20, 190, 70, "HAL host\nlease, command limiter", "computer")
    drawing.box(300, 130, 190, 70, "second program\npolls the drive", "plain")
    drawing.box(680, 60, 210, 100, "one drive\nclamped,\ncurrent limited", "drive")
    drawing.line((210, 95), (255, 95), (255, 55), (300, 55), arrow=True)
    drawing.text(248, 46, "commands", anchor="middle")
    drawing.line((210, 125), (255, 125), (255, 165), (300, 165), arrow=True)
    drawing.line((490, 55), (585, 55), (585, 95), (680, 95), kind="bus")
    drawing.line((490, 165), (585, 165), (585, 125), (680, 125), kind="bus")
    drawing.text(585, 46, "setpoints", anchor="middle")
    drawing.text(585, 186, "status only", anchor="middle")
    drawing.line((115, 150), (115, 205), arrow=True)
    drawing.text(115, 226, "signed record of confirmed claims", anchor="middle")
    return drawing


def draw_mixed() -> Drawing:
    """Return a robot with drives of two types, on three buses."""
    drawing = Drawing(
        920,
        300,
        "One robot with ODrive axes on two CAN buses and Dynamixel servos on a serial port",
    )
    drawing.box(20, 110, 150, 80, "HAL host\nbackend mixed", "computer")
    rows = (
        (20, "can0", "ODrive", "joint_1 to joint_6", "100 Hz, thread of its own"),
        (118, "can1", "ODrive", "joint_7 to joint_11", "100 Hz, thread of its own"),
        (216, "/dev/ttyUSB0", "Dynamixel", "joint_12, joint_13", "50 Hz: decimation = 2"),
    )
    for y, port, driver, joints, rate in rows:
        drawing.line((170, 150), (210, 150), (210, y + 30), (250, y + 30))
        drawing.box(250, y, 220, 60, f'driver = "{driver.lower()}"\n{rate}')
        drawing.line((470, y + 30), (690, y + 30), kind="bus")
        drawing.text(580, y + 22, port, anchor="middle")
        drawing.box(690, y, 210, 60, f"{driver}\n{joints}", "drive")
    return drawing


def draw_cable() -> Drawing:
    """Return the travel of a joint: its limits, and how far its cable may be wound."""
    drawing = Drawing(
        920,
        200,
        "Travel of a joint without end stops: its limits, and cable_turns to either side of zero",
    )
    drawing.fill(120, 70, 680, 40, "far")
    drawing.fill(250, 70, 420, 40, "zone")
    for x, label, kind in (
        (120, "-cable_turns\n-0.6 turns", "power"),
        (250, "lower limit\n-0.5 turns", "bus"),
        (460, "zero", "a"),
        (670, "upper limit\n0.5 turns", "bus"),
        (800, "cable_turns\n0.6 turns", "power"),
    ):
        drawing.line((x, 60 if kind != "a" else 110), (x, 120), kind=kind)
        drawing.text(x, 142, label, "t", "middle")
    drawing.text(460, 95, "the controller moves the joint here", "t", "middle")
    drawing.text(185, 95, "by hand only", anchor="middle")
    drawing.text(735, 95, "by hand only", anchor="middle")
    drawing.text(110, 95, "not armed", anchor="end")
    drawing.text(810, 95, "not armed")
    drawing.text(460, 35, "turns of the joint, counted over restarts", "t b", "middle")
    return drawing


def draw_motion_capture() -> Drawing:
    """Return the way of a pose from the cameras to guidance."""
    drawing = Drawing(920, 210, "From the cameras over UDP to sensor/pose and guidance")
    drawing.box(20, 60, 150, 70, "cameras\nmarkers on link 0")
    drawing.box(230, 60, 170, 70, "capture system\nits own clock")
    drawing.box(500, 60, 170, 70, "HAL host\nchecks, age, offset", "computer")
    drawing.box(750, 60, 150, 70, "guidance\nworld model", "yours")
    drawing.line((170, 95), (230, 95), arrow=True)
    drawing.line((400, 95), (500, 95), arrow=True)
    drawing.text(450, 85, "UDP, JSON", anchor="middle")
    drawing.line((670, 95), (750, 95), arrow=True)
    drawing.text(710, 85, "sensor/pose", anchor="middle")
    drawing.text(450, 160, "timestamp_ns: when the frame\nwas captured", anchor="middle")
    drawing.text(710, 160, "timestamp_ns: robot time\nof the capture", anchor="middle")
    return drawing


def draw_driver() -> Drawing:
    """Return the layers of a driver: what an author writes, and what the kit does."""
    drawing = Drawing(920, 290, "What you write, and what the driver kit does")
    drawing.box(20, 20, 260, 60, "HAL host\nlease, lifecycle, command limiter", "computer")
    drawing.box(20, 115, 260, 60, "driver kit: DriveBackend\nages, silence, isolation, braking")
    drawing.box(20, 210, 260, 60, "driver kit: buses\none thread for each bus")
    drawing.line((150, 80), (150, 115), arrow=True)
    drawing.line((150, 175), (150, 210), arrow=True)
    drawing.box(400, 115, 240, 60, "DriverTypeBackend\nsettings, checks, which buses", "yours")
    drawing.box(400, 210, 240, 60, "Drives\nthe protocol on one bus", "yours")
    drawing.line((280, 145), (400, 145), arrow=True)
    drawing.line((280, 240), (400, 240), arrow=True)
    drawing.box(720, 185, 180, 50, "real drives", "drive")
    drawing.box(720, 245, 180, 40, "your emulator", "yours")
    drawing.line((640, 230), (680, 230), (680, 210), (720, 210), arrow=True)
    drawing.line((640, 250), (680, 250), (680, 265), (720, 265), arrow=True)
    drawing.text(520, 98, "green: you write it", "t b", "middle")
    return drawing


def draw_backend() -> Drawing:
    """Return the calls of a backend over the life of a run."""
    drawing = Drawing(
        920,
        250,
        "The calls of a backend: check, the constructor, then four calls a cycle, and close",
    )
    drawing.box(20, 90, 130, 70, "check\nbefore the run,\nopens nothing", "yours")
    drawing.box(180, 90, 130, 70, "__init__\nopens the robot", "yours")
    drawing.box(770, 90, 130, 70, "close\nmotors off", "yours")
    drawing.line((150, 125), (180, 125), arrow=True)
    names = (
        ("sample", "read joints\nand sensors"),
        ("enact", "send\nsetpoints"),
        ("advance", "let a period\npass"),
        ("faults", "report"),
    )
    for x, (name, text) in zip((350, 452, 554, 656), names, strict=True):
        drawing.box(x, 90, 90, 70, f"{name}\n{text}", "yours")
    drawing.line((310, 125), (350, 125), arrow=True)
    for x in (440, 542, 644):
        drawing.line((x, 125), (x + 12, 125), arrow=True)
    drawing.line((746, 125), (770, 125), arrow=True)
    drawing.line((701, 160), (701, 200), (395, 200), (395, 160), arrow=True)
    drawing.text(548, 220, "in every control cycle, within 4/5 of its period", "t", "middle")
    drawing.text(548, 70, "the host calls, in one thread", "t b", "middle")
    return drawing


def draw_start_up() -> Drawing:
    """Return the states of a drive from bring-up until the robot can be armed."""
    drawing = Drawing(920, 230, "A drive after bring-up: its steps, ready, and failed")
    drawing.box(20, 40, 170, 70, "bring_up\nfound, checked,\nnot enabled", "yours")
    drawing.box(250, 40, 170, 70, "first step\nstart, then is_done\nin every cycle", "yours")
    drawing.box(480, 40, 170, 70, "last step\nsuch as homing", "yours")
    drawing.box(710, 40, 190, 70, "ready\nthe robot can be armed", "computer")
    for x in (190, 420, 650):
        drawing.line((x, 75), (x + 60, 75), arrow=True)
    drawing.box(365, 150, 170, 60, "failed\nabort, then a fault", "stop")
    drawing.line((335, 110), (335, 165), (365, 165), arrow=True, kind="no")
    drawing.line((565, 110), (565, 165), (535, 165), arrow=True, kind="no")
    drawing.line((365, 195), (290, 195), (290, 110), arrow=True)
    drawing.line((805, 110), (805, 195), (535, 195), arrow=True, kind="no")
    drawing.text(280, 190, "after a reset,", "s", "end")
    drawing.text(280, 205, "all steps again", "s", "end")
    drawing.text(575, 145, "failed, or its time is over", "s", "start")
    drawing.text(795, 187, "invalidate: its position is lost", "s", "end")
    return drawing


def draw_contract() -> Drawing:
    """Return one suite of tests in front of many backends."""
    drawing = Drawing(920, 260, "One contract suite tests every backend")
    drawing.box(
        20, 90, 220, 80, "contract suite\none set of tests,\none set of tolerances", "computer"
    )
    backends = (
        ("sim", "plain"),
        ("can", "drive"),
        ("odrive, moteus, cia402", "drive"),
        ("dynamixel, mixed", "drive"),
        ("your backend", "yours"),
    )
    for y, (name, kind) in zip(spread(10, 210, 5), backends, strict=True):
        drawing.line((240, 130), (300, 130), (300, y + 20), (380, y + 20), arrow=True)
        drawing.box(380, y, 200, 40, name, kind)
        drawing.line((580, y + 20), (640, y + 20), (640, 130), (700, 130), arrow=y == 110)
    drawing.box(700, 90, 200, 80, "table of results\npassed, failed, or skipped\nwith its reason")
    return drawing


def draw_lab() -> Drawing:
    """Return two robots, a router, and three people with different rights."""
    drawing = Drawing(
        920,
        330,
        "Two robots, a router that checks certificates, and three people with different rights",
    )
    drawing.box(380, 20, 160, 290, "router\n\nchecks the\ncertificate of\neach process", "computer")
    robots = ((30, "anna"), (190, "bert"))
    for y, name in robots:
        drawing.box(690, y, 210, 50, f"host of {name}\nrole robot", "drive")
        drawing.box(690, y + 60, 210, 50, f"services of {name}\nrole gnc", "yours")
        drawing.line((690, y + 25), (540, y + 25), arrow=True)
        drawing.line((690, y + 85), (540, y + 85), arrow=True)
    drawing.box(20, 30, 200, 60, "operator of anna\narms, resets, stops")
    drawing.line((220, 60), (380, 60), arrow=True)
    drawing.text(300, 50, "anna", anchor="middle")
    drawing.box(20, 130, 200, 60, "viewer of both\nwatches, may stop")
    drawing.line((220, 160), (380, 160), arrow=True)
    drawing.text(300, 150, "watch and stop", anchor="middle")
    drawing.line((220, 185), (380, 185), kind="no", arrow=True)
    drawing.text(300, 203, "arm bert: refused", anchor="middle")
    drawing.box(20, 240, 200, 60, "no certificate", "stop")
    drawing.line((220, 270), (380, 270), kind="no", arrow=True)
    drawing.text(300, 260, "no connection", anchor="middle")
    return drawing


def draw_tour() -> Drawing:
    """Return the lessons of the tour in their order."""
    drawing = Drawing(
        920, 200, "The six lessons of the tour, from the first run to a controller that pushes"
    )
    lessons = (
        "first run",
        "explore\nand compare",
        "watch\nand change",
        "recover\nfrom faults",
        "a controller\nin 5 minutes",
        "a controller\nthat pushes",
    )
    kinds = ("plain", "plain", "computer", "stop", "yours", "yours")
    for number, (x, lesson, kind) in enumerate(
        zip(spread(10, 775, 6), lessons, kinds, strict=True)
    ):
        drawing.box(x, 60, 130, 70, f"{number + 1}\n{lesson}", kind)
        if number:
            drawing.line((x - 23, 95), (x, 95), arrow=True)
    for x, text in ((158, "run"), (396, "operate"), (780, "write")):
        drawing.text(x, 40, text, "t b", "middle")
    drawing.text(460, 165, "ten to twenty minutes each; stop after any of them", anchor="middle")
    return drawing


DIAGRAMS: dict[str, Callable[[], Drawing]] = {
    "hardware-overview.svg": draw_overview,
    "qualification.svg": draw_qualification,
    "mixed-buses.svg": draw_mixed,
    "cable-turns.svg": draw_cable,
    "motion-capture.svg": draw_motion_capture,
    "driver-layers.svg": draw_driver,
    "backend-calls.svg": draw_backend,
    "drive-start-up.svg": draw_start_up,
    "contract-suite.svg": draw_contract,
    "lab-roles.svg": draw_lab,
    "tour.svg": draw_tour,
    "gait-curves.svg": draw_gait_curves,
}


def make_diagrams() -> dict[Path, str]:
    """Return every diagram as it should be, by its path."""
    drawings = {name: draw() for name, draw in DIAGRAMS.items()}
    drawings |= {name: draw_wiring(wiring) for name, wiring in WIRINGS.items()}
    texts = {FOLDER / name: drawing.to_svg() for name, drawing in drawings.items()}
    return texts | {FOLDER / "shape-template.svg": make_shape_template()}


if __name__ == "__main__":
    for path, text in make_diagrams().items():
        path.write_text(text, encoding="utf-8")
