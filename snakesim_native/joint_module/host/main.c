/* Emulates the joint modules of a robot with the reference firmware, on a local bus.
 *
 *     joint_modules --bus FOLDER --modules FILE [--stepped] [--duration SECONDS] [--until-input-ends]
 *
 * It prints a line when its modules are on the bus, and one whenever the torque of a joint is switched on or off. It
 * reads these lines from its standard input:
 *
 *     KIND joint_N         starts a fault, such as `mute joint_3`
 *     KIND joint_N off     ends it
 *     advance SECONDS      lets time pass without the host, and prints the time. For stepped modules only
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "robot.h"
#include "robot_file.h"

enum {
    INPUT_BYTES = 4096,
    WRONG_INPUT = 2,
    MAX_AT_ONCE_US = 20000, /* Of a longer delay of this process, the modules skip the rest. */
    STEP_MS = 1,
    STOP_CHECK_MS = 500 /* A stopped process ends within this time. */
};

typedef struct {
    const char *bus_folder;
    const char *modules_path;
    bool is_stepped;
    bool should_end_with_input;
    double duration_s; /* 0: without end */
} options;

/* The text that has arrived on the standard input. */
typedef struct {
    char text[INPUT_BYTES];
    size_t length;
    bool is_open;
} input_lines;

static volatile sig_atomic_t should_stop = 0;

static void handle_stop_signal(int number)
{
    (void)number;
    should_stop = 1;
}

static uint64_t read_clock_us(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

static bool read_options(options *o, int count, char **arguments)
{
    memset(o, 0, sizeof *o);
    for (int i = 1; i < count; i++) {
        bool has_value = i + 1 < count;
        if (strcmp(arguments[i], "--stepped") == 0) {
            o->is_stepped = true;
        } else if (strcmp(arguments[i], "--until-input-ends") == 0) {
            o->should_end_with_input = true;
        } else if (strcmp(arguments[i], "--bus") == 0 && has_value) {
            o->bus_folder = arguments[++i];
        } else if (strcmp(arguments[i], "--modules") == 0 && has_value) {
            o->modules_path = arguments[++i];
        } else if (strcmp(arguments[i], "--duration") == 0 && has_value) {
            o->duration_s = strtod(arguments[++i], NULL);
        } else {
            return false;
        }
    }
    return o->bus_folder != NULL && o->modules_path != NULL;
}

/* Executes one line of the standard input. */
static void execute_line(robot *r, const char *line)
{
    char kind[MAX_NAME_BYTES];
    char joint[MAX_NAME_BYTES];
    char end[MAX_NAME_BYTES] = "";
    int words = sscanf(line, "%31s %31s %31s", kind, joint, end);
    if (words <= 0) {
        return;
    }
    if (strcmp(kind, "advance") == 0 && words == 2 && r->is_stepped) {
        advance_without_host(r, strtod(joint, NULL));
        flush_robot(r);
        printf("%.6f time\n", (double)r->now_us * 1e-6);
    } else if (words < 2 || !inject_fault(r, kind, joint, strcmp(end, "off") != 0)) {
        printf("`%s` is no fault of a module of this robot\n", line);
    }
    fflush(stdout);
}

static void execute_complete_lines(robot *r, input_lines *input)
{
    char *line_end;
    while ((line_end = memchr(input->text, '\n', input->length)) != NULL) {
        *line_end = '\0';
        size_t line_bytes = (size_t)(line_end - input->text) + 1;
        execute_line(r, input->text);
        memmove(input->text, line_end + 1, input->length - line_bytes);
        input->length -= line_bytes;
    }
    if (input->length == sizeof input->text) {
        input->length = 0; /* No line is that long. */
    }
}

static void read_input(robot *r, input_lines *input)
{
    ssize_t count = read(STDIN_FILENO, input->text + input->length, sizeof input->text - input->length);
    if (count > 0) {
        input->length += (size_t)count;
        execute_complete_lines(r, input);
    } else if (count == 0 || (errno != EAGAIN && errno != EINTR)) {
        input->is_open = false;
    }
}

static void process_received_frames(robot *r)
{
    jm_frame frame;
    while (receive_frame(r->bus, &frame)) {
        process_frame(r, &frame);
    }
}

/* Waits until something arrives, or until the next step is due. Faults are executed before frames. */
static void wait_for_events(robot *r, input_lines *input)
{
    struct pollfd events[2] = {
        {.fd = input->is_open ? STDIN_FILENO : -1, .events = POLLIN},
        {.fd = r->bus->inbox, .events = POLLIN},
    };
    if (poll(events, 2, r->is_stepped ? STOP_CHECK_MS : STEP_MS) <= 0) {
        return;
    }
    if (events[0].revents != 0) {
        read_input(r, input);
    }
}

static void advance_by_clock(robot *r, uint64_t clock_us, uint64_t *skipped_us)
{
    uint64_t until_us = clock_us - *skipped_us;
    if (until_us > r->now_us + MAX_AT_ONCE_US) {
        *skipped_us += until_us - r->now_us - MAX_AT_ONCE_US;
        until_us = r->now_us + MAX_AT_ONCE_US;
    }
    advance_robot(r, until_us);
    flush_robot(r);
}

static void run(robot *r, const options *o)
{
    static input_lines input;
    uint64_t start_us = read_clock_us();
    uint64_t skipped_us = 0;
    input.is_open = true;
    while (!should_stop && (input.is_open || !o->should_end_with_input)) {
        wait_for_events(r, &input);
        uint64_t clock_us = read_clock_us() - start_us;
        if (!r->is_stepped) {
            advance_by_clock(r, clock_us, &skipped_us);
        }
        process_received_frames(r);
        if (o->duration_s > 0.0 && (double)clock_us >= o->duration_s * 1e6) {
            return;
        }
    }
}

static void handle_stop_signals(void)
{
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = handle_stop_signal;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    action.sa_handler = SIG_IGN;
    sigaction(SIGPIPE, &action, NULL); /* which writing to the inbox of an ended program sends */
}

static void print_lost_frames(const local_bus *bus)
{
    if (bus->lost_by_modules > 0) {
        printf("%llu frames were lost: the modules read too slowly\n", (unsigned long long)bus->lost_by_modules);
    }
    if (bus->lost_by_others > 0) {
        printf("%llu frames were lost by programs that do not read\n", (unsigned long long)bus->lost_by_others);
    }
}

int main(int count, char **arguments)
{
    static robot r;
    static local_bus bus;
    options o;
    if (!read_options(&o, count, arguments)) {
        fprintf(stderr, "usage: %s --bus FOLDER --modules FILE [--stepped] [--duration SECONDS] [--until-input-ends]\n",
                arguments[0]);
        return WRONG_INPUT;
    }
    r.module_count = read_robot_file(o.modules_path, r.descriptions, MAX_MODULES);
    if (r.module_count == 0 || !open_bus(&bus, o.bus_folder)) {
        return WRONG_INPUT;
    }
    handle_stop_signals();
    start_robot(&r, &bus, o.is_stepped);
    printf("modules ready: %d on local:%s\n", r.module_count, o.bus_folder);
    fflush(stdout);
    run(&r, &o);
    close_bus(&bus);
    print_lost_frames(&bus);
    return 0;
}
