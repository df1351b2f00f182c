"""The parameters of the controller `obstacle_aided`."""

from typing import Annotated

from msgspec import Meta

from snakesim_gnc.control.bumpless import Blend
from snakesim_gnc.control.progress import SpeedFilter
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import above, from_zero


class ObstacleAidedParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters. The bound of the look-ahead limits how hard the shape pushes."""

    speed_kp_s: Annotated[float, from_zero(5, "s")] = 0.2
    """Look-ahead of the shape for each m/s that the speed is too low."""

    integral_per_s: Annotated[float, from_zero(50, "1/s")] = 0.4
    """Rate at which the look-ahead grows while the speed stays too low."""

    max_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.05
    """Maximum look-ahead of the shape along its path. It limits how hard the shape pushes."""

    fresh_look_ahead_m: Annotated[float, from_zero(1, "m")] = 0.01
    """Look-ahead at the start of a new path."""

    push_scale: Annotated[float, Meta(ge=-1, le=1)] = 1.0
    """Factor of both pushing terms, for control experiments. Negative: backward."""

    push_sign_s: Annotated[float, from_zero(100, "s")] = 0.0
    """Time after which the sign of the push is drawn at random again, for control experiments. 0: never."""

    speed_kp_n_s_per_m: Annotated[float, from_zero(1000, "N*s/m")] = 25.0
    """Push on obstacles for each m/s that the speed is too low."""

    lag_kp_n_per_m: Annotated[float, from_zero(1000, "N/m")] = 60.0
    """Push on obstacles for each meter that the body has fallen behind."""

    max_push_n: Annotated[float, from_zero(1000, "N")] = 60.0
    """Maximum push along the path."""

    max_torque_nm: Annotated[float, from_zero(1000, "N*m")] = 5.0
    """Maximum torque of a joint for pushing."""

    max_contact_n: Annotated[float, above(1000, "N")] = 60.0
    """Maximum desired force on one contact."""

    reach_m: Annotated[float, above(1, "m")] = 0.03
    """Maximum gap between the body and an obstacle that is pushed."""

    contact_gap_scale_m: Annotated[float, above(1, "m")] = 0.005
    """Gap to an obstacle at which a contact counts half."""

    push_filter_s: Annotated[float, above(5, "s")] = 0.05
    """Time constant of the filter of how the push is shared among contacts."""

    torque_filter_s: Annotated[float, above(5, "s")] = 0.03
    """Time constant of the filter of the pushing torques."""

    search_after_s: Annotated[float, from_zero(1000, "s")] = 1.2
    """Time with less than 2 cm of advance after which the body searches for contacts by a wave. 0: never."""

    search_s: Annotated[float, above(1000, "s")] = 30.0
    """Duration of a search, after which the body tries its path again."""

    blend_s: Blend = 0.3
    """Time over which the command changes smoothly to a new reference."""

    speed_filter_s: SpeedFilter = 0.05
    """Time constant of the filter of the speed along the path. 0: no filter."""

    no_contact_cost: Annotated[float, from_zero(1000, "1")] = 10.0
    """Additional cost of a force on an obstacle without measured contact. 0: it costs as much as on others."""

    shape_nm_per_rad: Annotated[float, from_zero(1000, "N*m/rad")] = 1.5
    """Stiffness of the shape in torque mode. 0: always position mode, as stiff as the drives are."""

    shape_nm_s_per_rad: Annotated[float, from_zero(1000, "N*m*s/rad")] = 0.1
    """Damping of the shape in torque mode."""

    drive_damping: bool = False
    """True: the torques of torque mode are commanded as position targets, relative to the measured angles. The drives
    then resist fast bending, so that the shape may be stiffer.
    """

    front_correction_m: Annotated[float, from_zero(10, "m")] = 0.0
    """Distance over which the body ahead of all pushing contacts is led back to the path. 0: no such steering."""
