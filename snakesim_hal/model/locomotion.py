"""When a body counts as moving. Control's state, the summary and the report all judge by these two numbers."""

MOVING_M = 0.02  # displacement of the center of mass in a window; less is standing still, also of a body that wriggles
WINDOW_S = 1.0
STANDING_STILL = f"standing still: less than {MOVING_M * 1e3:g} mm in {WINDOW_S:g} s"
"""The reason of a state that was measured, not reported by a controller."""
