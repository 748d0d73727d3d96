#!/usr/bin/env python3
"""Writes reports.jsonl: numbers and texts as Python's own arithmetic and formatting give them.

Each line is one case: what is measured, the window, messages as [time, size, stamp] in
nanoseconds, the time of the report, and the text. The script follows only the formats and formulas,
and shares no code with the tested program. Run it again with: python3 make.py > reports.jsonl
"""
import json
import math
import random

random.seed(20261120)
SECOND = 10**9


def statistics(values):
    mean = sum(values) / len(values)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / len(values))
    return mean, min(values), max(values), deviation, len(values)


def hz(messages, window, _):
    times = [message[0] for message in messages]
    between = [b - a for a, b in zip(times, times[1:])][-window:]
    mean, low, high, deviation, count = statistics(between)
    rate = 1 / mean if mean > 0 else 0
    return "average rate: %.3f\n\tmin: %.3fs max: %.3fs std dev: %.5fs window: %s\n" % (
        rate * 1e9, low * 1e-9, high * 1e-9, deviation * 1e-9, count)


def bw(messages, window, now):
    messages = messages[-window:]
    sizes = [message[1] for message in messages]
    rate = sum(sizes) / ((now - messages[0][0]) * 1e-9)
    if rate < 1000:
        text = lambda value: f"{value:.0f} B"
    elif rate < 1000000:
        text = lambda value: f"{value / 1000:.2f} KB"
    else:
        text = lambda value: f"{value / 1000 / 1000:.2f} MB"
    mean, low, high, _, count = statistics(sizes)
    return (f"{text(rate)}/s from {count} messages\n\tMessage size mean: {text(mean)} "
            f"min: {text(low)} max: {text(high)}\n")


def delay(messages, window, _):
    ages = [time - stamp for time, _, stamp in messages[1:]][-window:]
    mean, low, high, deviation, count = statistics(ages)
    return "average delay: %.3f\n\tmin: %.3fs max: %.3fs std dev: %.5fs window: %s\n" % (
        mean * 1e-9, low * 1e-9, high * 1e-9, deviation * 1e-9, count)


for case in range(90):
    kind = (hz, bw, delay)[case % 3]
    count = random.randrange(3, 24)
    window = random.choice([2, 5, 10, 10000])
    period = random.choice([1, 1000, 250_000, 500_000, 5_000_000, 100_000_000, 3 * SECOND])
    # Half milliseconds and half bytes are limits of rounding.
    exact = random.random() < 0.4
    size = random.choice([1, 25, 324, 999, 10_005, 644_148, 2_720_000])
    time, messages = 0, []
    for _ in range(count):
        time += period if exact else random.randrange(period * 2)
        age = random.choice([500_000, 1_500_000, -500_000]) if exact else random.randrange(
            -period, period * 3)
        messages.append([time, size + random.randrange(2), time - age])
    now = time + random.choice([1, 500_000_000, SECOND])
    print(json.dumps({"kind": kind.__name__, "window": window, "messages": messages, "now": now,
                      "text": kind(messages, window, now)}, separators=(",", ":")))
