/* Prints the Physical Mask of a running `rapid`: which sensors are physically there, one bit each.
 *
 * Build:  cc examples/c/mask.c -o mask
 *
 * RAPID_INSTANCE is what that `rapid` was given as --instance. Needs no library. */
#include <fcntl.h>
#include <inttypes.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

/* As it is in the file, little endian, as x86-64 and ARM are. */
struct mask_record {
    char magic[4];
    uint8_t version;
    uint8_t devices;
    uint16_t generation;
    uint64_t mask;
    uint64_t time_ns;
    uint64_t sequence;
};

/* Reads a whole record; 0, or -1 if there is none. */
static int read_mask(int file, struct mask_record *record) {
    const off_t at = offsetof(struct mask_record, generation);
    uint16_t before, after;
    do {
        if (pread(file, &before, sizeof before, at) != sizeof before ||
            pread(file, record, sizeof *record, 0) != sizeof *record ||
            pread(file, &after, sizeof after, at) != sizeof after) {
            return -1;
        }
        /* Odd while a write is in progress, another one after a write: read again. */
    } while (before != after || before % 2 != 0);
    return memcmp(record->magic, "RAPD", 4) == 0 && record->version == 1 ? 0 : -1;
}

int main(void) {
    char path[256] = "/dev/shm/rapid_hardware_mask";
    const char *instance = getenv("RAPID_INSTANCE");
    if (instance != NULL && *instance != '\0') {
        snprintf(path, sizeof path, "/dev/shm/rapid_hardware_mask.%s", instance);
    }
    int file = open(path, O_RDONLY);
    struct mask_record record;
    if (file < 0 || read_mask(file, &record) != 0) {
        fprintf(stderr, "%s: no mask; is rapid running?\n", path);
        return 1;
    }
    printf("%" PRIu64 " 0x%02" PRIx64, record.sequence, record.mask);
    for (int bit = 0; bit < record.devices; bit++) {
        printf(" %d", (int)(record.mask >> bit & 1));
    }
    printf("\n");
    return 0;
}
