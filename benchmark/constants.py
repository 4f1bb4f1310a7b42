#!/usr/bin/env python3
"""What each constant of the core is worth: how far a result moves when one of them is doubled or halved.

  benchmark/constants.py FOLDER [--file TEXT] [BAG[@START+DURATION] ...]

FOLDER becomes a copy of this repository in which the environment can scale one constant of src/core, is built there
once (with its .catkin_ws), and calibrates recordings that it simulates, the package's sample and the bags given, with
one constant at a time twice and half as large. Prints a table: the largest move of p, R or time shift in the sigma
of the result as it is, the largest factor of these sigmas, and the verdicts that change. Names, array sizes and
constants that the compiler needs stay as they are. --file: constants whose file or name holds TEXT.
"""
import argparse
import math
import pathlib
import re
import subprocess
import tempfile

import numpy
from calibrating import ROOT, arguments_of, build_changed, calibrate, run, turn

SCALED = "IMU_POSE_CALIB_SCALED"  # NAME=FACTOR
HEADER = """#pragma once
#include <cmath>
#include <cstdlib>
#include <string>
namespace imu_pose_calib {
template <typename T>
T Scaled(const char* name, T value) {
  const char* const scaled = std::getenv("%s");
  if (scaled == nullptr) return value;
  const std::string text = scaled;
  const auto at = text.find('=');
  if (text.compare(0, at, name) != 0) return value;
  const double product = std::stod(text.substr(at + 1)) * static_cast<double>(value);
  return static_cast<T>(std::is_integral<T>::value ? std::max(1.0, std::round(product)) : product);
}
}  // namespace imu_pose_calib
""" % SCALED
DECLARATION = re.compile(r"^( *)constexpr (double|int|size_t|ptrdiff_t|Eigen::Index) (k[A-Z]\w* = [^;{}]*);",
                         re.M)
ONE = re.compile(r"(k[A-Z]\w*) = ((?:[^,()]|\([^()]*\))+)(?:, |$)", re.S)

# 30 s each; the options of simulate_bag.
SIMULATED = [
    "--motion handheld",
    "--motion handheld --pose-latency 0.002 --imu-latency 0.002 --imu-burst 5 --pose-drops 2 --clock-drift 5e-5",
    "--motion handheld --imu-wander 0.004 --imu-clock-step 0.005",
    "--motion handheld --pose-updates 0.002 --pose-sensor",
    "--motion arm --gyro-filter 20 --slow-errors 0.001 --pose-jitter 0.001 --imu-stamp-step 0.004",
    "--motion drone --vibration 2 --shocks 20 --pose-rate 50 --position-std 0.003",
    "--motion tumble --accel-filter 30 --size-effect 0.003 --scale-misalignment 0.005 --soft-mount 25",
    "--motion hinge",
]


def sources(folder):
    return sorted((folder / "src/core").rglob("*.cpp"))


def scale_all(folder):
    for path in sources(folder):
        text = path.read_text()

        def scale(match):
            named = r"\b(?:%s)\b" % "|".join(n for n, _ in ONE.findall(match[3]))
            others = text.replace(match[0], "")
            # Sizes of arrays, arguments of templates, parts of other constants.
            if re.search(r"\[[^\];\n]*%s|<[\w:,*+ ]*%s[\w,*+ ]*>|constexpr [^;]*%s" % (3 * (named,)), others):
                return match[0]
            values = ", ".join('%s = Scaled<%s>("%s:%s", %s)' % (name, match[2], path.stem, name, value.strip())
                               for name, value in ONE.findall(match[3]))
            return "%sstatic const %s %s;" % (match[1], match[2], values)

        changed = DECLARATION.sub(scale, text)
        if changed != text:
            path.write_text('#include "imu_pose_calib/core/base/scaled.h"\n' + changed)


def outcome(devel, recording, scaled):
    """Verdict, transform and its sigmas; None where nothing is written."""
    try:
        result = calibrate(recording, devel, timeout=60, **{SCALED: scaled})
    except subprocess.TimeoutExpired:
        return "timeout", None, None
    if result is None:
        return "refused", None, None
    transform = result["transform"]
    return (result["imu_pose_calib"]["status"], transform,
            numpy.array(transform["translation_std"] + transform["rotation_std"]))


def difference(a, b):
    """From one transform's p and R to another's, R as a turn about the imu's axes."""
    return numpy.concatenate([numpy.subtract(b["translation"], a["translation"]), turn(a["rotation"], b["rotation"])])


def compare(base, runs):
    """Largest move [sigma], largest factor of a sigma, verdicts that differ."""
    move, factor, verdicts = 0.0, 1.0, []
    for before, after in zip(base, runs):
        if before[0] != after[0]:
            verdicts.append("%s -> %s" % (before[0], after[0]))
        if before[1] is None or after[1] is None or "degenerate" in (before[0], after[0]):
            continue
        sigma, other = before[2], after[2]
        if (sigma <= 0.0).any() or (other <= 0.0).any():
            continue
        move = max(move, numpy.abs(difference(before[1], after[1]) / sigma).max())
        factor = max(factor, math.exp(numpy.abs(numpy.log(other / sigma)).max()))
    return move, factor, verdicts


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("bags", nargs="*")
    parser.add_argument("--file", default="")
    options = parser.parse_args()
    folder = options.folder.absolute()
    devel = build_changed(folder, "scaled.h", HEADER, scale_all)
    names = [name for path in sources(folder)
             for name in re.findall(r'Scaled<\w+(?:::\w+)?>\("([^"]*)"', path.read_text()) if options.file in name]
    with tempfile.TemporaryDirectory() as temporary:
        recordings = [arguments_of(bag) for bag in [str(ROOT / "data/estimator_own_clocks.bag")] + options.bags]
        for k, motion in enumerate(SIMULATED):
            bag = "%s/%d.bag" % (temporary, k)
            run("simulate_bag", bag, "--seed", str(700 + k), "--duration", "30", *motion.split(), devel=devel)
            sensor = ["--pose-topic", "/mocap/pose", "--pose-sensor", "/pose_sensor"] if "sensor" in motion else []
            recordings.append([bag] + sensor)

        def outcomes(scaled):
            return [outcome(devel, recording, scaled) for recording in recordings]

        base = outcomes("")
        print("| constant | doubled: move, sigma, verdicts | halved |\n|---|---|---|")
        for name in names:
            cells = []
            for value in (2.0, 0.5):
                move, factor, verdicts = compare(base, outcomes("%s=%g" % (name, value)))
                cells.append("%.2f, %.2f%s" % (move, factor, "; " + ", ".join(verdicts) if verdicts else ""))
            print("| `%s` | %s |" % (name, " | ".join(cells)), flush=True)


if __name__ == "__main__":
    main()
