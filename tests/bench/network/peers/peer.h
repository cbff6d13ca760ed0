// What the two programs of each peer do, in C: the words, orders, samples and answers of `../driver/program.rs`, which says
// what they mean. A peer defines the three functions below, includes this once, and has `main` here.
#pragma once

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <inttypes.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum {
    HEADER = 24,
    MARK = 0x62786464,
    SOCKET_BUFFER_BYTES = 4 << 20,
    SIZE_MAX_BYTES = 1 << 20,
};

struct options {
    bool publishes;
    bool reliable;
    int items;
    const char *own;
};

// Opens all items for writing.
static void open_publisher(const struct options *options);
// Opens all items for reading: each sample goes to `take` as long as the program lives.
static void open_subscriber(const struct options *options);
// Sends one sample, or returns why it is refused.
static const char *publish(int item, uint8_t *sample, size_t size);

struct run {
    uint32_t id;
    size_t size;
    double rate;
    uint64_t begin, from, until, report;
};

static pthread_mutex_t tally_lock = PTHREAD_MUTEX_INITIALIZER;
static struct {
    bool is_on, has_said_first;
    struct run run;
    uint64_t *seen;
    size_t seen_words;
    uint64_t arrived, delivered, duplicates, stale;
    uint64_t last, gap, gap_end;
    uint64_t latencies[64 * 128], latencies_total;
} tally;

static uint64_t clock_ns(clockid_t clock) {
    struct timespec at;
    clock_gettime(clock, &at);
    return (uint64_t)at.tv_sec * 1000000000u + (uint64_t)at.tv_nsec;
}

static uint64_t now_ns(void) { return clock_ns(CLOCK_MONOTONIC); }

static uint64_t cpu_ns(void) { return clock_ns(CLOCK_PROCESS_CPUTIME_ID); }

static void sleep_until(uint64_t ns) {
    struct timespec at = {.tv_sec = (time_t)(ns / 1000000000u), .tv_nsec = (long)(ns % 1000000000u)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL) != 0) {
    }
}

__attribute__((noreturn)) static void fail(const char *why) {
    fprintf(stderr, "error: %s\n", why);
    exit(1);
}

static bool covers(const struct run *run, uint64_t at) { return at >= run->from && at < run->until; }

// Values below 128 have a bucket each; above, 128 buckets each time the value doubles.
static void add_latency(uint64_t value) {
    unsigned bits = value ? 64u - (unsigned)__builtin_clzll(value) : 0, shift = bits > 8 ? bits - 8 : 0;
    tally.latencies[shift * 128 + (value >> shift)]++;
    tally.latencies_total++;
}

static uint64_t latency_quantile(double share) {
    uint64_t below = 0;
    for (uint64_t bucket = 0; bucket < sizeof tally.latencies / sizeof *tally.latencies; bucket++) {
        below += tally.latencies[bucket];
        if (below > 0 && (double)below >= share * (double)tally.latencies_total) {
            uint64_t shift = bucket < 128 ? 0 : bucket / 128 - 1;
            return (bucket - shift * 128) << shift;
        }
    }
    return 0;
}

// Takes a sample that has just come, on whatever thread.
static void take(const void *bytes, size_t size) {
    uint64_t now = now_ns(), seq, stamp;
    uint32_t mark, id;
    if (size < HEADER) {
        return;
    }
    memcpy(&mark, bytes, 4);
    memcpy(&id, (const uint8_t *)bytes + 4, 4);
    memcpy(&seq, (const uint8_t *)bytes + 8, 8);
    memcpy(&stamp, (const uint8_t *)bytes + 16, 8);
    if (mark != MARK || seq >= 1u << 30) {
        return;
    }
    pthread_mutex_lock(&tally_lock);
    if (!tally.has_said_first) {
        tally.has_said_first = true;
        printf("{\"first_ns\":%" PRIu64 "}\n", now);
    }
    if (!tally.is_on || tally.run.id != id) {
        tally.stale++;
        goto done;
    }
    if (seq / 64 >= tally.seen_words) {
        size_t words = 2 * (seq / 64 + 1);
        tally.seen = (uint64_t *)realloc(tally.seen, words * 8);
        if (tally.seen == NULL) {
            fail("no memory");
        }
        memset(tally.seen + tally.seen_words, 0, (words - tally.seen_words) * 8);
        tally.seen_words = words;
    }
    if (tally.seen[seq / 64] >> (seq % 64) & 1) {
        tally.duplicates++;
        goto done;
    }
    tally.seen[seq / 64] |= (uint64_t)1 << (seq % 64);
    tally.arrived += covers(&tally.run, now);
    if (covers(&tally.run, stamp)) {
        tally.delivered++;
        add_latency(now > stamp ? now - stamp : 0);
    }
    if (tally.last != 0 && now - tally.last > tally.gap) {
        tally.gap = now - tally.last;
        tally.gap_end = now;
    }
    tally.last = now;
done:
    pthread_mutex_unlock(&tally_lock);
}

