"""Judges the play of a gear from measured torques only."""

from dataclasses import replace

import pytest

from snakesim_operator.features.commissioning.joint_check.gear_play import (
    BESIDE_LOOSE_JOINT,
    LIGHT_END,
    MIN_CHANGE_NM,
    NO_CLEAR_LOAD,
    NO_REVERSAL,
    GearPlay,
    PlayKind,
    judge_gear_plays,
)
from snakesim_operator.features.commissioning.joint_check.load_response import (
    LoadResponse,
    PassedTorque,
    find_neighbors_of_same_axis,
)
from snakesim_operator.features.commissioning.joint_check.tooth_contact import ToothContact

JOINTS = 5
AXES = ["yaw"] * JOINTS
NOTHING_PASSED = PassedTorque(0.0, error_nm=0.001)
# These are typical measurements of emulated joints on a floor.
TIGHT = LoadResponse(
    small_motion_rad=0.011,
    large_range_nm=1.0,
    small_range_nm=0.4,
    elastic_nm=0.35,
    neighbor_large_range_nm=0.9,
    neighbor_small_range_nm=0.25,
    noise_nm=0.005,
    passed_in_small_motion=NOTHING_PASSED,
    passed_in_all_motions=NOTHING_PASSED,
    contact=ToothContact(
        friction_nm=0.02,
        load_threshold_nm=0.06,
        reversal_rad=0.005,
        unloaded_fraction=0.0,
        max_load_nm=0.2,
        unloaded_travel_rad=0.01,
    ),
)
NO_CONTACT = ToothContact(
    friction_nm=0.001,
    load_threshold_nm=0.03,
    reversal_rad=None,
    unloaded_fraction=1.0,
    max_load_nm=0.009,
    unloaded_travel_rad=0.02,
)
# The teeth touch at one end of the small motion: numbers of robots 100 (ODrive) and 140 (Dynamixel) of the trials.
ONE_END_CONTACTS = [
    ToothContact(
        friction_nm=0.001,
        load_threshold_nm=0.031,
        reversal_rad=None,
        unloaded_fraction=0.79,
        max_load_nm=0.102,
        unloaded_travel_rad=0.023,
    ),
    ToothContact(
        friction_nm=0.001,
        load_threshold_nm=0.037,
        reversal_rad=None,
        unloaded_fraction=0.50,
        max_load_nm=0.304,
        unloaded_travel_rad=0.0215,
    ),
]
BACKLASH = replace(
    TIGHT,
    small_range_nm=0.02,
    elastic_nm=-0.01,
    neighbor_small_range_nm=0.002,
    contact=NO_CONTACT,
)
SLIPPING = replace(
    TIGHT,
    large_range_nm=0.1,
    small_range_nm=0.06,
    elastic_nm=0.003,
    neighbor_large_range_nm=0.04,
    neighbor_small_range_nm=0.03,
    passed_in_small_motion=PassedTorque(0.013, error_nm=0.001),
    contact=NO_CONTACT,
)
HARDLY_LOADED = replace(
    SLIPPING, elastic_nm=0.007, neighbor_large_range_nm=0.025, neighbor_small_range_nm=0.02
)
# Torques with which the joints of the trial's robot turn their links, without weights and with 1 kg on each end link.
LIGHT_ENDS_NM = [0.008, 0.07, 0.19, 0.07, 0.008]
HEAVY_ENDS_NM = [0.06, 0.34, 0.68, 0.34, 0.06]
END_JOINT = 0
MIDDLE_JOINT = 2


def judge_play(response: LoadResponse | None, joint: int = MIDDLE_JOINT) -> GearPlay:
    """Judge one joint with this response among tight joints, which must be judged as tight."""
    responses: list[LoadResponse | None] = [TIGHT] * JOINTS
    responses[joint] = response
    plays = judge_gear_plays(responses, AXES, LIGHT_ENDS_NM)
    other_kinds = [play.kind for i, play in enumerate(plays) if i != joint]
    assert other_kinds == ["tight"] * (JOINTS - 1)
    return plays[joint]


def judge_among_tight(response: LoadResponse | None, joint: int = MIDDLE_JOINT) -> PlayKind:
    """Judge one joint among tight ones, and return only the kind of its play."""
    return judge_play(response, joint).kind


@pytest.mark.parametrize("joint", [END_JOINT, MIDDLE_JOINT])
def test_joint_whose_torque_follows_its_angle_is_tight(joint: int) -> None:
    assert judge_among_tight(TIGHT, joint) == "tight"


def test_tight_joint_has_at_most_the_backlash_that_its_reversal_hides() -> None:
    assert judge_play(TIGHT).max_backlash_rad == TIGHT.contact.reversal_rad


