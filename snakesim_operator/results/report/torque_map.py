"""All joints in one picture (paper, Fig. 11): a row a joint, blue one way, orange the other, clear at rest."""

import base64
import struct
import zlib
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.charts import Frame, chart, time_axis
from snakesim_operator.results.report.palette import LIGHT
from snakesim_operator.results.report.svg import element, line, text
from snakesim_operator.results.report.timeline import Propulsion, end_s
from snakesim_operator.results.summary import largest

Floats = NDArray[np.float64]
COLUMNS = 480


def torque_map(record: RunRecord, intervals: list[Propulsion], width: float) -> str:
    """Every joint's torque over time as a share of the run's largest; propulsion is framed."""
    names = [joint.name for joint in record.description.joints]
    share = record.torque_nm / full_colour_nm(record)
    return joint_map("Torque of every joint over time", names, share, end_s(record), intervals, width)


def joint_map(
    label: str,
    joints: list[str],
    share: Floats,
    until_s: float,
    intervals: list[Propulsion],
    width: float,
    *marks: float,
) -> str:
    """Shares in [-1, 1], (n, joints), over time; frames around intervals, dashed lines at `marks`."""
    cell = min(max(230.0 / len(joints), 3.0), 18.0)
    frame = Frame(width, 12 + cell * len(joints) + 36, until_s, 0.0, float(len(joints)), left=66.0)
    share = strongest(np.nan_to_num(share), COLUMNS)
    picture = element(
        "image",
        x=frame.left,
        y=frame.top,
        width=frame.width - frame.left - frame.right,
        height=cell * len(joints),
        preserveAspectRatio="none",
        class_="pixels",
        href=png(coloured(share.T[::-1])),
    )
    parts = [
        element(
            "rect",
            x=frame.left,
            y=frame.top,
            width=frame.width - frame.left - frame.right,
            height=cell * len(joints),
            class_="map-ground",
        ),
        picture,
    ]
    every = max(int(np.ceil(14 / cell)), 1)
    for i, joint in enumerate(joints):
        if i % every == 0:
            parts.append(text(frame.left - 6, frame.y(i + 0.5) + 4, joint, "small", anchor="end"))
    for one in intervals:
        box = element(
            "rect",
            x=frame.x(one.start_s),
            y=frame.y(one.joint + 1),
            width=max(frame.x(one.end_s) - frame.x(one.start_s), 1.0),
            height=cell,
            class_="map-frame",
        )
        parts.append(box)
    parts += [line((frame.x(t), frame.top), (frame.x(t), frame.height - frame.bottom), "mark") for t in marks]
    return chart(frame, label, *parts, time_axis(frame))


def full_colour_nm(record: RunRecord) -> float:
    """The torque that is drawn in full colour: the run's largest, unless that is next to nothing."""
    least = 0.05 * max(joint.torque_limit_nm for joint in record.description.joints)
    return max(largest(np.abs(record.torque_nm)) or 0.0, least, 1e-9)


def strongest(values: Floats, columns: int) -> Floats:
    """At most `columns` rows, each with the value of largest size in its stretch of time."""
    if len(values) <= columns:
        return values
    kept: list[Floats] = []
    edges = np.round(np.linspace(0, len(values), columns + 1)).astype(int)
    for part in (values[first:last] for first, last in pairwise(edges.tolist())):
        kept.append(part[np.abs(part).argmax(axis=0), np.arange(values.shape[1])])
    return np.array(kept)


def coloured(share: Floats) -> NDArray[np.uint8]:
    """Shares in [-1, 1] as RGBA: the sign gives the colour, the size the opacity, so it suits any background."""
    share = np.nan_to_num(np.clip(share, -1, 1))
    pixels = np.empty((*share.shape, 4), dtype=np.uint8)
    for sign, name in ((-1, "negative"), (1, "positive")):
        pixels[np.sign(share) == sign, :3] = _rgb(LIGHT[name])
    pixels[share == 0, :3] = 0
    pixels[..., 3] = np.round(255 * np.abs(share) ** 0.8)
    return pixels


def png(pixels: NDArray[np.uint8]) -> str:
    """RGBA pixels (rows, columns, 4) as a data URI."""
    rows, columns = pixels.shape[:2]
    raw = b"".join(b"\0" + row.tobytes() for row in pixels)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")
    return "data:image/png;base64," + base64.b64encode(b"\x89PNG\r\n\x1a\n" + parts).decode()


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
