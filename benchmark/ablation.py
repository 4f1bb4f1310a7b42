#!/usr/bin/env python3
"""What each rule of the estimator is worth: the table of doc/math.md, "Ablation".

  benchmark/ablation.py FOLDER [--mixtures 40] [--first 9001] [--rules NAME,...] [--group NAME=BAG[@START+DURATION],...]

FOLDER becomes a copy of this repository in which each rule below can be switched off by the environment, is built there
once (with its .catkin_ws), and run without one rule at a time: `reality --dump` on simulated mixtures and plain motions,
and calibrate_bag on each group of recordings, or parts of them, of one mount, which must agree. Prints a table.
A rule whose text is no longer in the source is an error: mend or delete its row.
"""
import argparse
import math
import os
import pathlib
import subprocess
import sys

import numpy
from calibrating import arguments_of, build_changed, calibrate, chi2_per_dof, program, turn

SWITCH = "IMU_POSE_CALIB_ABLATED"
HEADER = """#pragma once
#include <cstdlib>
#include <string>
namespace imu_pose_calib {
inline bool Ablated(const std::string& rule) {
  const char* const ablated = std::getenv("%s");
  return ablated != nullptr && ablated == rule;
}
}  // namespace imu_pose_calib
""" % SWITCH

C, T, D, S, V = ("src/core/%s/" % room for room in ("calibration", "trajectory", "data", "start", "verdict"))
# Name: what it does, file, text, the same with the rule switched off where OFF stands.
RULES = {
    "weights around": ("IMU samples weigh by those around, too", C + "joint_noise.cpp",
                       "is_pose ? 0.0 : 0.5 *", "is_pose || OFF ? 0.0 : 0.5 *"),
    "weight one": ("weights by the residuals of weight one", C + "least_squares.cpp",
                   "ToUsualWeight(leverage,", "ToUsualWeight(OFF ? 0.0 : leverage,"),
    "slow errors": ("the sigma of slow errors of rotations is found", C + "joint_noise.cpp",
                    "std::max(kLeastSlowError, std::sqrt(x.back()))",
                    "!is_linear && OFF ? kLeastSlowError : std::max(kLeastSlowError, std::sqrt(x.back()))"),
    "slow position errors": ("the sigma of slow errors of positions is found", C + "joint_noise.cpp",
                             "std::max(kLeastSlowError, std::sqrt(x.back()))",
                             "is_linear && OFF ? kLeastSlowError : std::max(kLeastSlowError, std::sqrt(x.back()))"),
    "spectra": ("noise from the spectra of residuals", C + "joint_noise.cpp",
                "    (*statistics)[sensors[k]].noise =\n", "    if (!OFF) (*statistics)[sensors[k]].noise =\n"),
    "band of poses": ("poses lose what is beyond the band of the IMU", C + "band.cpp",
                      "const bool is_position_lower = LowerCutoff(", "const bool is_position_lower = !OFF && LowerCutoff("),
    "trajectory's variance": ("outliers are measured by the noise alone", C + "least_squares.cpp",
                              "    const double own2 = std::max(", "    const double own2 = OFF ? spread2 : std::max("),
    "stated noise": ("noise that poses state is taken where it tells", T + "pose_trajectory.cpp",
                     "    if (covariance > 0.5 * variance) return;", "    if (OFF || covariance > 0.5 * variance) return;"),
    "spikes of poses": ("gross outliers leave before the GP", T + "pose_trajectory.cpp",
                        "  RemoveSpikes(options.outlier_threshold, data);", "  if (!OFF) RemoveSpikes(options.outlier_threshold, data);"),
    "local median": ("residuals are compared with those near", T + "pose_trajectory.cpp",
                     "(is_beyond && residuals[i].array() > bound(begin, end)).any()",
                     "(OFF || (is_beyond && residuals[i].array() > bound(begin, end)).any())"),
    "several starts": ("length scales are sought from several starts", T + "gp_hyperparameters.cpp",
                       "    if (is_fixed[0]) break;", "    if (is_fixed[0] || (OFF && starts.size() == 6)) break;"),
    "flipped": ("segments that turn against the gyroscope leave", S + "preparation.cpp",
                "  RemoveFlippedSegments(options", "  if (!OFF) RemoveFlippedSegments(options"),
    "steps of clocks": ("the walk is cut at steps", S + "clock_walk.cpp", "  CutAtSteps(trajectory", "  if (!OFF) CutAtSteps(trajectory"),
    "saturated": ("clipped samples leave", D + "conditioning.cpp", "    RemoveSaturated(stream", "    if (!OFF) RemoveSaturated(stream"),
    "spikes of imus": ("lone wild samples leave", D + "conditioning.cpp", "    RemoveSpikes(&kept, report);", "    if (!OFF) RemoveSpikes(&kept, report);"),
    "updates": ("poses that tell nothing new leave", D + "conditioning.cpp", "  out.pose_report.between_updates = KeepOneOf(",
                "  if (!OFF) out.pose_report.between_updates = KeepOneOf("),
    "second count": ("frames are counted again by the latencies found", D + "source_clock.cpp", "  count = CountAgain(count, latency, period);",
                     "  if (!OFF) count = CountAgain(count, latency, period);"),
    "credible": ("missing frames must be credible", D + "source_clock.cpp", "  if (!AreJumpsCredible(", "  if (!OFF && !AreJumpsCredible("),
    "coarse period": ("the period is searched widely", D + "source_clock.cpp", "double low = 0.75, high = 1.02;", "double low = OFF ? 0.98 : 0.75, high = 1.02;"),
    "fine period": ("and finely", D + "source_clock.cpp", "memory <= kMemory; memory *= 3", "memory <= (OFF ? kMemory / 3 : kMemory); memory *= 3"),
    "vote": ("recovered stamps must make samples smoother", D + "stamp_recovery.cpp", "!IsSmoother(frames, *recovered)",
             "(!OFF && !IsSmoother(frames, *recovered))"),
    "stamps": ("even clocks are recovered", D + "stamp_recovery.cpp", "  if (mode == StampRecovery::kNever ||", "  if (OFF || mode == StampRecovery::kNever ||"),
    "tails of walks": ("increments and offsets have heavy tails", S + "clock_walk.cpp", "iteration < kReweightings",
                       "iteration < (OFF ? 1 : kReweightings)"),
    "rounds of walks": ("walks are found again about the one before", S + "clock_walk.cpp", "round < kRounds; ++round",
                        "round < (OFF ? 1 : kRounds); ++round"),
    "moved": ("trajectories move to the solution", C + "joint_solver.cpp", "        MoveTrajectories();",
              "        if (!OFF || pass == 1) MoveTrajectories();"),
    "halves": ("halves that disagree enlarge sigmas", V + "doubts.cpp", "  if (marginals.halves_sigmas <= kAgreementBound) return marginals;",
               "  if (OFF || marginals.halves_sigmas <= kAgreementBound) return marginals;"),
    "shorter steps": ("noise that goes to and fro moves by less", C + "joint_noise.cpp",
                      "share > 0.0 ?", "!OFF && share > 0.0 ?"),
    "shocks": ("spectra of IMUs are of weighed residuals", C + "least_squares.cpp", "      else  // a shock is no noise",
               "      else if (!OFF)  // a shock is no noise"),
    "cumulants": ("poses have third and fourth cumulants of time", C + "estimate.cpp",
                  "  const auto found = kSwitches.find(kind);",
                  "  if (OFF && (kind == ParameterKind::kPoseCumulants || kind == ParameterKind::kPositionCumulants)) return false;\n"
                  "  const auto found = kSwitches.find(kind);"),
}


