/* The states of a module, and the events that change them. Private to the firmware. */
#ifndef JOINT_MODULE_STATES_H
#define JOINT_MODULE_STATES_H

#include "joint_module.h"

/* Periods of the reports that a module sends by itself. */
enum { JM_HEARTBEAT_US = 100000, JM_HEALTH_US = 500000 };

/* Sets everything to what it is when a module starts to boot. */
void jm_start_boot(jm_module *module, uint64_t now_us);

/* Leaves JM_BOOT. */
void jm_finish_boot(jm_module *module, uint64_t now_us);

/* Leaves JM_STOPPING: the joint is at rest, or it has had its time. */
void jm_finish_stop(jm_module *module, uint64_t now_us);

/* Begins the watchdog's time anew. */
void jm_feed_watchdog(jm_module *module, uint64_t now_us);

/* Latches a fault. An emergency is latched more strongly, and stays. */
void jm_latch_fault(jm_module *module, jm_fault fault, uint64_t now_us);

/* Latches the faults whose cause is present, and that are not latched yet. */
void jm_latch_new_faults(jm_module *module, uint64_t now_us);

/* Handles an Emergency. */
void jm_enter_emergency(jm_module *module, uint64_t now_us);

/* Executes the action of a Command. One that makes no sense in the present state has no effect. */
void jm_execute_action(jm_module *module, uint32_t action, uint64_t now_us);

#endif
