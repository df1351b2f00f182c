/* The states of a module, and the events that change them.
 *
 *     BOOT -> DISARMED -> ARMED -> STOPPING -> DISARMED
 *                ^          |         |
 *                +-- clear -- FAULT <-+          EMERGENCY from every state, left by clear or reboot
 *
 * Every function that handles an event has one `switch` with all states, so that it can be compared with a row of the
 * table "States and events" of the specification.
 */
#include "states.h"

#include "parameters.h"
#include "reports.h"

enum { HEALTH_PHASES = 16 }; /* Modules send their first Health at different times. */

static const jm_demand PASSIVE_DEMAND = {JM_PASSIVE, 0.0f, 0.0f};

/* Action of a Command. */
typedef enum {
    ACTION_ARM = 1,
    ACTION_DISARM = 2,
    ACTION_STOP = 3,
    ACTION_CLEAR = 4,
    ACTION_REBOOT = 5,
    ACTION_IDENTIFY = 6
} command_action;

/* --- changes of state -------------------------------------------------------------------------------------------- */

/* Changes the state, drops all setpoints, and sends a heartbeat. */
static void enter_state(jm_module *module, jm_state state, jm_demand demand, uint64_t now_us)
{
    module->state = state;
    module->demand = demand;
    module->has_pending_demand = false;
    module->has_expected_count = false;
    module->wrong_counts = 0;
    jm_send_heartbeat(module, now_us);
}

/* Records why the module leaves JM_ARMED. A module in another state keeps the reason of its last stop. */
static void record_stop(jm_module *module, jm_last_stop reason)
{
    if (module->state == JM_ARMED) {
        module->last_stop = reason;
    }
}

void jm_start_boot(jm_module *module, uint64_t now_us)
{
    module->parameters = module->flash;
    module->state = JM_BOOT;
    module->state_after_boot = JM_DISARMED;
    module->faults = 0;
    module->demand = PASSIVE_DEMAND;
    module->has_pending_demand = false;
    module->has_expected_count = false;
    module->wrong_counts = 0;
    module->sync_count = 0;
    module->has_sync_since_setpoint = true;
    module->is_bridge_feed_due = false;
    module->boot_start_us = now_us;
    module->watchdog_fed_us = now_us;
    module->stopping_start_us = now_us;
    module->next_heartbeat_us = now_us;
    module->next_health_us = now_us;
}

void jm_finish_boot(jm_module *module, uint64_t now_us)
{
    uint32_t health_phase = 1u + module->config.node % HEALTH_PHASES;
    module->next_heartbeat_us = now_us + JM_HEARTBEAT_US;
    module->next_health_us = now_us + JM_HEALTH_US / HEALTH_PHASES * health_phase;
    enter_state(module, module->state_after_boot, PASSIVE_DEMAND, now_us);
}

void jm_feed_watchdog(jm_module *module, uint64_t now_us)
{
    module->watchdog_fed_us = now_us;
    module->is_bridge_feed_due = true;
}

/* --- faults ------------------------------------------------------------------------------------------------------ */

static uint8_t to_bit(jm_fault fault)
{
    return (uint8_t)(1u << (unsigned)fault);
}

/* Returns the bits of the faults whose cause is present. A winding that has overheated must first cool down. */
static uint8_t detect_faults(const jm_module *module)
{
    const jm_sensors *sensors = &module->sensors;
    bool has_overheated = (module->faults & to_bit(JM_FAULT_OVERHEAT)) != 0;
    int16_t max_winding = has_overheated ? module->config.derate_from_tenths_c : module->config.stop_at_tenths_c;
    uint8_t faults = 0;
    if (sensors->winding_tenths_c >= max_winding) {
        faults |= to_bit(JM_FAULT_OVERHEAT);
    }
    if (sensors->is_leaking) {
        faults |= to_bit(JM_FAULT_LEAK);
    }
    if (sensors->voltage_mv < module->config.min_voltage_mv) {
        faults |= to_bit(JM_FAULT_VOLTAGE);
    }
    if (!sensors->is_valid) {
        faults |= to_bit(JM_FAULT_SENSOR);
    }
    return faults;
}

void jm_latch_fault(jm_module *module, jm_fault fault, uint64_t now_us)
{
    module->faults |= to_bit(fault);
    switch (module->state) {
    case JM_BOOT:
    case JM_DISARMED:
    case JM_ARMED:
    case JM_STOPPING:
    case JM_FAULT:
        record_stop(module, (jm_last_stop)(JM_STOP_WATCHDOG + (int)fault));
        enter_state(module, JM_FAULT, PASSIVE_DEMAND, now_us);
        break;
    case JM_EMERGENCY:
        jm_send_heartbeat(module, now_us);
        break;
    }
}

