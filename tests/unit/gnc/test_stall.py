"""Standing still: when it is noticed, and what it is put down to."""

import pytest

from snakesim_gnc.control.obstacle_triplet.stall import StallWatch, explain


def watch() -> StallWatch:
    return StallWatch(stall_m=0.005, stall_s=1.0, propulsion_n=35.0)


def stands_after(stall_watch, seconds, *, speed_m_s=0.0, force_n=35.0) -> float | None:
    for tick in range(round(seconds * 100) + 1):
        if stall_watch.stands(tick * 0.01, speed_m_s * tick * 0.01, force_n):
            return tick * 0.01
    return None


def test_standing_is_noticed_after_the_window():
    assert stands_after(watch(), 2.0) == pytest.approx(1.0)


def test_moving_or_not_pushing_is_no_stall():
    assert stands_after(watch(), 5.0, speed_m_s=0.006) is None
    assert stands_after(watch(), 5.0, force_n=17.0) is None


def test_forgetting_starts_a_new_window():
    stall_watch = watch()
    stands_after(stall_watch, 0.9)
    stall_watch.forget()
    assert stands_after(stall_watch, 0.9) is None


def cause(**more):
    known = {
        "force_n": 35.0,
        "contact_force_n": 20.0,
        "weight_n": 400.0,
        "saturated": None,
        "swung": None,
        "jam_force_n": 120.0,
        "drag_share": 0.5,
    }
    return explain(**{**known, **more})


def test_too_little_push_is_no_jam():
    stall = cause(force_n=2.0)
    assert not stall.jammed
    assert "too little against the friction" in stall.why


@pytest.mark.parametrize("force_n", [8.0, 35.0, 300.0])
def test_a_body_that_touches_nothing_is_not_jammed(force_n):
    stall = cause(force_n=force_n, contact_force_n=0.0, weight_n=40.0)
    assert not stall.jammed and "no obstacle touches the body" in stall.why


def test_without_a_sensor_of_contacts_the_rest_still_tells():
    assert cause(contact_force_n=None, weight_n=40.0).jammed
    assert "too little" in cause(contact_force_n=None, force_n=8.0).why


@pytest.mark.parametrize(
    ("known", "word"),
    [
        ({"contact_force_n": 300.0}, "300 N"),
        ({"saturated": "joint_7"}, "joint_7"),
        ({"weight_n": 40.0}, "of the weight"),
        ({"swung": "joint_5"}, "swings out"),
    ],
)
def test_a_jam_has_a_cause(known, word):
    stall = cause(**known)
    assert stall.jammed
    assert stall.why.startswith("jammed")
    assert word in stall.why
