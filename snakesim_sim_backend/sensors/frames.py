"""Vectors between frames, as plain floats: for one vector a chain of numpy calls takes longer."""

from snakesim_hal.wire.quantities import Quaternion, Vector


def rotate_into_frame(rotation: list[float], v: Vector) -> Vector:
    """Return a world vector's coordinates in the frame whose world_from_frame is `rotation`, (9,) row by row."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = v
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def rotate(wxyz: Quaternion, v: Vector) -> Vector:
    """Return a vector rotated by a unit quaternion."""
    w, x, y, z = wxyz
    # t = 2 (x, y, z) x v;  result = v + w t + (x, y, z) x t
    tx = 2 * (y * v[2] - z * v[1])
    ty = 2 * (z * v[0] - x * v[2])
    tz = 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )
