"""The snake seen from above at one instant: body to scale, route, obstacles, forces (Fig. 7-10)."""

import math

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene import Placed
from snakesim_hal.wire.messages import Obstacle, WorldContact
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import Balance, Instant
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.polygon import with_subscript
from snakesim_operator.results.report.svg import (
    arrow,
    element,
    figure,
    points_text,
    polyline,
    round_below,
    scale_bar,
    text,
    text_width,
    title,
)
from snakesim_operator.results.report.view import EDGE, FELT_SHARE, FOOT, LONGEST_ARROW, View, nodes_xy_w, reach_m

MAX_POINTS = 1500  # of the route
ROUND = 12  # corners of a circle
LARGEST_TEXT = 25.0  # of a scale's label on a phone, in page.css
BETWEEN_SCALES = 40.0


def top_view(record: RunRecord, instant: Instant, view: View) -> str:
    """The drawing of one instant."""
    nodes, joint = nodes_xy_w(record, instant.row), instant.propulsion_joint
    labels = Labels(view.width, view.height - FOOT)
    parts = [ground(record, view, labels), body(record, view, nodes, labels)]
    parts += [_felt(contact, view, labels) for contact in instant.felt]
    parts.append(_solved(instant, view, labels))
    what = f"Top view at {instant.time_s:.2f} s"
    if joint is not None:
        name, at = record.description.joints[joint].name, view.at(nodes[joint + 1])
        what += f", {name} propels"
        fill = f"fill:var(--joint-{joint})"
        parts.append(element("circle", cx=at[0], cy=at[1], r=6.5, class_="propelling", style=fill))
        parts.append(labels.place_label(at, name, "halo strong", gaps=(16, 22, 30, 40)))
    if instant.balance is not None:
        parts += [_push_point(i, instant.balance, view, labels) for i in range(len(instant.balance.contacts))]
    for end, word in ((nodes[0], "tail"), (nodes[-1], "head")):
        parts.append(labels.place_label(view.at(end), word, "halo soft", gaps=(16, 24, 34)))
    return figure(view.width, view.height, what, *parts, scales(view))


def ground(record: RunRecord, view: View, labels: Labels) -> str:
    """What stands still: route and obstacles."""
    return _route(record, view) + "".join(_obstacle(item, view, labels) for item in record.placed)


def _route(record: RunRecord, view: View) -> str:
    if record.route is None:
        return ""
    s = np.linspace(-0.2, record.route.length_m + 0.2, min(int(record.route.length_m * 50) + 20, MAX_POINTS))
    return polyline([view.at(point) for point in record.route.position_w(s)], "route")


def _obstacle(item: Placed, view: View, labels: Labels) -> str:
    obstacle: Obstacle = item.obstacle
    x, y = view.at(obstacle.position_w)
    class_ = "step" if item.walkable else "peg yields" if item.yields else "peg"
    reach = reach_m(obstacle) * view.scale
    if not view.shows(obstacle):
        return ""
    labels.keep_off((x - reach, y - reach, x + reach, y + reach), 0.15)
    tooltip = title(_about(item))
    if obstacle.shape != "box":
        return element("circle", tooltip, cx=x, cy=y, r=obstacle.radius_m * view.scale, class_=class_)
    corners = [view.at(corner) for corner in outline_w(obstacle)]
    return element("polygon", tooltip, points=points_text(corners), class_=class_)


def _about(item: Placed) -> str:
    said = [item.obstacle.name]
    if item.lean_rad:
        said.append(f"leans by {item.lean_rad:.2g} rad")
    if item.stiffness_n_per_m is not None:
        said.append(f"springs back with {item.stiffness_n_per_m:g} N/m")
    if item.slides_at_n is not None:
        said.append(f"slides from {item.slides_at_n:.3g} N on, and is drawn where it stood at the start")
    return ", ".join(said)


def outline_w(obstacle: Obstacle) -> Floats:
    """Points around an obstacle, (n, 2)."""
    center = np.array(obstacle.position_w[:2])
    if obstacle.shape != "box":
        around = np.linspace(0, 2 * np.pi, ROUND, endpoint=False)
        return center + obstacle.radius_m * np.stack([np.cos(around), np.sin(around)], axis=-1)
    c, s = math.cos(obstacle.yaw_rad), math.sin(obstacle.yaw_rad)
    a, b = obstacle.half_size_m[:2]
    return center + np.array([(a, b), (-a, b), (-a, -b), (a, -b)]) @ np.array([(c, s), (-s, c)])


