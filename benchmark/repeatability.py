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

import numpy as np
from calibrating import calibrate, chi2_per_dof, program, turn


def compared(values, sigmas):
    """Standard deviation, root mean square sigma, chi-square over degrees of freedom."""
    return values.std(0, ddof=1), np.sqrt((sigmas**2).mean(0)), chi2_per_dof(values, sigmas)


def report(name, results, takes_weak):
    usable = [result for result in results if result and (takes_weak or result['imu_pose_calib']['status'] == 'ok')]
    if len(usable) < 2:
        print('%-28s %d of %d usable' % (name, len(usable), len(results)))
        return
    transforms = [result['transform'] for result in usable]
    p = compared(*(1e3 * np.array([t[key] for t in transforms]) for key in ('translation', 'translation_std')))
    R = compared(1e3 * np.array([turn(transforms[0]['rotation'], t['rotation']) for t in transforms]),
                 1e3 * np.array([t['rotation_std'] for t in transforms]))
    texts = [' '.join('%5.*f' % (digits, value) for value in row) for row, digits in zip(p + R, (2, 2, 1, 2, 2, 1))]
    print('%-28s %2d of %2d  p %s +- %s chi2 %s  R %s +- %s chi2 %s' % ((name, len(usable), len(results)) + tuple(texts)),
          flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('groups', nargs='+', metavar='GROUP')
    parser.add_argument('--binary', default=program('calibrate_bag'))
    parser.add_argument('--piece', type=float, default=0.0)
    parser.add_argument('--config')
    parser.add_argument('--weak', action='store_true')
    line = parser.parse_args()
    config = ['--config', line.config] if line.config else []

    def calibrated(arguments):
        return calibrate(arguments + config, binary=line.binary)

    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for group in line.groups:
            recordings = group.split(',')
            if line.piece <= 0.0:
                report(os.path.basename(recordings[0])[:28], list(pool.map(calibrated, [[r] for r in recordings])), line.weak)
                continue
            for recording in recordings:
                whole = calibrate([recording], binary=line.binary)
                count = int(whole['data']['duration'] / line.piece) if whole else 0
                pieces = [[recording, '--start', str(k * line.piece), '--duration', str(line.piece)] for k in range(count)]
                report(os.path.basename(recording)[:28], list(pool.map(calibrated, pieces)), line.weak)


if __name__ == '__main__':
    main()
