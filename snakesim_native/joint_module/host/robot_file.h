/* Reads the file that describes the modules of a robot.
 *
 * It has one line for each module, tail to head: the name of the joint, and pairs of a key and a number.
 *
 *     joint_1 node 1 serial 3405691582 rated_torque_nm 4 rated_speed_rad_s 3 inertia_kg_m2 0.03 ...
 *
 * Keys are the fields of `module_description` and `joint_description`. `snakesim drive emulate can --firmware` writes
 * such a file. All values are those at the shaft of the module.
 */
#ifndef ROBOT_FILE_H
#define ROBOT_FILE_H

#include "emulated_module.h"

/* Reads at most `max_modules` descriptions. Returns their number, or 0 after printing what is wrong. */
int read_robot_file(const char *path, module_description *descriptions, int max_modules);

#endif