@pytest.mark.parametrize("joint", [END_JOINT, MIDDLE_JOINT])
def test_load_that_never_reverses_does_not_exclude_backlash(joint: int) -> None:
    """The teeth may touch on one side only, however well the torque follows the angle."""
    one_sided = replace(TIGHT, contact=replace(TIGHT.contact, reversal_rad=None))
    play = judge_play(one_sided, joint)
    assert play.kind == "unknown"
    assert joint == END_JOINT or play.reason == NO_REVERSAL


@pytest.mark.parametrize("contact", ONE_END_CONTACTS)
@pytest.mark.parametrize("elastic_nm", [0.05, 0.076, 0.345])
def test_joint_without_load_at_one_end_has_backlash(
    contact: ToothContact, elastic_nm: float
) -> None:
    response = replace(TIGHT, elastic_nm=elastic_nm, contact=contact)
    play = judge_play(response)
    assert play.kind == "backlash"
    assert play.min_backlash_rad == contact.unloaded_travel_rad
    assert judge_among_tight(response, END_JOINT) == "unknown"


@pytest.mark.parametrize(
    "changes",
    [
        {"unloaded_fraction": 0.15},  # the most of any sound joint of the trials with a fine torque
        {"max_load_nm": 0.05},  # too small to be sure
        {"friction_nm": 0.06, "load_threshold_nm": 0.1, "max_load_nm": 0.25},
        {"reversal_rad": 0.005},
    ],
)
def test_weak_evidence_at_one_end_is_no_backlash(changes: dict[str, float]) -> None:
    contact = replace(ONE_END_CONTACTS[0], **changes)
    assert judge_among_tight(replace(TIGHT, contact=contact)) in ("tight", "unknown")


@pytest.mark.parametrize("friction_nm", [0.0, 0.2])
def test_joint_without_load_in_the_small_motion_has_backlash(friction_nm: float) -> None:
    response = replace(
        BACKLASH,
        small_range_nm=BACKLASH.small_range_nm + 2 * friction_nm,
        large_range_nm=BACKLASH.large_range_nm + 2 * friction_nm,
    )
    assert judge_among_tight(response) == "backlash"


def test_joint_with_the_same_low_torque_in_both_motions_slips() -> None:
    assert judge_among_tight(SLIPPING) == "slipping"


@pytest.mark.parametrize("response", [BACKLASH, SLIPPING])
def test_joint_whose_torque_is_too_coarse_is_unknown(response: LoadResponse) -> None:
    assert judge_among_tight(replace(response, noise_nm=0.25)) == "unknown"


def test_joint_that_never_loads_coarse_neighbors_slips() -> None:
    response = replace(SLIPPING, neighbor_large_range_nm=0.09, neighbor_small_range_nm=0.0)
    assert judge_among_tight(response) == "slipping"


@pytest.mark.parametrize("neighbor_large_range_nm", [0.008, 0.09])
def test_joint_that_passes_no_load_is_loose(neighbor_large_range_nm: float) -> None:
    """The joint slips or has wide backlash, which loads the neighbors at most once, when the teeth touch."""
    response = replace(
        SLIPPING,
        neighbor_large_range_nm=neighbor_large_range_nm,
        neighbor_small_range_nm=0.007,
        passed_in_small_motion=NOTHING_PASSED,
    )
    assert judge_among_tight(response) == "loose"


@pytest.mark.parametrize(
    ("passed", "is_certain"),
    [
        (PassedTorque(0.013, error_nm=0.001), True),
        (PassedTorque(0.013, error_nm=0.01), False),
        (PassedTorque(0.002, error_nm=0.0001), False),
    ],
    ids=["clear", "within noise", "too small"],
)
def test_passed_torque_counts_only_above_noise_and_minimum(
    passed: PassedTorque, is_certain: bool
) -> None:
    assert passed.is_certain == is_certain


def test_joint_between_both_patterns_is_loose() -> None:
    response = replace(SLIPPING, neighbor_large_range_nm=0.2, neighbor_small_range_nm=0.06)
    assert judge_among_tight(response) == "loose"


@pytest.mark.parametrize("response", [BACKLASH, SLIPPING, HARDLY_LOADED])
def test_joint_at_an_end_is_unknown(response: LoadResponse) -> None:
    """Its only link may slide: an end joint without a fault had such a response on an emulated robot."""
    assert judge_among_tight(response, END_JOINT) == "unknown"


