#!/usr/bin/python3
"""Whether results of one pose sensor agree with each other, and with where it truly sits, the marker itself.

    benchmark/sensor_agreement.py RESULT.yaml ...      result files of calibrate_bag; their first pose sensor is compared

One row each, then: root mean square over the results and axes of what T_MS is off the identity, and of its sigmas; chi-square
over degrees of freedom about the identity, and about the weighted mean, which is 1 where the sigmas are right.
"""
import os
import sys

import numpy as np
from calibrating import chi2_per_dof, read, turn


def row(path):
    """Verdict, T_MS and its sigmas [mm], [deg], and the session."""
    sensor = read(path)['pose_sensors'][0]
    transform = sensor['transform']
    return (sensor['status'], 1e3 * np.array(transform['translation']), 1e3 * np.array(transform['translation_std']),
            np.degrees(turn((0, 0, 0, 1), transform['rotation'])), np.degrees(transform['rotation_std']), sensor['sessions'][0])


def chi2(values, sigmas):
    """Over degrees of freedom, about zero and about the weighted mean."""
    return ((values / sigmas)**2).mean(), chi2_per_dof(values, sigmas).mean()


def cell(values, digits):
    return ', '.join('%.*f' % (digits, value) for value in values)


def main():
    if len(sys.argv) < 3 or sys.argv[1].startswith('-'):
        sys.exit(__doc__)
    rows = [row(path) for path in sys.argv[1:]]
    print('| | verdict | p [mm] | sigma | R [deg] | sigma | shift [ms] | sigma | noise [mm] | drift [mm/sqrt(s), deg/sqrt(s)] |')
    print('|---' * 10 + '|')
    for path, (status, p, p_std, R, R_std, session) in zip(sys.argv[1:], rows):
        drift = '%.1f, %.2f' % (1e3 * session['drift']['position'], np.degrees(session['drift']['rotation']))
        print('| ' + ' | '.join((os.path.basename(path), status, cell(p, 1), cell(p_std, 1), cell(R, 2), cell(R_std, 2),
                                 '%.2f' % (1e3 * session['time_shift']), '%.2f' % (1e3 * session['time_shift_std']),
                                 '%.3f' % (1e3 * session['noise']['position']), drift)) + ' |')
    for name, unit, digits, k in (('p', 'mm', 1, 1), ('R', 'deg', 2, 3)):
        values, sigmas = np.array([r[k] for r in rows]), np.array([r[k + 1] for r in rows])
        print('%s: off %.*f %s, sigma %.*f; chi2/dof about the identity %.1f, about the mean %.1f' %
              ((name, digits, np.sqrt((values**2).mean()), unit, digits, np.sqrt((sigmas**2).mean())) + chi2(values, sigmas)))


if __name__ == '__main__':
    main()
