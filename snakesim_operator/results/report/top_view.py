"""Draws the robot from above at one time: body to scale, route, obstacles and forces (Fig. 7 to 10 of the paper)."""

import math

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.placement import PlacedObstacle, outline_pipes
from snakesim_hal.model.scene_file.scene import compute_normal_gravity_m_s2
from snakesim_hal.wire.messages import KnownObstacle, WorldContact
from snakesim_operator.results.page.svg import (
    draw_arrow,
    draw_polyline,
    draw_scale_bar,
    draw_text,
    estimate_text_width,
    format_points,
    make_element,
    make_svg,
    make_tooltip,
    round_down_to_1_2_5,
)
from snakesim_operator.results.report.labels import LabelPlacer
from snakesim_operator.results.report.polygon import format_subscript
from snakesim_operator.results.report.snapshots import ForceBalance, RunSnapshot
from snakesim_operator.results.report.view import (
    FOOTER_HEIGHT,
    MARGIN,
    MAX_ARROW_LENGTH,
    MAX_MEASURED_ARROW_RATIO,
    MapViewport,
    find_body_points_xy_w,
    find_half_extent_m,
)
from snakesim_operator.results.run_log import RunRecord

MAX_ROUTE_POINTS = 1500
CIRCLE_CORNERS = 12
MAX_TEXT_SIZE = 25.0  # font size of the label of a scale on a phone, in page.css
SCALE_SPACING = 40.0  # between the scales of length and of force
PROPULSION_DOT_RADIUS = 6.5
JOINT_DOT_RADIUS = 2.4
NAME_GAPS = (16.0, 24.0, 34.0)  # distances of the labels of head and tail to try
# Of a measured force from its contact, so that its arrow does not cover the desired force.
MEASURED_OFFSET = 7.0


def draw_top_view(record: RunRecord, snapshot: RunSnapshot, view: MapViewport) -> str:
    """Draw the snake, the obstacles and the forces of one snapshot as SVG.

    Args:
        record: The recorded run.
        snapshot: Snapshot to draw, with the forces at its time.
        view: Window of the ground, scale of length and scale of force.
    """
    body_points_w = find_body_points_xy_w(record, snapshot.row)
    labels = LabelPlacer(view.width, view.height - FOOTER_HEIGHT)
    # Later parts cover earlier ones, and later labels avoid what is already drawn.
    parts = [draw_ground(record, view, labels), draw_body(record, view, body_points_w, labels)]
    for contact in snapshot.measured_contacts:
        parts.append(_draw_measured_force(contact, view, labels))
    parts.append(_draw_solved_forces(snapshot, view, labels))

    description = f"Top view at {snapshot.time_s:.2f} s"
    joint = snapshot.propulsion_joint
    if joint is not None:
        name = record.description.joints[joint].name
        description += f", {name} propels"
        # Point 0 is the tail end, before the first joint.
        x, y = view.to_pixels(body_points_w[joint + 1])
        fill = f"fill:var(--joint-{joint})"
        parts.append(
            make_element(
                "circle", cx=x, cy=y, r=PROPULSION_DOT_RADIUS, class_="propelling", style=fill
            )
        )
        parts.append(labels.place_label((x, y), name, "halo strong", gaps=(16, 22, 30, 40)))
    if snapshot.force_balance is not None:
        for index in range(len(snapshot.force_balance.contacts)):
            parts.append(_label_push_point(index, snapshot.force_balance, view, labels))
    parts.append(
        labels.place_label(view.to_pixels(body_points_w[0]), "tail", "halo soft", gaps=NAME_GAPS)
    )
    parts.append(
        labels.place_label(view.to_pixels(body_points_w[-1]), "head", "halo soft", gaps=NAME_GAPS)
    )
    return make_svg(view.width, view.height, description, *parts, draw_scales(view))


def draw_ground(record: RunRecord, view: MapViewport, labels: LabelPlacer) -> str:
    """Draw the route of the scene, and all pipes and obstacles."""
    scene = record.config.scene
    normal_gravity_m_s2 = compute_normal_gravity_m_s2(scene)
    items = [*outline_pipes(scene), *record.placed_obstacles]
    obstacles = [_draw_obstacle(item, normal_gravity_m_s2, view, labels) for item in items]
    return _draw_route(record, view) + "".join(obstacles)


def _draw_route(record: RunRecord, view: MapViewport) -> str:
    route = record.route
    if route is None:
        return ""
    count = min(int(route.length_m * 50) + 20, MAX_ROUTE_POINTS)
    arc_lengths_m = np.linspace(-0.2, route.length_m + 0.2, count)
    points = [view.to_pixels(point) for point in route.compute_positions_w(arc_lengths_m)]
    return draw_polyline(points, "route")


