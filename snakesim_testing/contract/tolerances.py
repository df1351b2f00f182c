"""All tolerances of the contract tests, with their reasons. Transport in periods, mechanics in seconds.

They are wide enough for a robot on a bus (quantised, a period late, armed module by module) and narrow enough that
degrees, a wrong order or sign, a missing limit, or a joint that goes on moving are detected.
"""

# --- transport, in control periods -----------------------------------------------------------------------------

# Setpoints act from the next sample's synchronisation on; the sample after that shows it.
TRANSPORT_PERIODS = 2
ARMING_PERIODS = 15  # modules change their state one after another, and confirm it
# Every joint is read every tick: a reading is of this tick, or of the one before.
MAX_READING_AGE_PERIODS = 1
COMMAND_GAP_PERIODS = 3  # without commands, when setpoints have to hold; less than a lease of five
# A sensor with its own rate may start late by this much, besides its delay and one interval.
SENSOR_START_PERIODS = 3
HOLD_PERIODS = 5  # how long setpoints have to hold without being handed over again: a lease
TORQUE_OFF_PERIODS = 4  # from a stop to torque off: transport, and a command that drives confirm
CLOSING_PERIODS = 5  # for how long a closed backend is observed

# --- mechanics, in seconds -------------------------------------------------------------------------------------

# Bench4, released at MOTION_SPEED_RAD_S, is at rest after 0.3 s; a reached target has settled after 0.4 s.
SETTLING_TIME_S = 0.6
MOTION_DURATION_S = 0.3  # long enough to reach MOTION_SPEED_RAD_S, short enough to stay inside the limits of the joint
PUSH_DURATION_S = 0.5  # against a stop: the impact is over
FREEZE_DURATION_S = 1.0  # that a host does nothing: ten times a watchdog
DRIVE_RESTART_TIME_S = 1.0  # a drive that restarts answers again after half a second
# From the last setpoint: the watchdog, as long again for modules that brake, and a period.
MAX_WATCHDOG_OFF_S = 0.25
MAX_BRAKING_S = 0.1  # after a fault: the greatest watchdog of the bench's drives

# --- commands --------------------------------------------------------------------------------------------------

STEP_RAD = 0.2  # 11 degrees: hundreds of quantisation steps, well inside bench4's 0.6 rad
MOTION_SPEED_RAD_S = 0.5
NEAR_STOP_FRACTION = 0.8  # of the joint's limit: where a push against the stop begins
BEYOND_STOP_RAD = 1.0  # the stop: the target of a joint that can push only by its position
PUSH_TORQUE_FRACTION = 0.08  # of full torque, in torque mode against the stop
TORQUE_LIMIT_FRACTION = 0.1  # of full torque, as the limit in the setpoints...
TORQUE_DEMAND_FRACTION = 0.25  # ... while velocity mode asks for this much

# --- supply and heat ---------------------------------------------------------------------------------------------

POWER_REPORT_TIME_S = 2.0  # in which every drive has reported supply and temperatures: joint modules take half a second
SUPPLY_TOLERANCE_FRACTION = 0.2  # of the supply's voltage in the robot file: cables and load
MIN_TEMPERATURE_C = -20.0
MIN_SUPPLY_SAG_V = 1.0  # by which a reported supply drops at least if it sags by several volts

# --- tolerances ------------------------------------------------------------------------------------------------

# Friction of joint and ground over stiffness, noise, quantisation (1e-4 rad).
POSITION_TOLERANCE_RAD = 0.03
STANDSTILL_RAD = 0.02  # has not moved: a tenth of STEP_RAD, several times the noise and the vibration from neighbors
STANDSTILL_RAD_S = 0.05  # is at rest: a tenth of MOTION_SPEED_RAD_S; quantisation is 1e-3 rad/s
MAX_OVERSHOOT_RAD = 0.08  # beyond the joint's limit: a stop gives a little
# Velocity mode is a gain, not an integrator: friction reduces the speed.
SPEED_TOLERANCE_FRACTION = 0.35
# Angle against integrated velocity: sampling, and a period of disagreement.
INTEGRATION_TOLERANCE_RAD = 0.03
# Of the commanded torque; gauges and motor constants are not better.
TORQUE_TOLERANCE_FRACTION = 0.15
TORQUE_TOLERANCE_NM = 0.06  # besides: friction between motor and gauge, noise, quantisation (1e-3 N·m, limits 1e-2 N·m)
# At MOTION_SPEED_RAD_S, bench4 brakes with about 0.4 N·m; without braking, 0.06 N·m or less is measured.
MIN_BRAKING_TORQUE_NM = 0.12
# In real time, a sample in every period of 20 ms misses the braking of bench4 in about 1 of 8 faults.
REALTIME_BRAKING_FAULTS = 5
# Of full torque, in a tick, with small targets. The limiter's start is up to two periods old on a bus: at
# these speeds that is a tenth. A target that is not bumpless, or a motor that restarts, makes several tenths.
MAX_TORQUE_STEP_FRACTION = 0.25
RATE_TOLERANCE_FRACTION = 0.3  # of a sensor's stated rate
