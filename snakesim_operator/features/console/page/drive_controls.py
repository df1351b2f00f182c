"""The controls with which the viewer in control drives the robot: heading, speed, a button to hold, and keys."""

import math
import time
from collections.abc import Callable
from typing import Literal

import viser

from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion, yaw_from_rotation
from snakesim_operator.features.console.operations import BUTTON_VALIDITY_NS, KEY_VALIDITY_NS
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.web.admission import MAX_HOLD_AGE_S, ControlAdmission
from snakesim_operator.features.console.web.message_age import PageAction
from snakesim_operator.robot_commands.teleop.steering import (
    HEADING_STEP_RAD,
    compute_limited_heading,
)

HOLD_REPEAT_HZ = 10.0  # how often a page repeats that the button is held
MAX_SPEED_M_S = 0.5  # end of the speed slider
SLIDER_STEP_DEG = 5  # of the heading slider

DriveKey = Literal["I", "J", "K", "L"]
HOTKEY_BY_DRIVE_KEY: dict[str, DriveKey] = {  # viser uses the arrow keys to turn the view
    "Ahead": "I",
    "Backwards": "K",
    "Left": "J",
    "Right": "L",
}

# Sends an intent: heading_w_rad, speed_m_s, robot time of the viewer's action in ns, and validity from then on in ns.
SendIntent = Callable[[float, float, int, int], None]


class DriveControls:
    """The driving controls of one viewer.

    The thread that receives the viewer's messages calls `on_key` and `_on_button_held`, which must not wait.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        admission: ControlAdmission,
        is_in_control: Callable[[], bool],
        get_snapshot: Callable[[], RobotSnapshot | None],
        send_intent: SendIntent,
    ) -> None:
        """Add the controls to the viewer's page, in the folder that is open.

        Args:
            client: The viewer's page.
            admission: Filter that decides which messages of the page count.
            is_in_control: Returns whether this viewer has control.
            get_snapshot: Returns the newest snapshot; None while there is no robot.
            send_intent: Sends an intent to the robot.
        """
        self._is_in_control = is_in_control
        self._get_snapshot = get_snapshot
        self._send_intent = send_intent
        # The newest key that drove the robot.
        self._key_direction = 1  # 1: ahead, -1: backwards
        self._key_drive_time_s = -math.inf
        # The controls.
        gui = client.gui
        self._heading_slider = gui.add_slider("Heading, °", -180, 180, SLIDER_STEP_DEG, 0)
        self._speed_slider = gui.add_slider("Speed, m/s", 0.0, MAX_SPEED_M_S, 0.01, 0.1)
        self._drive_button = gui.add_button(
            "Hold to drive  (keys I, K; turn: J, L)", icon=viser.Icon.STEERING_WHEEL, color="green"
        )
        viewer = client.client_id
        admission.admit_control(self._heading_slider, viewer, is_in_control)
        admission.admit_control(self._speed_slider, viewer, is_in_control)
        admission.admit_control(
            self._drive_button,
            viewer,
            is_in_control,
            HOLD_REPEAT_HZ,
            handler=self._on_button_held,
            max_age_s=MAX_HOLD_AGE_S,
        )
        # The page repeats that the button is held only if viser has a callback for it. `_on_button_held` gets the
        # messages, and motion ends without them.
        self._drive_button.on_hold(lambda _: None, callback_hz=HOLD_REPEAT_HZ)

    def set_visible(self, visible: bool) -> None:
        """Show or hide the controls."""
        for control in (self._heading_slider, self._speed_slider, self._drive_button):
            control.visible = visible

    def steer_straight_on(self) -> None:
        """Set the heading slider to the direction of the body, so that a robot that is driven next does not turn."""
        yaw_w_rad = self._find_body_yaw_w_rad()
        if yaw_w_rad is not None:
            self._heading_slider.value = _round_to_slider_deg(yaw_w_rad)

    def _on_button_held(self, _viewer: int, action: PageAction) -> None:
        self._send_drive_intent(self._speed_slider.value, BUTTON_VALIDITY_NS, action)

    def on_key(self, key_name: str, action: PageAction) -> None:
        """Drive or steer, because a drive key was pressed or its keyboard repeats it.

        A keyboard repeats only the key that was pressed last. So Left and Right keep the robot going if a key drove it
        a short time ago, and only change the heading otherwise.

        Args:
            key_name: A key of HOTKEY_BY_DRIVE_KEY.
            action: The time of the press; a press older than MAX_HOLD_AGE_S is ignored.
        """
        if not self._is_in_control() or action.age_s > MAX_HOLD_AGE_S:
            return
        now_s = time.monotonic()
        match key_name:
            case "Ahead":
                self._key_direction = 1
            case "Backwards":
                self._key_direction = -1
            case _:
                self._change_heading(HEADING_STEP_RAD if key_name == "Left" else -HEADING_STEP_RAD)
                is_driving = now_s - self._key_drive_time_s <= KEY_VALIDITY_NS * 1e-9
                if not is_driving:
                    return
        self._key_drive_time_s = now_s
        self._send_drive_intent(
            self._key_direction * self._speed_slider.value, KEY_VALIDITY_NS, action
        )

    def _send_drive_intent(self, speed_m_s: float, valid_ns: int, action: PageAction) -> None:
        """Send the robot an intent, valid from the last moment at which the viewer is known to have acted.

        Without such a moment the robot gets nothing, because the message may be of any age.
        """
        if action.robot_ns is None or not self._is_in_control():
            return
        self._send_intent(self._heading_w_rad, speed_m_s, action.robot_ns, valid_ns)

    def _change_heading(self, step_rad: float) -> None:
        """Change the heading by a step."""
        heading_w_rad = compute_limited_heading(
            self._heading_w_rad, step_rad, self._find_body_yaw_w_rad()
        )
        self._heading_slider.value = _round_to_slider_deg(heading_w_rad)

    @property
    def _heading_w_rad(self) -> float:
        return math.radians(self._heading_slider.value)

    def _find_body_yaw_w_rad(self) -> float | None:
        snapshot = self._get_snapshot()
        if snapshot is None or snapshot.base is None:
            return None
        _, orientation_wxyz = snapshot.base
        return yaw_from_rotation(rotation_from_quaternion(orientation_wxyz))


def _round_to_slider_deg(angle_rad: float) -> int:
    """Return an angle in degrees, rounded to a step of the heading slider."""
    return SLIDER_STEP_DEG * round(math.degrees(angle_rad) / SLIDER_STEP_DEG)
