/* For programs in C: one that reads a device for `rapid` (publisher.c), one that subscribes to a topic (subscriber.c).
 *
 * Build:  cargo build --release -p rapid-node
 *         cc examples/c/publisher.c -I examples/c target/release/librapid_node.a -lpthread -ldl -lm -o publisher
 *
 * Everything is called from one thread. */
#ifndef RAPID_NODE_H
#define RAPID_NODE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What a payload holds. RAPID_F64 is little-endian 64-bit floats, which is what kind = "scalars" means. */
enum rapid_encoding { RAPID_BYTES = 0, RAPID_MJPEG = 1, RAPID_YUYV = 2, RAPID_GREY = 3, RAPID_F64 = 4, RAPID_DEPTH = 6 };

struct rapid_sample {
    const void *bytes;
    size_t length;
    uint64_t capture_ns; /* CLOCK_MONOTONIC; 0 if it is not known */
    uint64_t lost;       /* samples the device lost since the one before */
    uint32_t encoding;   /* enum rapid_encoding */
    uint32_t width;      /* of a picture, pixels */
    uint32_t height;
};

typedef struct rapid_node rapid_node;

/* Joins the bus of the `rapid` that started this program, to publish samples of at most max_bytes.
 * NULL on failure; rapid_node_error() returns the reason. */
rapid_node *rapid_node_open(size_t max_bytes);

/* Publishes a sample, whose bytes are copied. 0, or -1 with a rapid_node_error(). */
int rapid_node_publish(rapid_node *node, const struct rapid_sample *sample);

/* Leaves the bus. */
void rapid_node_close(rapid_node *node);

/* A sample that was received. */
struct rapid_received {
    const void *bytes; /* valid until the next call with this subscriber */
    size_t length;
    uint64_t seq;        /* a hole is a loss */
    uint64_t lost;       /* the part of all holes that the device lost itself */
    uint64_t capture_ns; /* CLOCK_MONOTONIC */
    uint32_t epoch;
    uint32_t encoding; /* enum rapid_encoding */
    uint32_t width;    /* of a picture, pixels */
    uint32_t height;
};

typedef struct rapid_subscriber rapid_subscriber;

/* Subscribes to a topic of the running `rapid` whose --instance is the environment variable RAPID_INSTANCE, or of
 * the one that started this program. NULL if that cannot be; rapid_node_error() has the reason. */
rapid_subscriber *rapid_subscriber_open(const char *topic);

/* Waits for the next sample. 0, or -1 with a rapid_node_error(). */
int rapid_subscriber_receive(rapid_subscriber *subscriber, struct rapid_received *sample);

/* Unsubscribes. */
void rapid_subscriber_close(rapid_subscriber *subscriber);

/* What went wrong last in this thread; valid until the next call of this library. */
const char *rapid_node_error(void);

#ifdef __cplusplus
}
#endif
#endif
