"""Colors and layout of the page, and the camera from which a viewer sees the robot at first."""

import viser

from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import Vector
from snakesim_operator.features.console.web.admission import ControlAdmission

BRAND_COLOR = (0, 103, 176)
CAMERA_FOV_RAD = 0.75  # vertical field of view


def set_appearance(gui: viser.GuiApi, *, dark: bool) -> None:
    """Set colors and layout of the page, for one viewer or for all."""
    gui.configure_theme(
        dark_mode=dark,
        show_logo=False,
        show_share_button=False,
        control_width="large",
        brand_color=BRAND_COLOR,
    )


def add_appearance(client: viser.ClientHandle, admission: ControlAdmission, *, dark: bool) -> None:
    """Add a checkbox with which a viewer chooses a dark page; `dark` is the browser's preference, set at first."""
    checkbox = client.gui.add_checkbox("Dark page", initial_value=dark, order=2.5)
    admission.admit_control(checkbox, client.client_id)
    checkbox.on_update(lambda _: set_appearance(client.gui, dark=checkbox.value))
    set_appearance(client.gui, dark=dark)


def choose_camera_pose(robot: RobotDescription, *, narrow: bool) -> tuple[Vector, Vector]:
    """Return a camera position, and the point that it looks at, from which the whole body is in view.

    Args:
        robot: The robot to look at.
        narrow: The screen is that of a phone, whose lower half the panel covers.

    Returns:
        Position and target in m, relative to the middle of the body.
    """
    length_m = sum(link.length_m for link in robot.links)
    distance_m = 0.8 * length_m
    target_offset_m = 0.0
    if narrow:
        distance_m = 1.15 * length_m
        target_offset_m = 0.7 * length_m
    x, y = -0.49, -0.87  # unit vector from the body to the camera, seen from above
    target = x * target_offset_m, y * target_offset_m, 0.0
    position = target[0] + 1.3 * distance_m * x, target[1] + 1.3 * distance_m * y, 1.6 * distance_m
    return position, target


def aim_initial_camera(server: viser.ViserServer, robot: RobotDescription) -> None:
    """Set the camera with which pages begin, so that the whole robot is in view."""
    camera = server.initial_camera
    camera.position, camera.look_at = choose_camera_pose(robot, narrow=False)
    camera.fov = CAMERA_FOV_RAD


def aim_phone_camera(client: viser.ClientHandle, robot: RobotDescription) -> None:
    """Aim the camera of a phone; other screens use the initial camera."""
    camera = client.camera
    if camera.image_width < camera.image_height:
        camera.position, camera.look_at = choose_camera_pose(robot, narrow=True)
