// CycloneDDS: RTPS, by multicast when there are several readers. Best effort keeps the newest sample, as ddx does by default;
// reliable keeps and repeats them all.
#include "peer.h"

#include <dds/dds.h>

#include "sample.h"

static dds_entity_t *writers;

// Multicast discovery on the lab's link, and the same socket buffers as all have.
static const char CONFIG[] =
    "<CycloneDDS><Domain id=\"any\"><General><Interfaces><NetworkInterface name=\"eth0\"/></Interfaces></General>"
    "<Internal><SocketReceiveBufferSize max=\"4 MiB\"/><SocketSendBufferSize max=\"4 MiB\"/></Internal></Domain>"
    "</CycloneDDS>";

static dds_qos_t *make_qos(const struct options *options) {
    dds_qos_t *qos = dds_create_qos();
    if (options->reliable) {
        dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(10));
        dds_qset_history(qos, DDS_HISTORY_KEEP_ALL, 0);
    } else {
        dds_qset_reliability(qos, DDS_RELIABILITY_BEST_EFFORT, 0);
        dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 1);
    }
    return qos;
}

static dds_entity_t checked(dds_entity_t entity) {
    if (entity < 0) {
        fail(dds_strretcode(-entity));
    }
    return entity;
}

static dds_entity_t join_domain(void) {
    // A configuration from outside wins.
    setenv("CYCLONEDDS_URI", CONFIG, 0);
    return checked(dds_create_participant(DDS_DOMAIN_DEFAULT, NULL, NULL));
}

static dds_entity_t make_topic(dds_entity_t participant, int item) {
    char name[24];
    snprintf(name, sizeof name, "bench_%d", item);
    return checked(dds_create_topic(participant, &bench_Sample_desc, name, NULL, NULL));
}

static void open_publisher(const struct options *options) {
    dds_entity_t participant = join_domain();
    dds_qos_t *qos = make_qos(options);
    writers = (dds_entity_t *)calloc((size_t)options->items + 1, sizeof *writers);
    if (writers == NULL) {
        fail("no memory");
    }
    for (int item = 0; item < options->items; item++) {
        writers[item] = checked(dds_create_writer(participant, make_topic(participant, item), qos, NULL));
    }
    dds_delete_qos(qos);
}

static void on_data(dds_entity_t reader, void *unused) {
    (void)unused;
    for (;;) {
        void *samples[16] = {NULL};
        dds_sample_info_t infos[16];
        int count = dds_take(reader, samples, infos, 16, 16);
        if (count <= 0) {
            return;
        }
        for (int i = 0; i < count; i++) {
            const bench_Sample *sample = (const bench_Sample *)samples[i];
            if (infos[i].valid_data) {
                take(sample->bytes._buffer, sample->bytes._length);
            }
        }
        dds_return_loan(reader, samples, count);
    }
}

static void open_subscriber(const struct options *options) {
    dds_entity_t participant = join_domain();
    dds_qos_t *qos = make_qos(options);
    dds_listener_t *listener = dds_create_listener(NULL);
    dds_lset_data_available(listener, on_data);
    for (int item = 0; item < options->items; item++) {
        checked(dds_create_reader(participant, make_topic(participant, item), qos, listener));
    }
    dds_delete_listener(listener);
    dds_delete_qos(qos);
}

static const char *publish(int item, uint8_t *sample, size_t size) {
    bench_Sample out = {.bytes = {._maximum = (uint32_t)size, ._length = (uint32_t)size, ._buffer = sample, ._release = false}};
    // A timeout is a reader that does not keep up, and the sample is lost; all else is a refusal.
    dds_return_t done = dds_write(writers[item], &out);
    return done == DDS_RETCODE_OK || done == DDS_RETCODE_TIMEOUT ? NULL : dds_strretcode(-done);
}
