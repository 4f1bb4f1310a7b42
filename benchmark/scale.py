#!/usr/bin/python3
"""Time and memory of calibrate_bag, as a whole process, by the length of the recording.

    benchmark/scale.py
    benchmark/scale.py --durations 10 3600 --runs 5
    benchmark/scale.py --bags data/estimator_own_clocks.bag "--poses a.csv --imu b.csv" --against ../before/.catkin_ws/devel
    taskset -c 0 benchmark/scale.py -- --method gp         on one core; what follows -- goes to calibrate_bag

Prints a table in Markdown: medians over the runs of real time, user time and peak memory, and each per second of data. Of
simulated recordings it has the largest error of p over the axes, in sigmas, so that a fast wrong answer is seen. With
--against, two builds take turns; a third row has the median of the ratios within a turn, and by how many sigmas the
results are apart, which is the largest over p, R, time shift and accelerometer delay.
"""

import argparse
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time

import numpy
from calibrating import DEVEL, environment, program, read, turn

DURATIONS = (10, 30, 100, 300, 1000, 3600, 7200)  # [s]


class Build:
    """The programs of a devel or install space."""

    def __init__(self, space):
        self.space = os.path.abspath(space)
        for name in ("calibrate_bag", "simulate_bag"):
            if not os.access(program(name, self.space), os.X_OK):
                fail(f"{program(name, self.space)} cannot be run: build it, or name another devel space")

    def run(self, name, *arguments):
        """Real time [s], user time [s] and peak memory [MB]."""
        command = [program(name, self.space), *arguments]
        with tempfile.TemporaryFile() as errors:
            begin = time.monotonic()
            process = subprocess.Popen(command, env=environment(self.space), stdout=subprocess.DEVNULL, stderr=errors)
            _, status, usage = os.wait4(process.pid, 0)
            real = time.monotonic() - begin
            process.returncode = status  # it is not there any more to be waited for
            if status != 0:
                errors.seek(0)
                fail(f"{shlex.join(command)}: {errors.read().decode().strip() or f'wait status {status}'}")
        return real, usage.ru_utime, usage.ru_maxrss * 1024e-6


def fail(text):
    sys.exit(f"scale.py: error: {text}")


def in_sigmas(difference, sigma):
    """The largest of the components that are estimated."""
    difference, sigma = numpy.abs(numpy.atleast_1d(difference)), numpy.atleast_1d(sigma)
    estimated = sigma > 0.0
    return max(difference[estimated] / sigma[estimated], default=0.0)


def translation_error(result, truth):
    transform = result["transform"]
    return in_sigmas(numpy.subtract(transform["translation"], truth["translation"]), transform["translation_std"])


def apart(result, other):
    transform = result["transform"]
    turned = turn(transform["rotation"], other["transform"]["rotation"])
    scalars = ("time_shift", "accel_delay")
    return max(translation_error(result, other["transform"]), in_sigmas(turned, transform["rotation_std"]),
               *(in_sigmas(result[key] - other[key], result[key + "_std"]) for key in scalars))


def print_row(cells):
    print("| " + " | ".join(cells) + " |", flush=True)


def print_header(has_two):
    columns = ["recording", "real [s]", "user [s]", "memory [MB]", "real per s [ms]", "user per s [ms]",
               "memory per s [MB]", "p off [sigma]"]
    if has_two:
        columns = columns[:1] + ["build"] + columns[1:] + ["apart [sigma]"]
    print_row(columns)
    print("|---" * len(columns) + "|")


def measure(builds, name, recording, truth, runs, folder):
    """Prints the rows of one recording, given as arguments of calibrate_bag."""
    taken, results = [[] for _ in builds], [None for _ in builds]
    for _ in range(runs):
        for k, build in enumerate(builds):
            output = os.path.join(folder, f"{k}.yaml")
            taken[k].append(build.run("calibrate_bag", *recording, "--quiet", "--output", output))
            results[k] = read(output)
    has_two = len(builds) > 1
    for k, result in enumerate(results):
        real, user, memory = numpy.median(taken[k], axis=0)
        duration = result["data"]["duration"]
        print_row([name, *(["AB"[k]] if has_two else []), f"{real:.2f}", f"{user:.2f}", f"{memory:.0f}",
                   f"{1e3 * real / duration:.1f}", f"{1e3 * user / duration:.1f}", f"{memory / duration:.2f}",
                   f"{translation_error(result, truth):.2f}" if truth else "", *([""] if has_two else [])])
    if has_two:
        ratios = numpy.median(numpy.divide(*taken), axis=0)
        print_row([name, "A / B", *(f"{ratio:.2f}" for ratio in ratios), "", "", "", "", f"{apart(*results):.3f}"])


def positive(kind):
    def parse(text):
        value = kind(text)
        if not 0 < value < math.inf:
            raise argparse.ArgumentTypeError(f"{text} must be positive")
        return value
    parse.__name__ = kind.__name__  # for argparse's message
    return parse


def main():
    own, passed = sys.argv[1:], []
    if "--" in own:
        own, passed = own[: own.index("--")], own[own.index("--") + 1 :]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--durations", type=positive(float), nargs="+", default=DURATIONS, metavar="S",
                        help="of simulated recordings")
    parser.add_argument("--bags", nargs="+", default=(), metavar="BAG",
                        help="in place of these; each as calibrate_bag takes it, with options when in quotes")
    parser.add_argument("--runs", type=positive(int), default=3, metavar="N", help="of each recording and build")
    parser.add_argument("--devel", default=DEVEL, metavar="DIR", help="devel or install space; default: %(default)s")
    parser.add_argument("--against", metavar="DIR", help="the same of another build")
    arguments = parser.parse_args(own)

    builds = [Build(space) for space in (arguments.devel, arguments.against) if space]
    print_header(len(builds) > 1)
    with tempfile.TemporaryDirectory() as folder:
        for bag in arguments.bags:
            recording = shlex.split(bag)
            name = os.path.basename(next(part for part in recording if not part.startswith("--")).rstrip("/"))
            measure(builds, name, recording + passed, None, arguments.runs, folder)
        for duration in () if arguments.bags else arguments.durations:
            bag = os.path.join(folder, "sim.bag")
            builds[0].run("simulate_bag", bag, "--duration", str(duration), "--seed", "7")
            truth = read(os.path.join(folder, "sim.truth.yaml"))
            measure(builds, f"{duration:g} s", [bag] + passed, truth, arguments.runs, folder)


if __name__ == "__main__":
    main()
