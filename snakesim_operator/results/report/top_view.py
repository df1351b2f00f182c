"""The snake seen from above at one time: body to scale, route, obstacles, forces (Fig. 7-10)."""

import math

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.placement import Placed
from snakesim_hal.wire.messages import Obstacle, WorldContact
from snakesim_operator.results.page.svg import (
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
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.polygon import with_subscript
from snakesim_operator.results.report.snapshots import Balance, Snapshot
from snakesim_operator.results.report.view import EDGE, FELT_SHARE, FOOT, LONGEST_ARROW, View, nodes_xy_w, reach_m
from snakesim_operator.results.run_log import RunRecord

MAX_ROUTE_POINTS = 1500
CIRCLE_CORNERS = 12
MAX_TEXT_SIZE = 25.0  # of a scale's label on a phone, in page.css
SCALE_SPACING = 40.0  # between the scales of length and of force
MEASURED_OFFSET = 7.0  # of a measured force from its contact, so that it does not cover the solved one


def top_view(record: RunRecord, snapshot: Snapshot, view: View) -> str:
    """Draw the snake, the obstacles and the forces of one snapshot as SVG.

    Args:
        record: The recorded run.
        snapshot: The time to draw, with the forces then.
        view: Window of the ground, scale of length and scale of force.
    """
    nodes = nodes_xy_w(record, snapshot.row)
    labels = Labels(view.width, view.height - FOOT)
    # Later parts cover earlier ones, and later labels avoid what is already drawn.
    parts = [ground(record, view, labels), body(record, view, nodes, labels)]
    for contact in snapshot.measured_contacts:
        parts.append(_draw_measured_force(contact, view, labels))
    parts.append(_draw_solved_forces(snapshot, view, labels))

    description = f"Top view at {snapshot.time_s:.2f} s"
    joint = snapshot.propulsion_joint
    if joint is not None:
        name = record.description.joints[joint].name
        description += f", {name} propels"
        x, y = view.at(nodes[joint + 1])
        fill = f"fill:var(--joint-{joint})"
        parts.append(element("circle", cx=x, cy=y, r=6.5, class_="propelling", style=fill))
        parts.append(labels.place_label((x, y), name, "halo strong", gaps=(16, 22, 30, 40)))
    if snapshot.balance is not None:
        for i in range(len(snapshot.balance.contacts)):
            parts.append(_label_push_point(i, snapshot.balance, view, labels))
    parts.append(labels.place_label(view.at(nodes[0]), "tail", "halo soft", gaps=(16, 24, 34)))
    parts.append(labels.place_label(view.at(nodes[-1]), "head", "halo soft", gaps=(16, 24, 34)))
    return figure(view.width, view.height, description, *parts, scales(view))


def ground(record: RunRecord, view: View, labels: Labels) -> str:
    """Draw what does not move: route and obstacles."""
    obstacles = [_draw_obstacle(item, view, labels) for item in record.placed]
    return _draw_route(record, view) + "".join(obstacles)


def _draw_route(record: RunRecord, view: View) -> str:
    route = record.route
    if route is None:
        return ""
    count = min(int(route.length_m * 50) + 20, MAX_ROUTE_POINTS)
    arc_lengths_m = np.linspace(-0.2, route.length_m + 0.2, count)
    points = [view.at(point) for point in route.position_w(arc_lengths_m)]
    return polyline(points, "route")


def _draw_obstacle(item: Placed, view: View, labels: Labels) -> str:
    """Draw one obstacle as SVG, with a tooltip; empty if it is not in the window.

    Args:
        item: The obstacle, and whether the snake can climb it or push it away.
        view: Window and scale of the drawing.
        labels: Labels of the drawing, which avoid the obstacle.
    """
    obstacle: Obstacle = item.obstacle
    if not view.shows(obstacle):
        return ""
    if item.walkable:
        class_ = "step"
    elif item.yields:
        class_ = "peg yields"
    else:
        class_ = "peg"
    x, y = view.at(obstacle.position_w)
    half_extent = reach_m(obstacle) * view.scale
    labels.keep_off((x - half_extent, y - half_extent, x + half_extent, y + half_extent), 0.15)
    tooltip = title(_describe_obstacle(item))
    if obstacle.shape == "box":
        corners = [view.at(corner) for corner in outline_w(obstacle)]
        return element("polygon", tooltip, points=points_text(corners), class_=class_)
    return element("circle", tooltip, cx=x, cy=y, r=obstacle.radius_m * view.scale, class_=class_)


def _describe_obstacle(item: Placed) -> str:
    """Return the tooltip of an obstacle: its name, and how it yields."""
    words = [item.obstacle.name]
    if item.lean_rad:
        words.append(f"leans by {item.lean_rad:.2g} rad")
    if item.stiffness_n_per_m is not None:
        words.append(f"springs back with {item.stiffness_n_per_m:g} N/m")
    if item.slides_at_n is not None:
        words.append(f"slides from {item.slides_at_n:.3g} N on, and is drawn where it stood at the start")
    return ", ".join(words)


def outline_w(obstacle: Obstacle) -> Floats:
    """Return points around an obstacle, (n, 2)."""
    center = np.array(obstacle.position_w[:2])
    if obstacle.shape != "box":
        angles = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
        return center + obstacle.radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    cos = math.cos(obstacle.yaw_rad)
    sin = math.sin(obstacle.yaw_rad)
    a, b = obstacle.half_size_m[:2]
    corners = np.array([(a, b), (-a, b), (-a, -b), (a, -b)])
    return center + corners @ np.array([(cos, sin), (-sin, cos)])


def body(record: RunRecord, view: View, nodes: Floats, labels: Labels) -> str:
    """Draw the snake's links as thick lines with round ends, then its joints as dots, as SVG.

    The links are drawn tail to head, so that every link shows its round end over the link behind it.

    Args:
        record: The recorded run, with the radii of the links.
        view: Window and scale of the drawing.
        nodes: (links + 1, 2) ends of the links in the world, tail to head, in m.
        labels: Labels of the drawing, which avoid the body.
    """
    edge_width = 1.2  # of the dark edge that a wider line below the link leaves visible on each side
    points = [view.at(node) for node in nodes]
    links = record.description.links
    parts: list[str] = []
    for i, link in enumerate(links):
        class_ = "head-link" if i == len(links) - 1 else "link"
        rear_x, rear_y = points[i]
        front_x, front_y = points[i + 1]
        width = 2 * link.radius_m * view.scale
        layers = [(f"{class_}-edge", width), (class_, width - 2 * edge_width)]
        for layer_class, layer_width in layers:
            stroke_width = max(layer_width, 1.0)
            line = element(
                "line", x1=rear_x, y1=rear_y, x2=front_x, y2=front_y, class_=layer_class, stroke_width=stroke_width
            )
            parts.append(line)
        labels.keep_off_line(points[i], points[i + 1], width / 2, 0.4)
    for x, y in points[1:-1]:
        parts.append(element("circle", cx=x, cy=y, r=2.4, class_="joint"))
    return "".join(parts)


def _draw_measured_force(contact: WorldContact, view: View, labels: Labels) -> str:
    """Draw a measured force beside the solved one. An arrow that is too long is cut and labeled with its size."""
    size_n = math.hypot(*contact.force_w[:2])
    cut = min(1.0, FELT_SHARE * LONGEST_ARROW / max(size_n * view.force_scale, 1e-9))
    start = view.along(view.at(contact.position_w), contact.tangent_w, MEASURED_OFFSET)
    tip = view.along(start, contact.force_w, cut * view.force_scale)
    labels.keep_off_line(start, tip, 3)
    drawn = arrow(start, tip, "measured", head=8)
    if cut < 1.0:
        drawn += labels.place_label(tip, f"{size_n:.0f} N", "halo measured-text", gaps=(6, 12))
    return drawn


def _draw_solved_forces(snapshot: Snapshot, view: View, labels: Labels) -> str:
    """Draw the controller's desired contact forces and their resultant as arrows, in SVG; empty without any.

    Args:
        snapshot: The time to draw, with the desired and the measured forces.
        view: Window of the ground, scale of length and scale of force.
        labels: Labels of the drawing, which avoid the arrows.
    """
    balance = snapshot.balance
    if balance is None:
        return ""
    parts: list[str] = []
    contact_classes, resultant_class = balance.force_classes(snapshot.measured_contacts)
    for contact, force_n, class_ in zip(balance.contacts, balance.contact_n, contact_classes, strict=True):
        tail = view.at(contact.position_w)
        tip = view.along(tail, force_n, view.force_scale)
        parts.append(arrow(tail, tip, class_, head=11))
        labels.keep_off_line(tail, tip, 5)

    # The resultant acts through the first push-point. A wider arrow below it separates it from the body.
    tail = view.at(balance.contacts[0].position_w)
    tip = view.along(tail, balance.resultant_n, view.force_scale)
    labels.keep_off_line(tail, tip, 7, 2.0)
    parts.append(arrow(tail, tip, "resultant under", head=14))
    parts.append(arrow(tail, tip, resultant_class, head=14))
    return "".join(parts)


def _label_push_point(i: int, balance: Balance, view: View, labels: Labels) -> str:
    """Write the size of the force at its tip, and the name of the push-point behind it."""
    contact = balance.contacts[i]
    size_n = balance.size_n[i]
    foot = view.at(contact.position_w)
    tip = view.along(foot, contact.normal_w, size_n * view.force_scale)
    behind = view.along(foot, contact.normal_w, -18.0)
    force = labels.place_label(tip, f"{size_n:.0f} N", "halo solved-text", gaps=(6, 10, 16), away_from=foot)
    name = labels.place_label(behind, with_subscript(f"o_{i + 1}"), "halo strong", away_from=foot)
    return force + name


def scales(view: View) -> str:
    """Draw the bars that show the scales of length and of force, and the axes x and y, at the bottom of a top view.

    Args:
        view: Window of the ground, scale of length and scale of force; without forces, its force scale is 0.
    """
    x = EDGE
    y = view.height - 10
    max_length_m = 0.25 * (view.width - 2 * EDGE) / view.scale
    length_m = round_below(max_length_m)
    length_text = f"{length_m * 100:g} cm" if length_m < 1 else f"{length_m:g} m"
    parts = [scale_bar(x, y, length_m * view.scale, length_text)]

    if view.force_scale > 0:
        x += length_m * view.scale + text_width(length_text, MAX_TEXT_SIZE) + SCALE_SPACING
        force_n = round_below(0.8 * LONGEST_ARROW / view.force_scale)
        parts.append(scale_bar(x, y, force_n * view.force_scale, f"{force_n:g} N", "force-bar"))

    origin = (view.width - 46, view.height - 8)
    for direction, name in (((1.0, 0.0), "x"), ((0.0, 1.0), "y")):
        tip = view.along(origin, direction, 20)
        parts.append(arrow(origin, tip, "axes", head=6))
        label_x, label_y = view.along(origin, direction, 28)
        parts.append(text(label_x, label_y + 4, name, "small soft", anchor="middle"))
    return "".join(parts)
