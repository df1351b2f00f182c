"""Defines colors for light and dark pages that people with any color vision can distinguish (after Okabe and Ito).

A joint has one color of its own, the same in every figure of every report.
"""

import colorsys

LIGHT: dict[str, str] = {
    "page": "#fbfbf9",
    "card": "#ffffff",
    "ink": "#1b1f24",
    "soft": "#59626d",
    "faint": "#8b95a1",
    "rule": "#d9dde2",
    "grid": "#eceef0",
    "body": "#e4e7ea",
    "body-edge": "#6b7683",
    "head": "#b9c2cc",
    "peg": "#cfc3ae",
    "peg-edge": "#8a7a5c",
    "route": "#7d8894",
    "measured": "#0067b0",
    "reference": "#c8321f",
    "frame": "#00795c",
    "commanded": "#7a3fa8",
    "bad": "#b3261e",
    "locomoting": "#bfe0cd",
    "notlocomoting": "#f6d9a8",
    "idle": "#dfe3e8",
    "poweroff": "#c4c9cf",
    "negative": "#0067b0",
    "positive": "#d2691e",
}

DARK: dict[str, str] = {
    "page": "#14171a",
    "card": "#1c2024",
    "ink": "#f0f2f4",
    "soft": "#a9b2bc",
    "faint": "#7b8590",
    "rule": "#363c43",
    "grid": "#272c31",
    "body": "#3a4149",
    "body-edge": "#98a3af",
    "head": "#5f6b78",
    "peg": "#5b5140",
    "peg-edge": "#a8966f",
    "route": "#808c98",
    "measured": "#5cb3f2",
    "reference": "#ff7b66",
    "frame": "#3ccba0",
    "commanded": "#c79bf0",
    "bad": "#ff8a80",
    "locomoting": "#24553d",
    "notlocomoting": "#69501d",
    "idle": "#343a41",
    "poweroff": "#4a5159",
    "negative": "#5cb3f2",
    "positive": "#f39a4d",
}

HUE_STEP = 0.381966  # fraction of the hue circle between joints: neighbors differ strongly, and no hue is repeated


def make_joint_colors(count: int, *, dark: bool) -> dict[str, str]:
    """Make a color for every joint: "#rrggbb" by CSS name `joint-INDEX`, tail to head."""
    lightness = (0.66, 0.76) if dark else (0.45, 0.34)  # of even and odd joints
    colors: dict[str, str] = {}
    for joint in range(count):
        hue = (0.56 + HUE_STEP * joint) % 1
        rgb = colorsys.hls_to_rgb(hue, lightness[joint % 2], 0.72)
        colors[f"joint-{joint}"] = "#" + "".join(f"{round(255 * part):02x}" for part in rgb)
    return colors


def make_theme_css(joint_count: int) -> str:
    """Make the CSS rules with the colors of both themes as variables. A printed page is always light."""
    light = LIGHT | make_joint_colors(joint_count, dark=False)
    dark = DARK | make_joint_colors(joint_count, dark=True)
    return (
        f":root{{{format_css_variables(light)}}}@media screen and (prefers-color-scheme:dark)"
        f"{{:root:not(.paper){{{format_css_variables(dark)}}}}}"
    )


def format_css_variables(colors: dict[str, str]) -> str:
    """Format colors as CSS variables, `--NAME:COLOR;`."""
    return "".join(f"--{name}:{value};" for name, value in colors.items())
