#!/usr/bin/python3
"""Pose sensors: calibrate_bag against the hand-eye calibrations of OpenCV, on simulated recordings.

    benchmark/hand_eye.py                     no outliers, then 20 % of the sensor's poses off by some 0.1 m and 0.3 rad
    benchmark/hand_eye.py --step 0.1          more pairs of poses for OpenCV
    benchmark/hand_eye.py --chain             T_MI itself against T_MS * T_SI, with T_SI of the imu and the sensor's poses

A recording has marker poses T_WM (100 Hz, 1 mm, 1 mrad per axis) and those of a camera T_VS (30 Hz, 5 mm, 5 mrad per axis) on a
clock 30 ms off. OpenCV gets a pose of the camera every --step seconds, or all, where the cost is linear in their number, and that of the
marker interpolated at its time, which is shifted by the truth, by the correlation of the magnitudes of the turn rates (as
ethz-asl/hand_eye_calibration does), or not. calibrate_bag gets both files, no IMU and no shift. RANSAC: PARK on samples of 8
of all pairs, then SHAH on those that agree. Prints, in Markdown, root mean square errors over the seeds, and in brackets times
that of calibrate_bag. Needs python3-opencv.
"""

import argparse
import os
import sys
import tempfile

import cv2
import numpy
from calibrating import DEVEL, ROOT, calibrate, read, run

sys.path.insert(0, str(ROOT / "scripts"))
from comparison import rotation, transform  # noqa: E402

HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
ROBOT_WORLD = ("SHAH", "LI")
ALL = ", all poses"
OUTLIERS = 0.2  # of the sensor's poses
AGREE = (0.03, 0.03)  # [m], [rad] from the median world: RANSAC


def exp(v):
    return cv2.Rodrigues(numpy.asarray(v, float))[0]


def log(R):
    return cv2.Rodrigues(R)[0].ravel()


def read_poses(path):
    """Times [s] after 1.6e9, when simulate_bag begins, and poses 4 x 4 of a TUM file."""
    with open(path) as file:
        rows = [line.split() for line in file if not line.startswith("#")]
    times = numpy.array([int(row[0].replace(".", "")) * 1e-9 - 1.6e9 for row in rows])  # nine decimals
    return times, numpy.array([transform(rotation(values[3:]), values[:3]) for values in numpy.array(rows, float)[:, 1:]])