@pytest.mark.parametrize("end", [0, JOINTS - 1])
@pytest.mark.parametrize(
    ("response", "kind"),
    [
        (replace(TIGHT, contact=ONE_END_CONTACTS[0]), "backlash"),
        (BACKLASH, "backlash"),
        (SLIPPING, "slipping"),
        (TIGHT, "tight"),
    ],
    ids=["one end", "backlash", "slipping", "tight"],
)
def test_end_joint_with_a_weight_is_judged_like_others(
    response: LoadResponse, kind: PlayKind, end: int
) -> None:
    responses = [TIGHT] * JOINTS
    responses[end] = response
    kinds = [play.kind for play in judge_gear_plays(responses, AXES, HEAVY_ENDS_NM)]
    assert kinds.pop(end) == kind
    assert kinds == ["tight"] * (JOINTS - 1)


def test_last_yaw_joint_is_an_end_joint_also_before_a_pitch_joint() -> None:
    axes = [*AXES, "pitch"]
    responses = [*[TIGHT] * (JOINTS - 1), SLIPPING, TIGHT]
    light = judge_gear_plays(responses, axes, [*LIGHT_ENDS_NM, 0.008])
    weighted = judge_gear_plays(responses, axes, [*HEAVY_ENDS_NM, 0.06])
    assert light[JOINTS - 1] == GearPlay("unknown", LIGHT_END)
    assert weighted[JOINTS - 1].kind == "slipping"


def test_weighted_end_joint_with_a_coarse_torque_is_unknown() -> None:
    """The drive may report 0 up to a torque at which its link slides."""
    coarse = replace(SLIPPING, small_range_nm=0.0, noise_nm=2 * HEAVY_ENDS_NM[0])
    plays = judge_gear_plays([coarse, *[TIGHT] * (JOINTS - 1)], AXES, HEAVY_ENDS_NM)
    assert plays[0] == GearPlay("unknown", LIGHT_END)


def test_joint_with_load_at_one_end_beside_a_loose_joint_is_unknown() -> None:
    """The sound joint_3 of Dynamixel robot 9166 of the trials with weights was loaded so."""
    one_end = replace(TIGHT, contact=ONE_END_CONTACTS[0])
    plays = judge_gear_plays([TIGHT, SLIPPING, one_end, TIGHT, TIGHT], AXES, HEAVY_ENDS_NM)
    assert plays[1].kind == "slipping"
    assert plays[2] == GearPlay("unknown", BESIDE_LOOSE_JOINT)


@pytest.mark.parametrize("neighbor", [BACKLASH, SLIPPING])
def test_weighted_end_joint_beside_a_loose_joint_is_unknown(neighbor: LoadResponse) -> None:
    responses = [BACKLASH, neighbor, TIGHT, TIGHT, TIGHT]
    plays = judge_gear_plays(responses, AXES, HEAVY_ENDS_NM)
    assert plays[0] == GearPlay("unknown", BESIDE_LOOSE_JOINT)
    assert plays[1].kind in ("backlash", "slipping")


def test_end_joint_that_turns_with_enough_torque_to_slide_its_link_is_unknown() -> None:
    """The sound joint_1 of robot 29 of the trials turned with 0.93 times this torque in both directions."""
    sound = replace(SLIPPING, small_range_nm=2 * 0.93 * HEAVY_ENDS_NM[0])
    plays = judge_gear_plays([sound, *[TIGHT] * (JOINTS - 1)], AXES, HEAVY_ENDS_NM)
    assert plays[0] == GearPlay("unknown", LIGHT_END)


@pytest.mark.parametrize(
    ("neighbor_large_range_nm", "noise_nm", "kind"),
    [
        (1.1 * 2 * HEAVY_ENDS_NM[0], 0.005, "backlash"),
        (0.75 * 2 * HEAVY_ENDS_NM[0], 0.005, "loose"),  # a coupling may slip with this torque
        (1.1 * 2 * HEAVY_ENDS_NM[0], 0.03, "loose"),
    ],
    ids=["slides", "may slip", "noisy"],
)
def test_weighted_end_joint_whose_large_motion_slides_its_link_has_backlash(
    neighbor_large_range_nm: float, noise_nm: float, kind: PlayKind
) -> None:
    """A coupling that slips cannot slide the link. The link of joint_1 of robot 9248 slid, with half a typical load."""
    response = replace(
        BACKLASH,
        large_range_nm=0.17,
        small_range_nm=0.034,
        neighbor_large_range_nm=neighbor_large_range_nm,
        neighbor_small_range_nm=0.02,
        noise_nm=noise_nm,
    )
    plays = judge_gear_plays([response, *[TIGHT] * (JOINTS - 1)], AXES, HEAVY_ENDS_NM)
    assert plays[0].kind == kind


def test_joint_that_turns_with_enough_torque_to_slide_its_links_is_unknown() -> None:
    """The sound joint_2 of robot 9117 of the trials slid on a slippery floor, beside an encoder with a dead zone."""
    sound = replace(
        SLIPPING,
        small_range_nm=0.188,
        neighbor_large_range_nm=0.239,
        neighbor_small_range_nm=0.203,
    )
    plays = judge_gear_plays([TIGHT, sound, *[TIGHT] * (JOINTS - 2)], AXES, LIGHT_ENDS_NM)
    assert plays[1] == GearPlay("unknown", NO_CLEAR_LOAD)


