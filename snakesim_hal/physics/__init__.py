"""Physics that simulators, emulated modules and viewers share. Pure; no controller, host or network needs it.

`thermal`   heat of joint modules; its derating curve is also that of `safety`
`motor`     a joint's actuator      `physics_model`   a model of joints that turn under torques, as emulated joint
modules use it
`motors`    all motors of a robot as vectors: the power stages of emulated drives
`hills`     heights of uneven ground
"""