def _draw_obstacle(
    item: PlacedObstacle, normal_gravity_m_s2: float, view: MapViewport, labels: LabelPlacer
) -> str:
    """Draw one obstacle as SVG, with a tooltip; empty if it is not in the window.

    Args:
        item: The obstacle with its properties, such as whether the robot can climb it or push it away.
        normal_gravity_m_s2: Part of gravity that presses the obstacle onto the ground.
        view: Window and scale of the drawing.
        labels: Labels of the drawing, which avoid the obstacle.
    """
    obstacle: KnownObstacle = item.obstacle
    if not view.is_drawn(obstacle):
        return ""
    if item.walkable:
        class_ = "step"
    elif item.can_move:
        class_ = "peg yields"
    else:
        class_ = "peg"
    x, y = view.to_pixels(obstacle.position_w)
    half_extent = find_half_extent_m(obstacle) * view.pixels_per_m
    labels.reserve_box((x - half_extent, y - half_extent, x + half_extent, y + half_extent), 0.15)
    tooltip = make_tooltip(_describe_obstacle(item, normal_gravity_m_s2))
    if obstacle.shape == "box":
        corners = [view.to_pixels(corner) for corner in find_outline_w(obstacle)]
        return make_element("polygon", tooltip, points=format_points(corners), class_=class_)
    return make_element(
        "circle", tooltip, cx=x, cy=y, r=obstacle.radius_m * view.pixels_per_m, class_=class_
    )


def _describe_obstacle(item: PlacedObstacle, normal_gravity_m_s2: float) -> str:
    """Describe an obstacle for its tooltip: its name, and how it yields to forces."""
    words = [item.obstacle.name]
    if item.lean_rad:
        words.append(f"leans by {item.lean_rad:.2g} rad")
    if item.stiffness_n_per_m is not None:
        words.append(f"springs back with {item.stiffness_n_per_m:g} N/m")
    sliding_force_n = item.compute_sliding_force_n(normal_gravity_m_s2)
    if sliding_force_n is not None:
        words.append(
            f"slides from {sliding_force_n:.3g} N on, and is drawn where it stood at the start"
        )
    return ", ".join(words)


def find_outline_w(obstacle: KnownObstacle) -> Floats:
    """Find points on the outline of an obstacle, (n, 2) in the world: the corners of a box, or points on a circle."""
    center = np.array(obstacle.position_w[:2])
    if obstacle.shape != "box":
        angles = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS, endpoint=False)
        return center + obstacle.radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    cos = math.cos(obstacle.yaw_rad)
    sin = math.sin(obstacle.yaw_rad)
    a, b = obstacle.half_size_m[:2]
    corners = np.array([(a, b), (-a, b), (-a, -b), (a, -b)])
    return center + corners @ np.array([(cos, sin), (-sin, cos)])


def draw_body(
    record: RunRecord, view: MapViewport, body_points_w: Floats, labels: LabelPlacer
) -> str:
    """Draw the snake's links as thick lines with round ends, then its joints as dots, as SVG.

    The links are drawn tail to head, so that every link shows its round end over the link behind it.

    Args:
        record: The recorded run, with the radii of the links.
        view: Window and scale of the drawing.
        body_points_w: (links + 1, 2) ends of the links in the world, tail to head, in m.
        labels: Labels of the drawing, which avoid the body.
    """
    edge_width = 1.2  # visible width of the dark edge, a wider line below the link
    points = [view.to_pixels(point_w) for point_w in body_points_w]
    links = record.description.links
    parts: list[str] = []
    for i, link in enumerate(links):
        class_ = "head-link" if i == len(links) - 1 else "link"
        rear_x, rear_y = points[i]
        front_x, front_y = points[i + 1]
        width = 2 * link.radius_m * view.pixels_per_m
        layers = [(f"{class_}-edge", width), (class_, width - 2 * edge_width)]
        for layer_class, layer_width in layers:
            stroke_width = max(layer_width, 1.0)
            line = make_element(
                "line",
                x1=rear_x,
                y1=rear_y,
                x2=front_x,
                y2=front_y,
                class_=layer_class,
                stroke_width=stroke_width,
            )
            parts.append(line)
        labels.reserve_line(points[i], points[i + 1], width / 2, 0.4)
    for x, y in points[1:-1]:
        parts.append(make_element("circle", cx=x, cy=y, r=JOINT_DOT_RADIUS, class_="joint"))
    return "".join(parts)


