"""The parts of SnakeSIM that are written in C, and their compilation.

`laws/`      ground, friction and yielding obstacles, as a plugin of MuJoCo's engine
`planner/`   the beam search of the path planner
`libraries`  names the libraries; a folder of C files is one library
`compile`    compiles them: `python -m snakesim_native.compile`
`load`       finds the compiled library and loads it; compiles it first if its sources have changed
`programs`   the reference firmware of joint modules in `joint_module/`, as programs; compiled when first needed

Every library has a Python version of the same functions, with the same results to the last bit. SnakeSIM uses the
Python version where no library can be loaded, for example because the computer has no C compiler.

To add a C file, put it into the folder of a library. To add a library, make a folder and add it to `LIBRARIES`. Then:

    from snakesim_native.libraries import LAWS_LIBRARY
    from snakesim_native.load import load_shared_library

    library = load_shared_library(LAWS_LIBRARY).library  # a ctypes.CDLL; None: use the Python version

`joint_module/` is different: its programs are for people who build joint modules, and nothing else needs them.

This package imports nothing of SnakeSIM.
"""
