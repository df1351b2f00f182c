"""Physics that simulators, emulated modules and viewers share. Pure; no controller, host or network needs it.

`thermal`         temperatures of joint modules; their derating curve is also that of `safety`
`motor`           the motor model of one joint
`motors`          all motors of a robot as vectors: the power stages of emulated drives
`physics_model`   the protocol of a model of joints that move under torques, for emulated joint modules
`wrapped_model`   the base class of physics models that change a part of another one
`loose_gear`      a physics model whose gears have backlash, or couplings that slip
`sticking_encoder` a physics model whose encoders have a dead zone
`hills`           heights of hilly ground
"""
