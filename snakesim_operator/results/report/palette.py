"""Colours, light and dark, told apart by people with any kind of colour vision (after Okabe and Ito).

A joint has the colour of its place along the body, so it looks the same in every figure of every report.
"""

import re

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
    "felt": "#0067b0",
    "frame": "#00795c",
    "bad": "#b3261e",
    "locomoting": "#bfe0cd",
    "notlocomoting": "#f6d9a8",
    "idle": "#dfe3e8",
    "poweroff": "#c4c9cf",
    "negative": "#0067b0",
    "positive": "#d2691e",
    "joint-0": "#0072b2",
    "joint-1": "#d55e00",
    "joint-2": "#009e73",
    "joint-3": "#b8559a",
    "joint-4": "#b98500",
    "joint-5": "#3f9fd8",
    "joint-6": "#6b5bb5",
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
    "felt": "#5cb3f2",
    "frame": "#3ccba0",
    "bad": "#ff8a80",
    "locomoting": "#24553d",
    "notlocomoting": "#69501d",
    "idle": "#343a41",
    "poweroff": "#4a5159",
    "negative": "#5cb3f2",
    "positive": "#f39a4d",
    "joint-0": "#4aa8e8",
    "joint-1": "#f0894a",
    "joint-2": "#35c79d",
    "joint-3": "#e08cc4",
    "joint-4": "#e0b03a",
    "joint-5": "#8accf5",
    "joint-6": "#a99bf0",
}

JOINT_COLOURS = 7


def joint_class(joint: int) -> str:
    """The class that gives an element its joint's colour."""
    return f"joint-{joint % JOINT_COLOURS}"


def variables(colours: dict[str, str]) -> str:
    """Declarations of the colours as CSS variables."""
    return "".join(f"--{name}:{value};" for name, value in colours.items())


def baked(css: str, colours: dict[str, str]) -> str:
    """The style sheet with every variable replaced, for viewers of pictures that know no variables."""
    return re.sub(r"var\(--([a-z0-9-]+)\)", lambda found: colours[found[1]], css)
