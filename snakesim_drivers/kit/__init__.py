"""What every driver of real joints needs besides its protocol.

`drive_backend`  a whole backend over `Drives`: lifecycle, isolation, faults, ages, sensors
`buses`          each bus with its own drives, in real time in a thread of its own
`family`         settings, checks and buses of a family           `mixed`      a robot of several families
`mounting`       between a joint and the shaft of its drive: sign, zero, gear
`following`      who was told to follow, who does, who is told again
`readings`       what the drives said, and how old it is         `findings`   faults, each reported once
`mocap`          the base's pose from motion capture; `mocap_times` relates its clock, `mocap_sample` is its datagram
`twin_body`      what emulated drives move: plant, motors, heat  `mocap_twin` an emulated motion-capture system

Imports no bus, host or network.
"""
