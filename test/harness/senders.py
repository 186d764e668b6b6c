"""States of one sender and of two, as senders are looked for in them, drawn at random."""

import numpy as np

from harness.bags import JOINT_STATE, TYPES, S, serialised
from hpid_ros.messages.reading.senders import Part

T0 = 1_700_000_000 * S


def joint_state(stamp_ns, names, position=(), velocity=(), effort=(), frame_id=""):
    """Return a state as its sender serialises it."""
    time = TYPES.types["builtin_interfaces/msg/Time"](*divmod(int(stamp_ns), S))
    head = TYPES.types["std_msgs/msg/Header"](time, frame_id)
    arrays = (np.array(each, float) for each in (position, velocity, effort))
    return serialised(JOINT_STATE, head, list(names), *arrays)


def parts_of(times, positions, efforts, layouts, log_times=None):
    """Return states by layout; arrays of one length, times in [s]."""
    log_times = times + 2e-4 if log_times is None else log_times
    order = np.argsort(log_times, kind="stable")
    stamps_ns, log_times_ns = (
        T0 + np.round(each[order] * S).astype(np.int64) for each in (times, log_times)
    )
    found = []
    for layout in np.unique(layouts):
        places = np.flatnonzero(layouts[order] == layout)
        values, numbers = ({"j1": each[order][places]} for each in (positions, efforts))
        found.append(
            Part(f"l{layout}", stamps_ns[places], log_times_ns[places], places, values, numbers)
        )
    return found


def motion(random, times):
    """Return a smooth motion."""
    size, rate = random.uniform(0.2, 1.2), random.uniform(0.3, 3.0)
    phase = random.uniform(0.0, 6.0)
    return size * (np.sin(rate * times + phase) + 0.2 * np.sin(2.7 * times))


def drawn(random, kinds):
    """Return one of several values by name."""
    return kinds[random.choice([*kinds])]


def chattering(random, times):
    """Return efforts, most of which chatter."""
    k, smooth = np.arange(len(times)), random.uniform(0.5, 8.0) * np.cos(2.0 * times + 1.0)
    kinds = {
        "smooth": smooth,
        "clipped": np.where(k % 2, -9.5 + 0.4 * np.sin(times), 10.0),
        "every other": np.where(k % 2, 0.0, smooth),
        "every third": np.where(k % 3, smooth, 5.0),
        "noise": smooth + random.normal(0.0, 2.0, len(k)),
        "limit cycle": smooth + 4.0 * np.cos(random.uniform(2.0, 3.2) * k),
    }
    return drawn(random, kinds)


def layouts(random, count):
    """Return the number of each state's layout, as fields and names come and go."""
    k = np.arange(count)
    kinds = {
        "one": 0 * k,
        "shuffled": random.integers(0, random.integers(2, 61), count),
        "now and then": (random.random(count) < 0.05).astype(int),
        "in blocks": k // random.integers(2, count // 4) % 3,
        "every so often": (k % random.integers(2, 11) == 0).astype(int),
        "changing": np.cumsum(random.random(count) < 0.03) % 3,
    }
    return drawn(random, kinds)


def one_sender(seed):
    """Return the states of one sender, of many ways to keep time."""
    random = np.random.default_rng(seed)
    count, period = int(random.integers(150, 1000)), 1.0 / random.choice([10, 50, 100, 1000])
    k, burst = np.arange(count), int(random.integers(2, 8))
    is_burst = random.random(count // burst + 1)[k // burst] < 0.2
    gathered = (k // burst + 1) * burst - 1 + 0.02 * (k % burst)
    ways = {
        "exact": k,
        "jitter": np.sort(k + random.normal(0.0, random.uniform(0.0, 0.2), count)),
        "late": k + random.uniform(0.2, 1.0) * (random.random(count) < 0.1),
        "bursts": np.where(is_burst, gathered, k),
        "drift": k + 0.3 * np.sin(k * period),
    }
    times = np.maximum.accumulate(period * drawn(random, ways)) + 1e-7 * k
    noise = random.choice([0.0, 1e-5, 1e-3])
    positions = motion(random, times) + noise * random.normal(size=count)
    delays = {
        "steady": times + 2e-4,
        "late": np.maximum.accumulate(times + random.exponential(0.3 * period, count)),
        "in batches": np.ceil(times / (7.0 * period)) * 7.0 * period + 1e-6 * k,
    }
    log_times = drawn(random, delays)
    kept = random.random(count) > random.choice([0.0, 0.02, 0.2])
    if random.random() < 0.25:
        kept[count // 3 : count // 3 + count // 5] = False
    every = times, positions, chattering(random, times), layouts(random, count), log_times
    return parts_of(*(each[kept] for each in every))


def two_senders(seed):
    """Return the states of two senders of one joint, and how many each has."""
    random = np.random.default_rng(seed)
    duration, rates = random.uniform(5.0, 15.0), random.choice([10, 20, 50, 100], 2)
    shortest, has_same_layout = 1.0 / max(rates), random.random() < 0.5
    each = []
    for number, rate in enumerate(rates):
        times = np.arange(int(duration * rate)) / rate
        times += number * random.uniform(0.1, 0.4) * shortest
        jitter = random.choice([0.0, 0.02]) * shortest
        times = np.sort(times + jitter * random.normal(size=len(times)))
        times = times[random.random(len(times)) > random.choice([0.0, 0.02])]
        stands = number == 1 and random.random() < 0.5
        positions = 0.0 * times if stands else motion(random, times) + random.normal()
        layout = np.full(len(times), 0 if has_same_layout else number)
        each.append((times, positions, 0.0 * times, layout))
    parts = parts_of(*map(np.concatenate, zip(*each, strict=True)))
    return parts, [len(times) for times, *_ in each]
