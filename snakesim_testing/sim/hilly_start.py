"""A start on hills, on a curve."""

HILLS = {
    "ground": {
        "friction": 0.6,
        "heightfield": {"height_m": 0.06, "wavelength_m": 0.8, "area_m": 6.0},
    }
}


# Cannot roll.
CURVE = {"route": {"kind": "sine", "amplitude_m": 0.1, "wavelength_m": 0.8, "length_m": 4.0}}
