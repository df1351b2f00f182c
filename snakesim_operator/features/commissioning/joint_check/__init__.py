"""The joint check: a run in which each joint moved by its motor shows whether the joints match the robot file.

`check`          prints whether each joint matches its file, and records the check in that file
`measurements`   what encoders, motors, IMUs and motion capture measured in that run
`judge`          collects the evidence for each joint, and judges every property as confirmed, wrong or unknown
`property_rules`, `gear_rules`   how a property is judged by the evidence
`joint_verdict`  the verdicts on one joint, and their texts

What the evidence consists of, all pure:

`link_shares`        how far links turned with a joint, and whose module is in whose place
`lost_motion`        backlash, from IMUs
`load_response`      how torques follow the large and the small motion, without IMUs
`gear_play`          backlash and loose couplings, from `load_response`
`encoder_dead_zone`  encoders that stick and jump
"""