def body(record: RunRecord, view: View, nodes: Floats, labels: Labels) -> str:
    """Capsules, tail to head, so that every link shows its cap over the one behind; then the joints."""
    points = [view.at(node) for node in nodes]
    parts: list[str] = []
    for i, link in enumerate(record.description.links):
        wide = 2 * link.radius_m * view.scale
        kind = "head-link" if i == len(record.description.links) - 1 else "link"
        a, b = points[i], points[i + 1]
        for class_, width in ((f"{kind}-edge", wide), (kind, wide - 2.4)):
            thick = max(width, 1.0)
            parts.append(element("line", x1=a[0], y1=a[1], x2=b[0], y2=b[1], class_=class_, stroke_width=thick))
        labels.keep_off_line(a, b, wide / 2, 0.4)
    parts += [element("circle", cx=x, cy=y, r=2.4, class_="joint") for x, y in points[1:-1]]
    return "".join(parts)


def _felt(contact: WorldContact, view: View, labels: Labels) -> str:
    """A measured force, drawn beside the solved one; too long an arrow is cut, and says how long it would be."""
    size = math.hypot(*contact.force_w[:2])
    cut = min(1.0, FELT_SHARE * LONGEST_ARROW / max(size * view.force_scale, 1e-9))
    start = view.along(view.at(contact.position_w), contact.tangent_w, 7.0)
    tip = view.along(start, contact.force_w, cut * view.force_scale)
    labels.keep_off_line(start, tip, 3)
    drawn = arrow(start, tip, "felt", head=8)
    return drawn + labels.place_label(tip, f"{size:.0f} N", "halo felt-text", gaps=(6, 12)) if cut < 1.0 else drawn


def _solved(instant: Instant, view: View, labels: Labels) -> str:
    """Solved forces and their resultant."""
    if instant.balance is None:
        return ""
    parts: list[str] = []
    kinds, sum_kind = instant.balance.force_classes(instant.felt)
    for contact, force, kind in zip(instant.balance.contacts, instant.balance.contact_n, kinds, strict=True):
        at = view.at(contact.position_w)
        tip = view.along(at, force, view.force_scale)
        parts.append(arrow(at, tip, kind, head=11))
        labels.keep_off_line(at, tip, 5)
    start = view.at(instant.balance.contacts[0].position_w)
    tip = view.along(start, instant.balance.resultant_n, view.force_scale)
    labels.keep_off_line(start, tip, 7, 2.0)
    parts.append(arrow(start, tip, "resultant under", head=14) + arrow(start, tip, sum_kind, head=14))
    return "".join(parts)


def _push_point(i: int, balance: Balance, view: View, labels: Labels) -> str:
    """Its name, and the size of the force there."""
    contact, size = balance.contacts[i], balance.size_n[i]
    foot = view.at(contact.position_w)
    tip, behind = (view.along(foot, contact.normal_w, far) for far in (size * view.force_scale, -18.0))
    force = labels.place_label(tip, f"{size:.0f} N", "halo solved-text", gaps=(6, 10, 16), away_from=foot)
    return force + labels.place_label(behind, with_subscript(f"o_{i + 1}"), "halo strong", away_from=foot)


def scales(view: View) -> str:
    """Bars of length and of force, and which way the axes point."""
    y = view.height - 10
    metres = round_below(0.25 * (view.width - 2 * EDGE) / view.scale)
    length = f"{metres * 100:g} cm" if metres < 1 else f"{metres:g} m"
    x = EDGE
    parts = [scale_bar(x, y, metres * view.scale, length)]
    x += metres * view.scale + text_width(length, LARGEST_TEXT) + BETWEEN_SCALES
    if view.force_scale > 0:
        newtons = round_below(0.8 * LONGEST_ARROW / view.force_scale)
        parts.append(scale_bar(x, y, newtons * view.force_scale, f"{newtons:g} N", "force-bar"))
    corner = (view.width - 46, view.height - 8)
    for vector, name in (((1.0, 0.0), "x"), ((0.0, 1.0), "y")):
        tip = view.along(corner, vector, 20)
        parts.append(arrow(corner, tip, "axes", head=6))
        beyond = view.along(corner, vector, 28)
        parts.append(text(beyond[0], beyond[1] + 4, name, "small soft", anchor="middle"))
    return "".join(parts)
