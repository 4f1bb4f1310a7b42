#!/usr/bin/python3
"""Whether recordings of one mount agree, and pieces of them: scatter of p and R against their sigmas.

repeatability.py [--binary calibrate_bag] [--piece S] [--weak] [--config FILE] GROUP ...

GROUP: recordings of one mount with commas between. One row each: standard deviation between the recordings and mean sigma of p
[mm] along the marker axes and of R [mrad] about the imu axes, and chi-square over degrees of freedom about the weighted mean,
which is 1 where the sigmas are right. --piece 20: pieces of 20 s of every recording instead, one row a recording. Results that are
not `ok`, as of pieces in which the body hardly turns, are counted, not compared, as their sigmas are in doubt; --weak: compared, too.
"""
import argparse
import concurrent.futures
import os
import subprocess
import sys
import tempfile

import numpy as np
import yaml


def duration(binary, recording):
    """[s] of the poses."""
    result = calibrate(binary, recording, [])
    return result['data']['duration'] if result else 0.0


def calibrate(binary, recording, arguments):
    """The result file's content; None when it is refused."""
    with tempfile.TemporaryDirectory() as folder:
        output = os.path.join(folder, 'result.yaml')
        done = subprocess.run([binary, recording, '--output', output, '--quiet'] + arguments, stdout=subprocess.DEVNULL,
                              stderr=subprocess.PIPE, universal_newlines=True)
        if done.returncode == 2:
            return None
        if done.returncode != 0:
            sys.exit(done.stderr)
        with open(output) as file:
            return yaml.safe_load(file)


def rotation_vector(first, second):
    """Of first^-1 second, quaternions x, y, z, w."""
    (x1, y1, z1, w1), (x2, y2, z2, w2) = first, second
    v = np.array([w1 * x2 - x1 * w2 - y1 * z2 + z1 * y2, w1 * y2 + x1 * z2 - y1 * w2 - z1 * x2,
                  w1 * z2 - x1 * y2 + y1 * x2 - z1 * w2])
    w = w1 * w2 + x1 * x2 + y1 * y2 + z1 * z2
    norm = np.linalg.norm(v)
    return v * (2.0 * np.arctan2(norm, abs(w)) / norm * np.sign(w) if norm > 0.0 else 0.0)


def compared(values, sigmas):
    """Standard deviation, root mean square sigma, chi-square over degrees of freedom."""
    weights = 1.0 / sigmas**2
    mean = (weights * values).sum(0) / weights.sum(0)
    return values.std(0, ddof=1), np.sqrt((sigmas**2).mean(0)), (((values - mean) / sigmas)**2).sum(0) / (len(values) - 1)


def report(name, results, takes_weak):
    usable = [result for result in results if result and (takes_weak or result['imu_pose_calib']['status'] == 'ok')]
    if len(usable) < 2:
        print('%-28s %d of %d usable' % (name, len(usable), len(results)))
        return
    transforms = [result['transform'] for result in usable]
    p = compared(*(1e3 * np.array([t[key] for t in transforms]) for key in ('translation', 'translation_std')))
    R = compared(1e3 * np.array([rotation_vector(transforms[0]['rotation'], t['rotation']) for t in transforms]),
                 1e3 * np.array([t['rotation_std'] for t in transforms]))
    texts = [' '.join('%5.*f' % (digits, value) for value in row) for row, digits in zip(p + R, (2, 2, 1, 2, 2, 1))]
    print('%-28s %2d of %2d  p %s +- %s chi2 %s  R %s +- %s chi2 %s' % ((name, len(usable), len(results)) + tuple(texts)),
          flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('groups', nargs='+', metavar='GROUP')
    parser.add_argument('--binary', default=os.path.join(os.path.dirname(os.path.abspath(__file__)), '..', '.catkin_ws',
                                                         'devel', 'lib', 'imu_pose_calib', 'calibrate_bag'))
    parser.add_argument('--piece', type=float, default=0.0)
    parser.add_argument('--config')
    parser.add_argument('--weak', action='store_true')
    line = parser.parse_args()
    config = ['--config', line.config] if line.config else []
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for group in line.groups:
            recordings = group.split(',')
            if line.piece <= 0.0:
                report(os.path.basename(recordings[0])[:28],
                       list(pool.map(lambda r: calibrate(line.binary, r, config), recordings)), line.weak)
                continue
            for recording in recordings:
                count = int(duration(line.binary, recording) / line.piece)
                spans = [['--start', str(k * line.piece), '--duration', str(line.piece)] for k in range(count)]
                report(os.path.basename(recording)[:28],
                       list(pool.map(lambda span: calibrate(line.binary, recording, span + config), spans)), line.weak)


if __name__ == '__main__':
    main()
