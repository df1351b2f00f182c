/* The frames that a module sends by itself, and its answers to a Sync. Private to the firmware. */
#ifndef JOINT_MODULE_REPORTS_H
#define JOINT_MODULE_REPORTS_H

#include "joint_module.h"

/* Adds a frame to the outbox. If it is full, the frame is dropped and counted. */
void jm_send(jm_module *module, const jm_frame *frame);

/* Sends the present heartbeat. */
void jm_send_heartbeat(jm_module *module, uint64_t now_us);

/* Sends voltage, current, temperatures and water. */
void jm_send_health(jm_module *module);

/* Sends serial number, firmware and protocol version. */
void jm_send_identity(jm_module *module);

/* Answers the Sync with this count: joint state, contacts, and the IMU if it is due. */
void jm_answer_sync(jm_module *module, uint8_t count);

#endif
