"""A scene with hills and a curved route, for tests of start poses."""

HILLS = {
    "ground": {
        "friction": 0.6,
        "heightfield": {"height_m": 0.06, "wavelength_m": 0.8, "area_m": 6.0},
    }
}
# A body along this curve cannot roll.
CURVE = {"route": {"kind": "sine", "amplitude_m": 0.1, "wavelength_m": 0.8, "length_m": 4.0}}
