"""The definition of a moving body, by which the state of control, the summary and the report all judge."""

# Displacement of the center of mass in a window. With less the body is stationary, even if it wriggles in place.
MOVING_M = 0.02
WINDOW_S = 1.0
STANDING_STILL = f"standing still: less than {MOVING_M * 1e3:g} mm in {WINDOW_S:g} s"
"""The reason of a state that was measured, not reported by a controller."""