void jm_latch_new_faults(jm_module *module, uint64_t now_us)
{
    uint8_t new_faults = (uint8_t)(detect_faults(module) & ~module->faults);
    for (int fault = 0; fault < JM_FAULT_COUNT; fault++) {
        if ((new_faults & to_bit((jm_fault)fault)) != 0) {
            jm_latch_fault(module, (jm_fault)fault, now_us);
        }
    }
}

/* --- commands ---------------------------------------------------------------------------------------------------- */

static void arm(jm_module *module, uint64_t now_us)
{
    switch (module->state) {
    case JM_DISARMED:
        if (detect_faults(module) == 0) {
            module->has_sync_since_setpoint = true;
            jm_feed_watchdog(module, now_us);
            enter_state(module, JM_ARMED, PASSIVE_DEMAND, now_us);
        }
        break;
    case JM_BOOT:
    case JM_ARMED:
    case JM_STOPPING:
    case JM_FAULT:
    case JM_EMERGENCY:
        break;
    }
}

static void disarm(jm_module *module, uint64_t now_us)
{
    switch (module->state) {
    case JM_ARMED:
    case JM_STOPPING:
        record_stop(module, JM_STOP_DISARM);
        enter_state(module, JM_DISARMED, PASSIVE_DEMAND, now_us);
        break;
    case JM_BOOT:
    case JM_DISARMED:
    case JM_FAULT:
    case JM_EMERGENCY:
        break;
    }
}

/* Returns the demand while the module comes to rest. */
static jm_demand make_stopping_demand(const jm_module *module)
{
    jm_demand damp = {JM_VELOCITY, 0.0f, module->parameters.values[JM_TORQUE_LIMIT]};
    return jm_get_count(module, JM_STOP_MODE) == 0 ? PASSIVE_DEMAND : damp;
}

static void stop(jm_module *module, uint64_t now_us)
{
    switch (module->state) {
    case JM_ARMED:
        module->stopping_start_us = now_us;
        module->is_bridge_feed_due = true; /* so that the bridge stays on while the module brakes */
        record_stop(module, JM_STOP_STOP);
        enter_state(module, JM_STOPPING, make_stopping_demand(module), now_us);
        break;
    case JM_BOOT:
    case JM_DISARMED:
    case JM_STOPPING:
    case JM_FAULT:
    case JM_EMERGENCY:
        break;
    }
}

void jm_finish_stop(jm_module *module, uint64_t now_us)
{
    enter_state(module, JM_DISARMED, PASSIVE_DEMAND, now_us);
}

static void clear(jm_module *module, uint64_t now_us)
{
    switch (module->state) {
    case JM_FAULT:
    case JM_EMERGENCY:
        if (detect_faults(module) == 0) {
            module->faults = 0;
            enter_state(module, JM_DISARMED, PASSIVE_DEMAND, now_us);
        }
        break;
    case JM_BOOT:
    case JM_DISARMED:
    case JM_ARMED:
    case JM_STOPPING:
        break;
    }
}

/* Restarts. Everything that was not saved is lost, and nothing is enabled. */
static void reboot(jm_module *module, uint64_t now_us)
{
    module->last_stop = jm_is_driven(module) ? JM_STOP_REBOOT : JM_STOP_NONE;
    jm_start_boot(module, now_us);
}

void jm_enter_emergency(jm_module *module, uint64_t now_us)
{
    switch (module->state) {
    case JM_BOOT:
        module->state_after_boot = JM_EMERGENCY;
        break;
    case JM_DISARMED:
    case JM_ARMED:
    case JM_STOPPING:
    case JM_FAULT:
        record_stop(module, JM_STOP_EMERGENCY);
        enter_state(module, JM_EMERGENCY, PASSIVE_DEMAND, now_us);
        break;
    case JM_EMERGENCY:
        break;
    }
}

void jm_execute_action(jm_module *module, uint32_t action, uint64_t now_us)
{
    switch (action) {
    case ACTION_ARM:
        arm(module, now_us);
        break;
    case ACTION_DISARM:
        disarm(module, now_us);
        break;
    case ACTION_STOP:
        stop(module, now_us);
        break;
    case ACTION_CLEAR:
        clear(module, now_us);
        break;
    case ACTION_REBOOT:
        reboot(module, now_us);
        break;
    case ACTION_IDENTIFY:
        jm_send_identity(module);
        break;
    default: /* An action of a later protocol has no effect. */
        break;
    }
}