static void count_run(const struct run *run) {
    pthread_mutex_lock(&tally_lock);
    tally.is_on = true;
    tally.run = *run;
    memset(tally.seen, 0, tally.seen_words * 8);
    tally.arrived = tally.delivered = tally.duplicates = tally.stale = 0;
    tally.last = tally.gap = tally.gap_end = 0;
    memset(tally.latencies, 0, sizeof tally.latencies);
    tally.latencies_total = 0;
    pthread_mutex_unlock(&tally_lock);
    sleep_until(run->from);
    uint64_t cpu = cpu_ns();
    sleep_until(run->until);
    cpu = cpu_ns() - cpu;
    sleep_until(run->report);
    pthread_mutex_lock(&tally_lock);
    tally.is_on = false;
    printf("{\"run\":%" PRIu32 ",\"arrived\":%" PRIu64 ",\"delivered\":%" PRIu64 ",\"duplicates\":%" PRIu64
           ",\"stale\":%" PRIu64 ",\"cpu_ns\":%" PRIu64 ",\"p50_ns\":%" PRIu64 ",\"p90_ns\":%" PRIu64
           ",\"p99_ns\":%" PRIu64 ",\"max_ns\":%" PRIu64 ",\"gap_ns\":%" PRIu64 ",\"gap_end_ns\":%" PRIu64 "}\n",
           run->id, tally.arrived, tally.delivered, tally.duplicates, tally.stale, cpu, latency_quantile(0.5),
           latency_quantile(0.9), latency_quantile(0.99), latency_quantile(1.0), tally.gap, tally.gap_end);
    pthread_mutex_unlock(&tally_lock);
}

static void publish_run(const struct run *run, int items, uint8_t *sample) {
    uint64_t seq = 0, sent = 0, cpu_from = 0, now = now_ns();
    uint64_t period = run->rate > 0 ? (uint64_t)(1e9 / run->rate) : 0;
    uint64_t due = run->begin > now ? run->begin : now;
    uint32_t mark = MARK;
    sleep_until(due);
    for (;;) {
        uint64_t stamp = now_ns();
        if (stamp >= run->until) {
            break;
        }
        if (stamp >= run->from && cpu_from == 0) {
            cpu_from = cpu_ns();
        }
        memcpy(sample, &mark, 4);
        memcpy(sample + 4, &run->id, 4);
        memcpy(sample + 8, &seq, 8);
        memcpy(sample + 16, &stamp, 8);
        memset(sample + HEADER, (int)(seq & 0xff), run->size - HEADER);
        const char *refused = publish((int)(seq % (uint64_t)items), sample, run->size);
        if (refused != NULL) {
            printf("{\"run\":%" PRIu32 ",\"refused\":\"%s\"}\n", run->id, refused);
            return;
        }
        seq++;
        sent += covers(run, stamp);
        if (period != 0) {
            due += period;
            now = now_ns();
            if (due > now) {
                sleep_until(due < run->until ? due : run->until);
            } else if (now - due > 100000000u) {
                due = now;
            }
        }
    }
    uint64_t cpu = cpu_ns();
    printf("{\"run\":%" PRIu32 ",\"sent\":%" PRIu64 ",\"sent_in_all\":%" PRIu64 ",\"cpu_ns\":%" PRIu64 "}\n", run->id,
           sent, seq, cpu - (cpu_from ? cpu_from : cpu));
}

static void obey(const struct options *options, const struct run *run, uint8_t *sample) {
    if (options->publishes) {
        publish_run(run, options->items > 0 ? options->items : 1, sample);
    } else {
        count_run(run);
    }
}

int main(int count, char **words) {
    struct options options = {.publishes = count > 1 && strcmp(words[1], "pub") == 0,
                              .reliable = false,
                              .items = 1,
                              .own = "127.0.0.1"};
    size_t size = 64;
    double rate = 1000, seconds = 0;
    if (count < 2 || (!options.publishes && strcmp(words[1], "sub") != 0)) {
        fail("`pub` or `sub` was expected");
    }
    for (int i = 2; i < count; i++) {
        if (strcmp(words[i], "--reliable") == 0) {
            options.reliable = true;
            continue;
        }
        const char *value = i + 1 < count ? words[i + 1] : "";
        if (strcmp(words[i], "--items") == 0) {
            options.items = atoi(value);
        } else if (strcmp(words[i], "--own") == 0) {
            options.own = value;
        } else if (strcmp(words[i], "--size") == 0) {
            size = (size_t)atol(value);
        } else if (strcmp(words[i], "--rate") == 0) {
            rate = strcmp(value, "max") == 0 ? 0 : atof(value);
        } else if (strcmp(words[i], "--seconds") == 0) {
            seconds = atof(value);
        } else if (strcmp(words[i], "--sizes") != 0 && strcmp(words[i], "--publisher") != 0 &&
                   strcmp(words[i], "--subscribers") != 0) {
            fail("an option that is not known here");
        }
        i++;
    }
    setvbuf(stdout, NULL, _IOLBF, 0);
    static uint8_t sample[SIZE_MAX_BYTES];
    printf("{\"started_ns\":%" PRIu64 "}\n", now_ns());
    if (options.publishes) {
        open_publisher(&options);
    } else {
        open_subscriber(&options);
    }
    printf("{\"ready_ns\":%" PRIu64 "}\n", now_ns());
    struct run run;
    if (seconds > 0) {
        run.id = 1;
        run.size = size;
        run.rate = rate;
        run.begin = run.from = now_ns();
        run.until = run.from + (uint64_t)(seconds * 1e9);
        run.report = run.until + 300000000u;
        obey(&options, &run, sample);
        return 0;
    }
    while (scanf(" run %" SCNu32 " %zu %lf %" SCNu64 " %" SCNu64 " %" SCNu64 " %" SCNu64, &run.id, &run.size, &run.rate,
                 &run.begin, &run.from, &run.until, &run.report) == 7) {
        if (run.size < HEADER || run.size > SIZE_MAX_BYTES) {
            fail("a size that is not known here");
        }
        obey(&options, &run, sample);
    }
    return 0;
}
