"""The forces that MuJoCo does not compute: dry friction, flat ground, and obstacles that yield.

`flat_ground`       the ground's forces on the feet
`contact_friction`  friction of the contacts that MuJoCo finds
`directional`       friction of both that depends on the direction of sliding
`yielding`          obstacles on springs, and obstacles that slide on the ground
`chain`             adds forces on the links to MuJoCo's generalized forces
`laws`              what each version of the laws does
`python_laws`       the Python version, made of the four modules above
`native_laws`       the C version, in `snakesim_native/laws`
`version`           chooses the version, and adds its parameters and memory to a model
"""
