"""eCAL as a contender of the network bench, by its Python wheel, whose library is native: the figures carry Python's part.

Words, orders, samples and answers are those of `../driver/program.rs`, which says what they mean.
"""

import ctypes
import os
import struct
import sys
import threading
import time

MARK = 0x62786464
HEADER = struct.Struct("<IIQQ")


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


now_ns = time.monotonic_ns


def sleep_until(ns):
    while (rest := ns - now_ns()) > 0:
        time.sleep(rest / 1e9)


def parse(words):
    options = {"items": "1", "size": "64", "rate": "1000", "seconds": None}
    words = iter(words)
    for word in words:
        if word == "--reliable":
            sys.exit("error: eCAL repeats nothing over UDP")
        options[word.removeprefix("--")] = next(words)
    return options


class Sink:
    """What has come since a run began; the figures are made when it ends."""

    def __init__(self):
        self.lock = threading.Lock()
        self.run = None
        self.has_said_first = False
        self.came = []

    def take(self, _publisher, _kind, data):
        now = now_ns()
        sample = data.buffer
        if len(sample) < HEADER.size:
            return
        mark, run, seq, stamp = HEADER.unpack_from(sample)
        if mark != MARK:
            return
        if not self.has_said_first:
            self.has_said_first = True
            say('{"first_ns":%d}' % now)
        with self.lock:
            if run == self.run:
                self.came.append((now, seq, stamp))

    def count(self, run, _size, _rate, _begin, since, until, report):
        with self.lock:
            self.run, self.came = run, []
        sleep_until(since)
        cpu = time.process_time_ns()
        sleep_until(until)
        cpu = time.process_time_ns() - cpu
        sleep_until(report)
        with self.lock:
            self.run, came = None, self.came
        seen, latencies, arrived, last, gap, gap_end = set(), [], 0, 0, 0, 0
        for now, seq, stamp in came:
            if seq in seen:
                continue
            seen.add(seq)
            arrived += since <= now < until
            if since <= stamp < until:
                latencies.append(now - stamp)
            if last and now - last > gap:
                gap, gap_end = now - last, now
            last = now
        latencies.sort()

        def quantile(share):
            at = min(int(len(latencies) * share), len(latencies) - 1)
            return latencies[at] if latencies else 0

        return (
            '{"run":%d,"arrived":%d,"delivered":%d,"duplicates":%d,"stale":0,"cpu_ns":%d,'
            '"p50_ns":%d,"p90_ns":%d,"p99_ns":%d,"max_ns":%d,"gap_ns":%d,"gap_end_ns":%d}'
        ) % (
            run, arrived, len(latencies), len(came) - len(seen), cpu,
            quantile(0.5), quantile(0.9), quantile(0.99), quantile(1), gap, gap_end,
        )  # fmt: skip


def publisher(publishers):
    def publish(run, size, rate, begin, since, until, _report):
        sample = bytearray(size)
        at = (ctypes.c_char * size).from_buffer(sample)
        seq = sent = 0
        cpu_since = None
        period = int(1e9 / rate) if rate else 0
        due = max(begin, now_ns())
        sleep_until(due)
        while (stamp := now_ns()) < until:
            if cpu_since is None and stamp >= since:
                cpu_since = time.process_time_ns()
            ctypes.memset(at, seq & 0xFF, size)
            HEADER.pack_into(sample, 0, MARK, run, seq, stamp)
            publishers[seq % len(publishers)].send(bytes(sample))
            seq += 1
            sent += since <= stamp < until
            if period:
                due += period
                late = now_ns() - due
                if late < 0:
                    sleep_until(min(due, until))
                elif late > 100_000_000:
                    due += late
        cpu = time.process_time_ns()
        spent = 0 if cpu_since is None else cpu - cpu_since
        return '{"run":%d,"sent":%d,"sent_in_all":%d,"cpu_ns":%d}' % (run, sent, seq, spent)

    return publish


def main():
    role, options = sys.argv[1], parse(sys.argv[2:])
    # The library looks there for `ecal.yaml`, which lies beside this program.
    os.environ["ECAL_DATA"] = os.path.dirname(os.path.abspath(__file__))
    import ecal.nanobind_core as ecal

    say('{"started_ns":%d}' % now_ns())
    ecal.initialize("bench")
    names = ["bench-%d" % item for item in range(int(options["items"]))]
    if role == "pub":
        answer = publisher([ecal.Publisher(name) for name in names])
    else:
        sink = Sink()
        subscribers = [ecal.Subscriber(name) for name in names]
        for subscriber in subscribers:
            subscriber.set_receive_callback(sink.take)
        answer = sink.count
    say('{"ready_ns":%d}' % now_ns())
    if options["seconds"]:
        rate = 0 if options["rate"] == "max" else float(options["rate"])
        begin = now_ns()
        until = begin + int(float(options["seconds"]) * 1e9)
        say(answer(1, int(options["size"]), rate, begin, begin, until, until + 300_000_000))
    else:
        for line in sys.stdin:
            _, run, size, rate, *times = line.split()
            say(answer(int(run), int(size), float(rate), *map(int, times)))
    # The library's own end may wait long for others.
    sys.stdout.flush()
    os._exit(0)


main()