def switch(folder):
    for name, (_, path, text, switched) in RULES.items():
        source = (folder / path).read_text()
        if source.count(text) != 1:
            sys.exit("error: rule '%s': its text is %d times in %s, must be once" % (name, source.count(text), path))
        source = source.replace(text, switched.replace("OFF", 'Ablated("%s")' % name))
        include = '#include "imu_pose_calib/core/base/ablated.h"\n'
        if include not in source:
            source = source.replace("#include", include + "#include", 1)
        (folder / path).write_text(source)


def simulated(devel, rule, options):
    """{seed: (verdict, error of p [mm], largest error [sigma], sigma of p [mm])}"""
    text = subprocess.run([program("reality", devel), "--dump", str(options.mixtures), str(options.first)],
                          env={**os.environ, SWITCH: rule}, check=True, capture_output=True, text=True).stdout
    (options.folder / ("dump of " + (rule or "all"))).write_text(text)
    rows = [line.split() for line in text.splitlines()]
    return {int(r[0]): (r[1], float(r[2]), float(r[4]), float(r[5])) for r in rows}


def recorded(devel, rule, bags):
    """Scatter of p [mm] and chi2 per degree of freedom of p and of R between calibrations of one mount; not a number
    when one of them gives no result."""
    results = [calibrate(arguments_of(bag), devel, **{SWITCH: rule}) for bag in bags]
    if None in results:
        return math.nan, math.nan, math.nan
    transforms = [result["transform"] for result in results]
    p = 1e3 * numpy.array([t["translation"] for t in transforms])
    turns = [turn(transforms[0]["rotation"], t["rotation"]) for t in transforms]
    return (numpy.linalg.norm(numpy.std(p, axis=0, ddof=1)),
            chi2_per_dof(p, [1e3 * numpy.array(t["translation_std"]) for t in transforms]).mean(),
            chi2_per_dof(turns, [t["rotation_std"] for t in transforms]).mean())


