#!/usr/bin/python3
"""Whether an IMU turned on its body, by nothing but turn rates: shares no code and no model with the package.

turn_rates.py [--cutoff HZ] [--piece S] [--binary calibrate_bag] BAG ...

BAG: of ROS 1; only its topics and its clock are those that calibrate_bag finds. Turn rates of the gyroscope and of the poses, both
below the cut-off, differ by a rotation, which least squares finds (Wahba's problem, residuals weighed by Cauchy's distribution):
printed as a rotation vector [mrad] from that of the first recording, of the whole recording and of pieces of it.
"""
import argparse
import os

import numpy as np
import rosbag
from calibrating import calibrate, program
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

RATE = 100.0  # [Hz] of comparison
GAP = 0.02  # [s] beyond which poses tell nothing
FASTEST = 15.0  # [rad/s] beyond which they are wrong


def read(path, result):
    """Times [s] on the poses' clock and gyroscope's rates; times and orientations of the poses."""
    data, reference = result['data'], result['clock_reference']
    gyro, poses = [], []
    for topic, message, _ in rosbag.Bag(path).read_messages():
        t = message.header.stamp.to_sec() if hasattr(message, 'header') else None
        if topic == (data['gyro_topic'] or data['imu_topic']):
            rate = message.vector if hasattr(message, 'vector') else message.angular_velocity
            shift = result['time_shift'] + result['clock_drift'] * (t - reference)
            gyro.append((t + shift, rate.x, rate.y, rate.z))
        elif topic == data['pose_topic']:
            q = message.transform.rotation if hasattr(message, 'transform') else message.pose.orientation
            poses.append((t, q.x, q.y, q.z, q.w))
    gyro, poses = np.array(gyro), np.array(poses)
    is_new = np.append(True, np.any(np.diff(poses[:, 1:], axis=0) != 0, axis=1))
    return gyro, poses[is_new & np.append(True, np.diff(poses[:, 0]) > 0)]


def low_passed(t, samples, times, cutoff):
    b, a = butter(3, 2 * cutoff / RATE)
    return filtfilt(b, a, np.stack([np.interp(times, t, column) for column in samples.T], 1), axis=0)


def rotation(of_imu, of_body):
    """R with of_body = R of_imu + bias."""
    x, y = of_imu - of_imu.mean(0), of_body - of_body.mean(0)
    weight = np.ones(len(x))
    for _ in range(8):
        U, _, V = np.linalg.svd((weight[:, None] * y).T @ x)
        R = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
        squared = np.sum((y - x @ R.T)**2, axis=1)
        weight = 1 / (1 + squared / np.median(squared))
    return Rotation.from_matrix(R)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('bags', nargs='+', metavar='BAG')
    parser.add_argument('--binary', default=program('calibrate_bag'))
    parser.add_argument('--cutoff', type=float, default=3.0)
    parser.add_argument('--piece', type=float, default=15.0)
    line = parser.parse_args()
    first = None
    for path in line.bags:
        gyro, poses = read(path, calibrate([path], binary=line.binary))
        turns = Rotation.from_quat(poses[:, 1:])
        step = np.diff(poses[:, 0])
        rates = (turns[:-1].inv() * turns[1:]).as_rotvec() / step[:, None]
        is_good = (step < GAP) & (np.linalg.norm(rates, axis=1) < FASTEST)
        middle = 0.5 * (poses[1:, 0] + poses[:-1, 0])
        times = np.arange(max(poses[0, 0], gyro[0, 0]) + 1, min(poses[-1, 0], gyro[-1, 0]) - 1, 1 / RATE)
        of_body = low_passed(middle[is_good], rates[is_good], times, line.cutoff)
        of_imu = low_passed(gyro[:, 0], gyro[:, 1:], times, line.cutoff)
        size = int(line.piece * RATE)
        spans = [slice(None)] + [slice(k, k + size) for k in range(0, len(times) - size + 1, size)]
        found = [rotation(of_imu[span], of_body[span]) for span in spans]
        first = first or found[0]
        print('%-32s' % os.path.basename(path)[:32], '  '.join('%5.1f %5.1f %5.1f' % tuple(1e3 * (first.inv() * R).as_rotvec())
                                                        for R in found), flush=True)


if __name__ == '__main__':
    main()
