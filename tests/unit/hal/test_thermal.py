"""Heat: how fast it comes, what it takes from the torque, and that torque fades before the module gives up."""

import numpy as np
import pytest

from snakesim_hal import thermal
from snakesim_hal.thermal import Thermal


def test_half_of_rated_torque_is_held_for_ever_at_80_degrees() -> None:
    heat = Thermal(1, 4.0)
    heat.pass_time(3600.0, np.array([2.0**2]))
    assert heat.winding_c[0] == pytest.approx(80.0)
    assert heat.share_left()[0] == pytest.approx(1.0)


def test_it_is_exact_whatever_the_step() -> None:
    fine, coarse = Thermal(1, 4.0), Thermal(1, 4.0)
    for _ in range(1000):
        fine.pass_time(0.01, np.array([9.0]))
    coarse.pass_time(10.0, np.array([9.0]))
    assert fine.winding_c == pytest.approx(coarse.winding_c)
    assert coarse.winding_c[0] == pytest.approx(20 + 240 * 9 / 16 * (1 - np.exp(-10 / 60)))


@pytest.mark.parametrize(("celsius", "share"), [(20, 1.0), (80, 1.0), (90, 0.6), (100, 0.2), (120, 0.2)])
def test_derating_is_linear(celsius: float, share: float) -> None:
    heat = Thermal(1, 4.0)
    heat.winding_c[:] = celsius
    assert heat.share_left()[0] == pytest.approx(share)


def test_a_motor_at_stall_fades_and_never_overheats() -> None:
    heat = Thermal(1, 4.0)
    shares: list[float] = []
    for _ in range(60_000):
        shares.append(heat.share_left()[0])
        heat.pass_time(0.01, np.array([(4.0 * shares[-1]) ** 2]))
    assert np.abs(np.diff(shares)).max() < 0.01
    assert heat.winding_c[0] < thermal.OVERHEAT_C - 5 and shares[-1] < 0.8


def test_injected_heat_stays_only_while_it_is_held() -> None:
    heat = Thermal(2, 4.0)
    heat.inject(0, heat=True, hold=False)
    heat.inject(1, heat=True, hold=True)
    heat.pass_time(30.0, np.zeros(2))
    assert heat.winding_c[0] < 80 and heat.winding_c[1] == thermal.INJECTED_C
    heat.inject(1, heat=False, hold=False)
    heat.pass_time(30.0, np.zeros(2))
    assert heat.winding_c[1] < 80


def test_a_warm_module_at_work_takes_more_from_its_supply() -> None:
    assert thermal.board_c(20.0) == 20.0 and thermal.board_c(80.0) == pytest.approx(38.0)
    assert thermal.current_a(0.0, 5.0, 4.0, 24.0) == 0.05
    assert thermal.current_a(4.0, 0.0, 4.0, 24.0) == pytest.approx(0.05 + 2.0)
    both = thermal.current_a(np.array([2.0, -2.0]), np.array([3.0, 3.0]), 4.0, 24.0)
    assert both == pytest.approx([0.05 + 18.0 / 24.0, 0.05 + 6.0 / 24.0])