def rms(values):
    return math.sqrt(sum(v * v for v in values) / len(values))


def row(name, text, runs, base, groups, base_groups):
    """Of mixtures, of plain recordings and of each effect alone: ratio of the error of p, rms over the sigmas of the
    estimator as it is, and rms of the largest error by its own sigma."""
    cells = [name, text, "%d" % sum(r[0] == "ok" for r in runs.values()),
             "%d" % sum(r[0] == "ok" and r[2] > 3.5 for r in runs.values())]
    for kind in range(3):
        usable = [k for k in base if k // 1000000 == kind and {base[k][0], runs[k][0]} <= {"ok", "weak"}]
        ratio = rms([runs[k][1] / base[k][3] for k in usable]) / rms([base[k][1] / base[k][3] for k in usable])
        cells += ["%.2f" % ratio, "%.2f" % rms([runs[k][2] for k in usable])]
    for (sd, chi2_p, chi2_R), (base_sd, _, _) in zip(groups, base_groups):
        cells += ["%.2f" % (sd / base_sd), "%.1f" % chi2_p, "%.1f" % chi2_R]
    print("| " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--mixtures", type=int, default=40)
    parser.add_argument("--first", type=int, default=9001)
    parser.add_argument("--rules", default=",".join(RULES))
    parser.add_argument("--group", action="append", default=[])
    options = parser.parse_args()
    devel = build_changed(options.folder.absolute(), "ablated.h", HEADER, switch)
    subprocess.run(["make", "-C", str(devel.parent / "build"), "reality"], check=True)
    groups = [g.partition("=") for g in options.group]
    print("| without | | ok | wrong and ok |" +
          "".join(" %s: rms p | rms sigma |" % kind for kind in ("mixtures", "plain", "effects")) +
          "".join(" %s: sd | chi2 p | chi2 R |" % g[0] for g in groups))
    print("|---|---|" + "---|" * (8 + 3 * len(groups)))

    def run(rule):
        return simulated(devel, rule, options), [recorded(devel, rule, g[2].split(",")) for g in groups]

    base, base_groups = run("")
    row("none", "as it is", base, base, base_groups, base_groups)
    for name in options.rules.split(","):
        runs, of_groups = run(name)
        row(name, RULES[name][0], runs, base, of_groups, base_groups)


if __name__ == "__main__":
    main()