@pytest.mark.parametrize("response", [BACKLASH, SLIPPING])
def test_joint_whose_load_reverses_is_not_loose(response: LoadResponse) -> None:
    """The sound joint_3 of robot 46 of the trials carried loads in both directions, which did not follow its angle."""
    reversing = replace(response, contact=TIGHT.contact, neighbor_small_range_nm=0.0)
    assert judge_among_tight(replace(reversing, neighbor_large_range_nm=0.9)) == "unknown"


def test_joint_that_carries_a_clear_load_is_not_loose() -> None:
    """The torque of the sound joint_3 of CiA 402 robot 9493 did not follow its angle, beside an encoder's dead zone."""
    loaded = replace(
        SLIPPING,
        neighbor_large_range_nm=0.2,
        neighbor_small_range_nm=0.06,
        contact=replace(NO_CONTACT, unloaded_fraction=0.0, max_load_nm=0.56),
    )
    assert judge_among_tight(loaded) == "unknown"


def test_joint_with_less_load_than_its_neighbors_has_no_backlash() -> None:
    """The coupling of joint_4 of robot 26 of the trials slipped. Its neighbors measured a load of the heavy ends."""
    response = replace(BACKLASH, large_range_nm=0.10, neighbor_large_range_nm=0.20)
    assert judge_among_tight(response) == "loose"


def test_weighted_end_joint_with_coarse_torque_does_not_leave_its_teeth() -> None:
    """The smallest load that can be proven could slide the link."""
    contact = replace(
        ONE_END_CONTACTS[0], load_threshold_nm=1.01 * HEAVY_ENDS_NM[0], max_load_nm=0.2
    )
    responses = [replace(TIGHT, contact=contact), *[TIGHT] * (JOINTS - 1)]
    plays = judge_gear_plays(responses, AXES, HEAVY_ENDS_NM)
    assert plays[0] == GearPlay("unknown", LIGHT_END)


def test_weighted_end_joint_beside_a_loose_joint_may_be_tight() -> None:
    responses = [TIGHT, BACKLASH, TIGHT, TIGHT, TIGHT]
    plays = judge_gear_plays(responses, AXES, HEAVY_ENDS_NM)
    assert plays[0].kind == "tight"


def test_joint_without_small_motion_is_unknown() -> None:
    assert judge_among_tight(None) == "unknown"


def test_joint_whose_torque_hardly_follows_its_angle_is_unknown() -> None:
    assert judge_among_tight(replace(TIGHT, elastic_nm=0.15 * TIGHT.elastic_nm)) == "unknown"


def test_pitch_joint_is_unknown() -> None:
    axes = ["yaw", "pitch", "yaw", "pitch", "yaw", "pitch", "yaw"]
    kinds = [play.kind for play in judge_gear_plays([TIGHT] * len(axes), axes, [0.1] * len(axes))]
    assert kinds == ["tight" if axis == "yaw" else "unknown" for axis in axes]


@pytest.mark.parametrize("response", [HARDLY_LOADED, BACKLASH, SLIPPING])
def test_robot_without_floor_load_is_unknown(response: LoadResponse) -> None:
    """The check does not judge a suspended robot, or a robot in which every joint is loose."""
    assert response.elastic_nm < MIN_CHANGE_NM
    plays = judge_gear_plays([response] * JOINTS, AXES, LIGHT_ENDS_NM)
    assert [play.kind for play in plays] == ["unknown"] * JOINTS


def test_load_that_may_be_noise_is_unknown() -> None:
    noisy = replace(TIGHT, noise_nm=TIGHT.elastic_nm)
    assert {play.kind for play in judge_gear_plays([noisy] * JOINTS, AXES, LIGHT_ENDS_NM)} == {
        "unknown"
    }


@pytest.mark.parametrize(("joint", "neighbors"), [(0, [2]), (1, [3]), (2, [0, 4]), (4, [2])])
def test_neighbors_have_the_same_axis(joint: int, neighbors: list[int]) -> None:
    axes = ["yaw", "pitch", "yaw", "pitch", "yaw"]
    assert find_neighbors_of_same_axis(axes, joint) == neighbors


def test_heavy_pitch_joints_do_not_change_verdict_of_yaw_joint() -> None:
    axes = ["yaw", "yaw", "pitch", "pitch", "yaw"]
    heavy = replace(TIGHT, elastic_nm=100.0)
    plays = judge_gear_plays([TIGHT, TIGHT, heavy, heavy, TIGHT], axes, LIGHT_ENDS_NM)
    assert plays[0].kind == "tight"
