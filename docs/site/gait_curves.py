"""The picture of the body curves of all gaits, drawn by the functions that the controllers use."""

import math

import numpy as np

from docs.site.drawing import Drawing
from snakesim_gnc.control.gaits.backbones import (
    BackboneSidewindingParameters,
    compute_arc,
    compute_helix,
)
from snakesim_gnc.control.gaits.concertina import ConcertinaParameters, compute_fold_fractions
from snakesim_gnc.control.gaits.rectilinear import RectilinearParameters
from snakesim_gnc.control.gaits.serpenoid import SerpenoidParameters, compute_serpenoid_headings
from snakesim_gnc.control.gaits.sinus_lifting import SinusLiftingParameters

LENGTH_PX = 250.0  # of a body that is straight
POINTS = 120
ENLARGED = 5.0  # heights of sinus-lifting
PLACES = np.linspace(0.0, 1.0, POINTS)  # from the tail
MIDDLES_FROM_HEAD = 1.0 - 0.5 * (PLACES[1:] + PLACES[:-1])


def draw_gait_curves() -> Drawing:
    """Return six curves, of each the body at three phases, with its head to the right."""
    drawing = Drawing(
        920, 520, "Body curves of six gaits at three phases each, the head to the right"
    )
    panels = (
        ("serpenoid, cpg", "from above", _list_serpenoid()),
        ("concertina", "from above: transfer, draw, extend", _list_concertina()),
        ("rectilinear", "from the side", _list_rectilinear()),
        ("sinus_lifting", "from the side, heights enlarged 5 times", _list_lifts()),
        ("backbone_sidewinding", "from above, and the height", _list_helix()),
        ("backbone_rolling", "from above: the arc stays, the body turns", _list_arc()),
    )
    for number, (name, view, curves) in enumerate(panels):
        left = 40.0 + 300.0 * (number % 3)
        top = 30.0 + 255.0 * (number // 3)
        drawing.text(left, top, name, "t b")
        drawing.text(left, top + 18.0, view)
        for row, curve in enumerate(curves):
            middle = top + 62.0 + 62.0 * row if len(curves) > 1 else top + 100.0
            x, y = curve
            y = y - 0.5 * (y.max() + y.min())
            points = [
                (round(left + LENGTH_PX * a, 1), round(middle - LENGTH_PX * b, 1))
                for a, b in zip(x, y, strict=True)
            ]
            drawing.line(*points, kind="bus")
            head_x, head_y = points[-1]
            drawing.box(head_x - 4.0, head_y - 4.0, 8.0, 8.0, "", "stop")
    return drawing


def _integrate(headings_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of a curve in body lengths, from the headings between its points."""
    step = np.diff(PLACES)
    x = np.concatenate(([0.0], np.cumsum(step * np.cos(headings_rad))))
    y = np.concatenate(([0.0], np.cumsum(step * np.sin(headings_rad))))
    return x, y


def _list_serpenoid():
    p = SerpenoidParameters()
    phases = (0.0, math.tau / 3, 2 * math.tau / 3)
    return [
        _integrate(
            compute_serpenoid_headings(MIDDLES_FROM_HEAD, phase, p.winding_angle_rad, p.wavelength)
        )
        for phase in phases
    ]


def _list_concertina():
    p = ConcertinaParameters()
    curves = []
    for phase in (math.tau / 6, math.tau / 2, 5 * math.tau / 6):
        front, rear = compute_fold_fractions(phase)
        folded = np.sqrt(np.where(MIDDLES_FROM_HEAD < 0.5, front, rear))
        waves = np.sin(2 * math.tau * p.folds * MIDDLES_FROM_HEAD)
        curves.append(_integrate(p.winding_angle_rad * folded * waves))
    return curves


def _list_rectilinear():
    p = RectilinearParameters()
    phases = (0.0, math.tau / 3, 2 * math.tau / 3)
    return [
        _integrate(p.slope_rad * np.cos(phase + math.tau * MIDDLES_FROM_HEAD / p.wavelength))
        for phase in phases
    ]


def _list_lifts():
    p = SinusLiftingParameters()
    curves = []
    for phase in (0.0, math.tau / 6, math.tau / 3):
        u = phase - math.tau * MIDDLES_FROM_HEAD / p.wavelength
        x, z = _integrate(p.lift_slope_rad * np.sin(2.0 * u))
        curves.append((x, ENLARGED * z))
    return curves


def _list_helix():
    p = BackboneSidewindingParameters()
    nodes = compute_helix(PLACES, 1.0, p, 0.0).node_positions
    later = compute_helix(PLACES, 1.0, p, math.tau / 3).node_positions
    left = nodes[0, 0]
    return [
        (nodes[:, 0] - left, nodes[:, 1]),
        (later[:, 0] - left, later[:, 1]),
        (nodes[:, 0] - left, nodes[:, 2]),
    ]


def _list_arc():
    nodes = compute_arc(PLACES, 1.0, 2.2, 0.0).node_positions
    return [(nodes[:, 0] - nodes[0, 0], nodes[:, 1])]
