// LCM: UDP multicast, nothing repaired.
#include "peer.h"

#include <lcm/lcm.h>

static lcm_t *lcm;
static char (*channels)[24];

static void join_group(const struct options *options) {
    char url[96];
    snprintf(url, sizeof url, "udpm://239.255.76.67:7667?ttl=1&recv_buf_size=%d", SOCKET_BUFFER_BYTES);
    lcm = lcm_create(url);
    if (lcm == NULL) {
        fail("lcm_create");
    }
    channels = (char(*)[24])calloc((size_t)options->items + 1, sizeof *channels);
    if (channels == NULL) {
        fail("no memory");
    }
    for (int item = 0; item < options->items; item++) {
        snprintf(channels[item], sizeof channels[item], "bench-%d", item);
    }
}

static void open_publisher(const struct options *options) { join_group(options); }

static void on_sample(const lcm_recv_buf_t *sample, const char *channel, void *user) {
    (void)channel;
    (void)user;
    take(sample->data, sample->data_size);
}

static void *handle(void *unused) {
    (void)unused;
    while (lcm_handle(lcm) == 0) {
    }
    fail("lcm_handle");
}

static void open_subscriber(const struct options *options) {
    join_group(options);
    for (int item = 0; item < options->items; item++) {
        lcm_subscription_t *subscription = lcm_subscribe(lcm, channels[item], on_sample, NULL);
        // The library drops what comes while so many wait; its own 30 would be lost in a burst.
        lcm_subscription_set_queue_capacity(subscription, 1000);
    }
    pthread_t thread;
    if (options->items > 0 && pthread_create(&thread, NULL, handle, NULL) != 0) {
        fail("pthread_create");
    }
}

static const char *publish(int item, uint8_t *sample, size_t size) {
    // An error is a datagram that the kernel refused: lost, as it may be on the way.
    (void)lcm_publish(lcm, channels[item], sample, (unsigned)size);
    return NULL;
}
