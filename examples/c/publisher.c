/* A program that reads a device for `rapid`, in C.
 *
 *     [device.counter]
 *     vid = "0x2e8a"
 *     pid = "0x000a"
 *     node = "publisher"                 # beside devices.toml, or on PATH
 *     [device.counter.process]
 *     args = ["100"]                     # samples a second
 *     kind = "scalars"
 *     channels = 2
 *
 * `rapid` starts it when the device is plugged in and ends it with SIGTERM when that is pulled out. What it
 * publishes, here a counter and the time, comes out under the topic of the entry; what it prints goes into the
 * log. Build instructions: rapid_node.h. */
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "rapid_node.h"

static uint64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

int main(int count, char **arguments) {
    double rate = count > 1 ? atof(arguments[1]) : 100.0;
    if (!(rate >= 1.0 && rate <= 10000.0)) {
        fprintf(stderr, "usage: publisher [SAMPLES A SECOND, 1 to 10000]\n");
        return 2;
    }
    rapid_node *node = rapid_node_open(2 * sizeof(double));
    if (node == NULL) {
        fprintf(stderr, "%s\n", rapid_node_error());
        return 1;
    }
    const char *device = getenv("DEVICE_NODE");
    printf("reads %s\n", device == NULL ? "nothing" : device);
    fflush(stdout);

    uint64_t begun = now_ns();
    for (uint64_t number = 0;; number++) {
        uint64_t captured = now_ns();
        /* x86-64 and ARM are little-endian. */
        double values[2] = {(double)number, (double)captured / 1e9};
        struct rapid_sample sample = {
            .bytes = values, .length = sizeof values, .capture_ns = captured, .encoding = RAPID_F64};
        if (rapid_node_publish(node, &sample) != 0) {
            fprintf(stderr, "%s\n", rapid_node_error());
            rapid_node_close(node);
            return 1;
        }
        uint64_t due = begun + (uint64_t)((double)(number + 1) / rate * 1e9), now = now_ns();
        if (due > now) {
            struct timespec pause = {.tv_sec = (time_t)((due - now) / 1000000000u),
                                     .tv_nsec = (long)((due - now) % 1000000000u)};
            nanosleep(&pause, NULL);
        }
    }
}
