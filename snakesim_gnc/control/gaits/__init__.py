"""Gaits that the literature describes. Each is a reference over time, which the joints follow without a jump.

`base`             what all gaits share: phase, standing still, and the reason of a robot that cannot
`body_curve`       the joint angles of any robot on a curve that a gait describes
`heading_control`  steers a planar gait along a path

Gaits in the plane, for yaw joints:

`serpenoid`        Hirose's curve, with the directional control of Liljebäck
`cpg`              coupled oscillators of Ijspeert and Crespi, with force feedback
`concertina`       folds one half of the body while the other half extends

Gaits for yaw and pitch joints:

`axis_waves`       sidewinding, rolling and a raised head as waves of the joints
`backbones`        sidewinding and rolling as curves in space, by Hatton and Choset
`chain_fit`        fits a chain of joints to a curve in space
`sinus_lifting`    a serpenoid curve whose bends are lifted
`rectilinear`      a wave of the pitch joints that carries the body forward
"""