def spoil(path, seed):
    """Makes outliers of some poses of a TUM file, noise with the sigmas that the simulator gives its own."""
    random = numpy.random.default_rng(seed)
    with open(path) as file:
        lines = file.read().splitlines()
    for k in range(1, len(lines)):
        if random.random() >= OUTLIERS:
            continue
        row = lines[k].split()
        p = numpy.array(row[1:4], float) + 0.1 * random.standard_normal(3)
        R = rotation(row[4:]) @ exp(0.3 * random.standard_normal(3))
        v = log(R)
        angle = numpy.linalg.norm(v)
        q = [*(numpy.sin(0.5 * angle) * v / angle), numpy.cos(0.5 * angle)]
        lines[k] = " ".join([row[0], *(f"{x:.12g}" for x in [*p, *q])])
    with open(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def interpolate(times, poses, t):
    k = min(max(int(numpy.searchsorted(times, t)), 1), len(times) - 1)
    u = (t - times[k - 1]) / (times[k] - times[k - 1])
    T = numpy.eye(4)
    T[:3, :3] = poses[k - 1, :3, :3] @ exp(u * log(poses[k - 1, :3, :3].T @ poses[k, :3, :3]))
    T[:3, 3] = (1 - u) * poses[k - 1, :3, 3] + u * poses[k, :3, 3]
    return T


def rates(times, poses, period=0.01):
    """Magnitude of the turn rate [rad/s] over 0.1 s, median of nine, every `period` seconds of the poses."""
    step = max(1, round(0.1 / float(numpy.median(numpy.diff(times)))))
    turns = [numpy.linalg.norm(log(a[:3, :3].T @ b[:3, :3])) for a, b in zip(poses, poses[step:])]
    values = numpy.array(turns) / (times[step:] - times[:-step])
    values = numpy.median(numpy.lib.stride_tricks.sliding_window_view(numpy.pad(values, 4, mode="edge"), 9), axis=1)
    middle = 0.5 * (times[step:] + times[:-step])
    grid = numpy.arange(middle[0], middle[-1], period)
    return grid[0], numpy.interp(grid, middle, values)


def correlated_shift(marker, sensor, period=0.01):
    """[s] t_marker = t_sensor + shift, where the magnitudes of the rates correlate best; a parabola refines the peak."""
    (first, a), (second, b) = (rates(*stream, period) for stream in (marker, sensor))
    values = numpy.correlate(a - a.mean(), b - b.mean(), "full")
    k = int(values[1:-1].argmax()) + 1
    before, peak, after = values[k - 1 : k + 2]
    return first - second + period * (k - len(b) + 1 + 0.5 * (before - after) / (before - 2 * peak + after))


def hand_eye(method, T_WM, T_VS):
    """T_MS. The marker is the gripper, W its base, the sensor the camera, and V the target that it sees."""
    T_SV = numpy.linalg.inv(T_VS)
    T = numpy.eye(4)
    if method in ROBOT_WORLD:
        T_MW = numpy.linalg.inv(T_WM)
        _, _, T[:3, :3], t = cv2.calibrateRobotWorldHandEye(
            T_SV[:, :3, :3], T_SV[:, :3, 3:], T_MW[:, :3, :3], T_MW[:, :3, 3:],
            method=getattr(cv2, "CALIB_ROBOT_WORLD_HAND_EYE_" + method))
        T[:3, 3] = t.ravel()
        return numpy.linalg.inv(T)
    T[:3, :3], t = cv2.calibrateHandEye(T_WM[:, :3, :3], T_WM[:, :3, 3:], T_SV[:, :3, :3], T_SV[:, :3, 3:],
                                        method=getattr(cv2, "CALIB_HAND_EYE_" + method))
    T[:3, 3] = t.ravel()
    return T


def agreeing(T_MS, T_WM, T_VS):
    """Pairs whose world V seen from W, at the body, is near the median one."""
    T_WS = T_WM @ T_MS
    R_WV = T_WS[:, :3, :3] @ T_VS[:, :3, :3].transpose(0, 2, 1)
    turns = numpy.array([log(R_WV[0].T @ R) for R in R_WV])
    turn = numpy.median(turns, axis=0)
    R = R_WV[0] @ exp(turn)
    offsets = T_WS[:, :3, 3] - T_VS[:, :3, 3] @ R.T
    far = numpy.linalg.norm(offsets - numpy.median(offsets, axis=0), axis=1)
    return (far < AGREE[0]) & (numpy.linalg.norm(turns - turn, axis=1) < AGREE[1])


def ransac(T_WM, T_VS, seed, trials=100, size=8):
    random = numpy.random.default_rng(seed)
    best = numpy.ones(len(T_WM), bool)
    most = 0
    for _ in range(trials):
        chosen = random.choice(len(T_WM), size, replace=False)
        T_MS = hand_eye("PARK", T_WM[chosen], T_VS[chosen])
        if not numpy.isfinite(T_MS).all():
            continue
        agree = agreeing(T_MS, T_WM, T_VS)
        if agree.sum() > most:
            best, most = agree, agree.sum()
    for _ in range(3):
        if best.sum() >= size:
            best = agreeing(hand_eye("SHAH", T_WM[best], T_VS[best]), T_WM, T_VS)
    return hand_eye("SHAH", T_WM[best], T_VS[best])


def errors(T, truth):
    """[mm], [mrad]"""
    return [1e3 * numpy.linalg.norm(T[:3, 3] - truth[:3, 3]), 1e3 * numpy.linalg.norm(log(truth[:3, :3].T @ T[:3, :3]))]


def rms(values):
    return numpy.sqrt(numpy.mean(numpy.square(values), axis=0))


def of_yaml(entry):
    return transform(rotation(entry["rotation"]), entry["translation"])


class Recording:
    """A simulated recording and what OpenCV makes of it."""

    def __init__(self, line, folder, seed, has_outliers):
        name = os.path.join(folder, "sim")
        run("simulate_bag", name, "--format", "text", "--pose-sensor", "--seed", str(seed), "--duration",
            str(line.duration), devel=line.devel)
        self.marker, self.sensor, self.imu = name + ".poses.txt", name + ".pose_sensor.txt", name + ".imu.csv"
        if has_outliers:
            spoil(self.sensor, seed)
        truth = read(name + ".truth.yaml")
        self.T_MI, self.T_MS = of_yaml(truth), of_yaml(truth["pose_sensors"][0])
        self.poses = read_poses(self.marker), read_poses(self.sensor)
        self.shifts = {"true shift": truth["pose_sensors"][0]["time_shift"],
                       "correlated": correlated_shift(*self.poses), "no shift": 0.0}
        self.step, self.seed = line.step, seed

    def pairs(self, shift, step):
        times, poses = self.poses[1]
        stride = max(1, round(step / float(numpy.median(numpy.diff(times)))))
        first, last = self.poses[0][0][[0, -1]]
        chosen = [k for k in range(0, len(times), stride) if first <= times[k] + shift <= last]
        return numpy.array([interpolate(*self.poses[0], times[k] + shift) for k in chosen]), poses[chosen]

    def opencv(self, has_outliers):
        """T_MS by shift and method."""
        found = {}
        for name, shift in self.shifts.items():
            some, every = self.pairs(shift, self.step), self.pairs(shift, 0.0)
            for method in HAND_EYE + ROBOT_WORLD:
                found[name, method] = hand_eye(method, *some)
            for method in ROBOT_WORLD:
                found[name, method + ALL] = hand_eye(method, *every)
            if has_outliers:
                found[name, "RANSAC" + ALL] = ransac(*every, self.seed)
        return found


def print_hand_eye(line, has_outliers):
    table, own, shifts, sigmas = {}, [], [], []
    for seed in range(1, line.seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            recording = Recording(line, folder, seed, has_outliers)
            result = calibrate(["--poses", recording.marker, "--pose-sensor", recording.sensor], line.devel)
            for key, T_MS in recording.opencv(has_outliers).items():
                table.setdefault(key, []).append(errors(T_MS, recording.T_MS))
        sensor = result["pose_sensors"][0]
        transform, true_shift = sensor["transform"], recording.shifts["true shift"]
        own.append(errors(of_yaml(transform), recording.T_MS))
        sigmas.append([1e3 * numpy.linalg.norm(transform[key]) for key in ("translation_std", "rotation_std")])
        shifts.append([recording.shifts["correlated"] - true_shift, sensor["sessions"][0]["time_shift"] - true_shift])
    best, names = rms(own), list(recording.shifts)
    print(f"\n{line.seeds} recordings of {line.duration:g} s, " + (f"{100 * OUTLIERS:g} % outliers" if has_outliers
                                                                     else "no outliers") + "; p [mm], R [mrad]:\n")
    print("| | " + " | ".join(f"{kind}, {name}" for name in names for kind in "pR") + " |\n|---" + "|---" * 6 + "|")
    for method in dict.fromkeys(method for _, method in table):
        cells = [f"{value:.2f} ({value / own_value:.1f})" for name in names
                 for value, own_value in zip(rms(table[name, method]), best)]
        print(f"| {method} | " + " | ".join(cells) + " |")
    print(f"| calibrate_bag, no shift given | {best[0]:.2f} | {best[1]:.2f} | | | | |")
    stated, shift = rms(sigmas), 1e3 * rms(shifts)
    print(f"\nSigmas of calibrate_bag: {stated[0]:.2f} mm, {stated[1]:.2f} mrad. Errors of the time shift: correlated "
          f"{shift[0]:.3f} ms, calibrate_bag {shift[1]:.3f} ms.", flush=True)


def print_chain(line):
    rows = {}
    for seed in range(1, line.seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            recording = Recording(line, folder, seed, False)
            direct = calibrate(["--poses", recording.marker, "--imu", recording.imu, "--pose-sensor", recording.sensor],
                               line.devel)
            camera = calibrate(["--poses", recording.sensor, "--imu", recording.imu], line.devel)
            opencv = recording.opencv(False)
        T_SI, T_MS = of_yaml(camera["transform"]), of_yaml(direct["pose_sensors"][0]["transform"])
        true_T_SI = numpy.linalg.inv(recording.T_MS) @ recording.T_MI
        found = {"T_MI itself": of_yaml(direct["transform"]), "T_MS * T_SI, T_MS of calibrate_bag": T_MS @ T_SI}
        found.update((f"T_MS * T_SI, T_MS of {method}, {name}", T @ T_SI) for (name, method), T in opencv.items())
        for name, T in found.items():
            rows.setdefault(name, []).append(errors(T, recording.T_MI))
        rows.setdefault("T_SI alone", []).append(errors(T_SI, true_T_SI))
        stated = [1e3 * numpy.linalg.norm(direct["transform"][key]) for key in ("translation_std", "rotation_std")]
        rows.setdefault("sigmas of T_MI itself", []).append(stated)
    best = rms(rows["T_MI itself"])
    print(f"\n{line.seeds} recordings of {line.duration:g} s:\n\n| | p [mm] | R [mrad] |\n|---|---|---|")
    for name, values in rows.items():
        print(f"| {name} | " + " | ".join(f"{v:.3f} ({v / b:.1f})" for v, b in zip(rms(values), best)) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, metavar="N")
    parser.add_argument("--duration", type=float, default=40.0, metavar="S", help="of a recording")
    parser.add_argument("--step", type=float, default=0.3, metavar="S", help="between the poses that OpenCV gets")
    parser.add_argument("--chain", action="store_true")
    parser.add_argument("--devel", default=DEVEL, metavar="DIR", help="devel or install space; default: %(default)s")
    line = parser.parse_args()
    if line.chain:
        print_chain(line)
    else:
        print_hand_eye(line, False)
        print_hand_eye(line, True)


if __name__ == "__main__":
    main()