def _draw_measured_force(contact: WorldContact, view: MapViewport, labels: LabelPlacer) -> str:
    """Draw a measured force beside the desired one. An arrow that is too long is cut and labeled with its magnitude."""
    magnitude_n = math.hypot(*contact.force_w[:2])
    cut = min(
        1.0,
        MAX_MEASURED_ARROW_RATIO * MAX_ARROW_LENGTH / max(magnitude_n * view.pixels_per_n, 1e-9),
    )
    start = view.offset_pixels(
        view.to_pixels(contact.position_w), contact.tangent_w, MEASURED_OFFSET
    )
    tip = view.offset_pixels(start, contact.force_w, cut * view.pixels_per_n)
    labels.reserve_line(start, tip, 3)
    drawn = draw_arrow(start, tip, "measured", head=8)
    if cut < 1.0:
        drawn += labels.place_label(tip, f"{magnitude_n:.0f} N", "halo measured-text", gaps=(6, 12))
    return drawn


def _draw_solved_forces(snapshot: RunSnapshot, view: MapViewport, labels: LabelPlacer) -> str:
    """Draw the controller's desired contact forces and their resultant as arrows, in SVG; empty without any.

    Args:
        snapshot: Snapshot to draw, with desired and measured forces.
        view: Window of the ground, scale of length and scale of force.
        labels: Labels of the drawing, which avoid the arrows.
    """
    force_balance = snapshot.force_balance
    if force_balance is None:
        return ""
    parts: list[str] = []
    contact_classes, resultant_class = force_balance.find_css_classes(snapshot.measured_contacts)
    for contact, force_n, class_ in zip(
        force_balance.contacts, force_balance.contact_forces_n, contact_classes, strict=True
    ):
        tail = view.to_pixels(contact.position_w)
        tip = view.offset_pixels(tail, force_n, view.pixels_per_n)
        parts.append(draw_arrow(tail, tip, class_, head=11))
        labels.reserve_line(tail, tip, 5)

    # The resultant acts through the first push-point. A wider arrow below it separates it from the body.
    tail = view.to_pixels(force_balance.contacts[0].position_w)
    tip = view.offset_pixels(tail, force_balance.resultant_force_n, view.pixels_per_n)
    labels.reserve_line(tail, tip, 7, 2.0)
    parts.append(draw_arrow(tail, tip, "resultant under", head=14))
    parts.append(draw_arrow(tail, tip, resultant_class, head=14))
    return "".join(parts)


def _label_push_point(
    index: int, balance: ForceBalance, view: MapViewport, labels: LabelPlacer
) -> str:
    """Label a push-point: the magnitude of its force at the tip of the arrow, and its name behind the contact."""
    contact = balance.contacts[index]
    magnitude_n = balance.magnitudes_n[index]
    foot = view.to_pixels(contact.position_w)
    tip = view.offset_pixels(foot, contact.normal_w, magnitude_n * view.pixels_per_n)
    behind = view.offset_pixels(foot, contact.normal_w, -18.0)
    force = labels.place_label(
        tip, f"{magnitude_n:.0f} N", "halo solved-text", gaps=(6, 10, 16), away_from=foot
    )
    name = labels.place_label(
        behind, format_subscript(f"o_{index + 1}"), "halo strong", away_from=foot
    )
    return force + name


def draw_scales(view: MapViewport) -> str:
    """Draw the scale bars of length and of force, and the axes x and y, at the bottom of a top view.

    Args:
        view: Window of the ground, scale of length and scale of force; without forces, its force scale is 0.
    """
    x = MARGIN
    y = view.height - 10
    max_length_m = 0.25 * (view.width - 2 * MARGIN) / view.pixels_per_m
    length_m = round_down_to_1_2_5(max_length_m)
    length_text = f"{length_m * 100:g} cm" if length_m < 1 else f"{length_m:g} m"
    parts = [draw_scale_bar(x, y, length_m * view.pixels_per_m, length_text)]

    if view.pixels_per_n > 0:
        x += (
            length_m * view.pixels_per_m
            + estimate_text_width(length_text, MAX_TEXT_SIZE)
            + SCALE_SPACING
        )
        force_n = round_down_to_1_2_5(0.8 * MAX_ARROW_LENGTH / view.pixels_per_n)
        parts.append(
            draw_scale_bar(x, y, force_n * view.pixels_per_n, f"{force_n:g} N", "force-bar")
        )

    origin = (view.width - 46, view.height - 8)
    for direction, name in (((1.0, 0.0), "x"), ((0.0, 1.0), "y")):
        tip = view.offset_pixels(origin, direction, 20)
        parts.append(draw_arrow(origin, tip, "axes", head=6))
        label_x, label_y = view.offset_pixels(origin, direction, 28)
        parts.append(draw_text(label_x, label_y + 4, name, "small soft", anchor="middle"))
    return "".join(parts)
