/* Subscribes to a topic of a running `rapid` and prints a line for each sample:
 *
 *     subscriber /rapid/camera/wrist 5
 *
 * ends after so many samples, by default never. RAPID_INSTANCE is what that `rapid` was given as --instance.
 * Build instructions: rapid_node.h. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "rapid_node.h"

int main(int count, char **arguments) {
    if (count < 2) {
        fprintf(stderr, "usage: subscriber TOPIC [COUNT]\n");
        return 2;
    }
    rapid_subscriber *topic = rapid_subscriber_open(arguments[1]);
    if (topic == NULL) {
        fprintf(stderr, "%s: %s\n", arguments[1], rapid_node_error());
        return 1;
    }
    uint64_t left = count > 2 ? strtoull(arguments[2], NULL, 10) : UINT64_MAX, expected = 0;
    for (int is_first = 1; left > 0; left--, is_first = 0) {
        struct rapid_received sample;
        /* Waits; the bytes are valid until the next call. */
        if (rapid_subscriber_receive(topic, &sample) != 0) {
            fprintf(stderr, "%s\n", rapid_node_error());
            break;
        }
        if (!is_first && sample.seq != expected) {
            printf("%" PRIu64 " samples missing\n", sample.seq - expected);
        }
        expected = sample.seq + 1;
        printf("seq %" PRIu64 " epoch %" PRIu32 ", %zu bytes\n", sample.seq, sample.epoch, sample.length);
        fflush(stdout);
    }
    rapid_subscriber_close(topic);
    return left == 0 ? 0 : 1;
}
