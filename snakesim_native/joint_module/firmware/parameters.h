/* The parameters of a module: ranges, and the answer to a ParameterRequest. Private to the firmware. */
#ifndef JOINT_MODULE_PARAMETERS_H
#define JOINT_MODULE_PARAMETERS_H

#include "joint_module.h"

/* Reads, writes or saves a parameter as a request demands. Its length must have been checked.
 *
 * Returns the answer, with the value of the parameter afterwards. */
jm_frame jm_answer_parameter_request(jm_module *module, const jm_frame *request);

/* Returns saved values, in which those that are out of range are replaced by those of a new module.
 *
 * The ratings are always those of the configuration. */
jm_parameters jm_check_flash(const jm_parameters *flash, const jm_config *config);

/* Returns the value of a parameter that counts something, such as `contact_every`. */
uint8_t jm_get_count(const jm_module *module, jm_parameter parameter);

/* Returns for how long a module acts on one setpoint. */
uint64_t jm_get_watchdog_us(const jm_module *module);

#endif
