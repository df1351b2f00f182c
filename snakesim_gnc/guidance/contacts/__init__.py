"""Contacts of a robot without contact sensors, estimated from joint torques.

`estimated_contacts`  the contacts, in the form that sensors publish
`contact_estimate`    the forces that explain torques and accelerations, with `planar_dynamics` and `sparse_fit`
"""
