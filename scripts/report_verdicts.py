"""Verdicts of report.py: each figure is judged by a number beside its bounds, which follow from what is expected
of data that are as the solve takes them to be."""

from collections import namedtuple
from statistics import NormalDist

import numpy as np
from comparison import AGREEMENT, chi_square
from report_axes import QUANTITIES, residuals, sensor, stamps

GOOD, LOOK, BAD = 'good', 'look', 'bad'
# `value` and `bounds` in words; `why`: what makes it harmless while the result is ok, or else what to do.
Verdict = namedtuple('Verdict', 'level value bounds why harmless', defaults=(True,))

# --- Bounds: from where on to look, and from where on it is bad ---

# Ratio to the noise of the solve, 1 when the model holds. At 2, what the model lacks is sqrt(3) of the noise and
# outweighs it; at 5, one sigma of the solve is what differences of calibrations are judged by (AGREEMENT).
NOISE = (2, 5)
# Share of samples at less than half weight. A share e that errs to one side moves a robust mean by up to 1.25 e
# sigma: 0.01 and 0.13.
WEIGHED_DOWN = (0.01, 0.1)
# Share within 3 sigma, which of a normal distribution is 0.9973: what 2.5 and 2 sigma hold. Less: the noise is
# that of a distribution 1.2 and 1.5 times as wide.
WITHIN_3_SIGMA = (0.9876, 0.9545)
# By how many sigma of its noise the next best time shift is less likely: beyond chance, and as calibrations agree.
NEXT_PEAK = (5, 3)
# Seconds between the best correlation and the result: the step of what is correlated, and four of it.
PEAK_OFFSET = (0.005, 0.02)
# Share of the samples that the rate promises which is used. Sigmas grow by its root: 5 % and 41 %.
USED = (0.9, 0.5)
# Jitter in periods: as data_check.cpp warns, and where the order of samples is lost.
JITTER = (0.3, 1.0)
# Power of the data with which sigmas fall over the second half; 1/2 for steady motion. Half and twice that; four
# times: what was recorded last decides.
GROWTH = (0.25, 1, 2)
# Differences in their sigmas: where chance ends, 3 sigma, see largest() and chi_square(); and as calibrations
# disagree, AGREEMENT.
# Sigma over its bound of the verdict.
SIGMA = (1, 5)
# Share of poses dropped: as data_check.cpp warns of outliers, and max_bad_fraction.
DROPPED = (0.03, 0.1)
# Share of the time in which the trajectory is known better than by one pose alone.
KNOWN = (0.95, 0.5)
# Turn rate, rms [rad/s], of the axes about which it turns less: 30 degrees in a second, as the recording guide
# asks; and what is rest to data_check.cpp.
TURNS = (0.5, 0.05)
# Share of the variance of turn rates that the other sensor has: as data_check.cpp warns, and half.
EXPLAINED = (0.8, 0.5)


def level(value, bounds):
    """Of a value that is the better the smaller, or with bounds that fall, the larger it is."""
    sign = 1 if bounds[1] > bounds[0] else -1
    return BAD if sign * value > sign * bounds[1] else LOOK if sign * value > sign * bounds[0] else GOOD


def ranges(bounds, form='%g', factor=1):
    first, second = (form % (factor * bound) for bound in bounds)
    return 'good %s %s, bad %s %s' % (('to', first, 'from', second) if bounds[1] > bounds[0] else
                                      ('from', first, 'below', second))


def largest(count):
    """Bounds of the largest of `count` normal values in its sigma; chance exceeds the first as rarely as one value
    exceeds 3 sigma."""
    return min(AGREEMENT, NormalDist().inv_cdf(1 - (1 - NormalDist().cdf(3)) / count)), AGREEMENT


def worst_of(session, imu, number, largest=True):
    """Largest or least `number(quantity)` of the sensors, and what the sensor is called."""
    found = [(number(q), QUANTITIES[q][0]) for q in QUANTITIES if sensor(session, q, imu)]
    found = [x for x in found if x[0] is not None and np.isfinite(x[0])]
    return (max if largest else min)(found) if found else (None, '')


# --- Of each figure; None: not judged ---

def signals(report, s, imu, spectrum):
    session = report.head['sessions'][s]
    value, quantity = max((x['rms'] / x['noise'], q) for q in ('gyro', 'accel') for x in [sensor(session, q, imu)])
    _, r, weight = residuals(report, s, quantity, imu)
    noise = sensor(session, quantity, imu)['noise']
    why, harmless = 'vibration, a filter or a loose mount, which the model lacks', False
    if level(np.sqrt(np.mean(r[weight >= 0.5] ** 2)) / noise, NOISE) == GOOD:
        why, harmless = 'what is far off has little weight', True
    elif level(in_band(report, s, imu, quantity, spectrum)[0], NOISE) == GOOD:
        why, harmless = 'it is faster than the band that the solve uses', True
    return Verdict(level(value, NOISE), '%s: rms of measured less predicted %.2g times the noise of the solve'
                   % (QUANTITIES[quantity][0], value), ranges(NOISE), why, harmless)


def residual_series(report, s, imu):
    def share(quantity):
        weight = residuals(report, s, quantity, imu)[2]
        return np.mean(weight < 0.5) if weight.size else None
    session = report.head['sessions'][s]
    value, name = worst_of(session, imu, share)
    if value is None:
        return None
    quantity = [q for q in QUANTITIES if QUANTITIES[q][0] == name][0]
    t, _, weight = residuals(report, s, quantity, imu)
    count, edges = np.histogram(t[weight < 0.5], max(1, int(t[-1] - t[0])))
    where = ', most at %.0f s' % edges[np.argmax(count)] if count.max() > 0 else ''
    return Verdict(level(value, WEIGHED_DOWN), '%s: %.2g %% of the samples at less than half weight%s'
                   % (name, 100 * value, where), ranges(WEIGHED_DOWN, '%g %%', 100),
                   'the noise is estimated with such tails')


def spread(r):
    """Robust sigma of all axes."""
    return 1.4826 * np.median(np.abs(r))


def within(report, s, quantity, imu):
    """Of each axis: share of the residuals within 3 sigma, the robust spread."""
    r = residuals(report, s, quantity, imu)[1]
    return np.mean(np.abs(r) < 3 * spread(r), axis=0) if r.size else None


def distributions(report, s, imu):
    def least(quantity):
        r = residuals(report, s, quantity, imu)[1]
        # Less what chance allows, 3 sigma.
        return r.size and within(report, s, quantity, imu).min() + 3 * np.sqrt(0.9973 * 0.0027 / len(r)) or None
    value, name = worst_of(report.head['sessions'][s], imu, least, False)
    if value is None:
        return None
    value = min(value, 1)
    return Verdict(level(value, WITHIN_3_SIGMA), '%s: %.4g %% of the samples within 3 sigma (normal: 99.73)'
                   % (name, 100 * value), ranges(WITHIN_3_SIGMA, '%.4g %%', 100),
                   'tails are part of the noise, and weigh little')


def in_band(report, s, imu, quantity, spectrum):
    """Largest density of the residuals within the band, over the noise of the solve, and where; 0 without any."""
    session = report.head['sessions'][s]
    band = 0.375 / session['knot_spacing_s'] if session['knot_spacing_s'] > 0 else np.inf
    x = sensor(session, quantity, imu)
    t, r, _ = residuals(report, s, quantity, imu)
    frequency, density = spectrum(t, r, x['rate_hz']) if x and t.size else (None, None)
    if frequency is None:
        return 0, 0
    ratio = np.array(density) / (x['noise'] * np.sqrt(2 / x['rate_hz']))
    ratio[np.array(frequency) > band] = 0
    k = np.argmax(ratio)
    return ratio[k], frequency[k]


def spectra(report, s, imu, spectrum):
    (value, frequency), name = max((in_band(report, s, imu, quantity, spectrum), QUANTITIES[quantity][0])
                                   for quantity in QUANTITIES)
    if value == 0:
        return None
    return Verdict(level(value, NOISE), '%s: up to %.2g times the noise of the solve within its band, at %.2g Hz'
                   % (name, value, frequency), ranges(NOISE),
                   'sigmas are from the residuals as they are, correlated')


def time_shift(gyro, step, lag, correlation):
    """`gyro`: how fast it turns, less the mean, every `step` [s]; the correlation is in order of `lag` [s]."""
    top = np.argmax(correlation)
    left = top - np.argmax(correlation[top::-1] < 0.5 * correlation[top])
    right = top + np.argmax(correlation[top:] < 0.5 * correlation[top])
    near = np.abs(lag) < 0.25 * len(gyro) * step
    near[left:right + 1] = False
    next_best = correlation[near].max() if near.any() else 0
    samples = len(gyro) * np.sqrt(np.sum(np.diff(gyro) ** 2) / np.sum(gyro ** 2)) / np.pi  # independent ones
    ratio = (1 - max(next_best, 0) ** 2) / max(1e-9, 1 - min(correlation[top], 1) ** 2)
    sigmas = np.sqrt(samples * max(0, np.log(ratio)))
    if level(abs(lag[top]), PEAK_OFFSET) != GOOD:
        return Verdict(level(abs(lag[top]), PEAK_OFFSET), 'the correlation is best %.2g ms beside the result'
                       % (1e3 * lag[top]), ranges(PEAK_OFFSET, '%g ms', 1e3),
                       'the result follows all axes and the accelerometer, not only how fast it turns')
    return Verdict(level(sigmas, NEXT_PEAK), 'next peak %.2f of %.3f, %.0f sigma less likely'
                   % (next_best, correlation[top], sigmas), ranges(NEXT_PEAK, '%g sigma'),
                   'give initial_time_shift, or move less regularly', False)


def stamp_figure(report, s, imu):
    session = report.head['sessions'][s]
    streams = [x for x in session['streams'] if x['role'] == 'poses' or x['imu'] == imu]
    found = []
    if report.head['solved']:
        times = {x['role']: stamps(report, s, x['role'], imu) for x in streams}
        begin, end = max(t.min() for t in times.values()), min(t.max() for t in times.values())
        for x in streams:
            t = residuals(report, s, 'position' if x['role'] == 'poses' else x['role'], imu)[0]
            if not t.size:  # method gp: the trajectory is held
                continue
            used = np.sum((t >= begin) & (t <= end)) / max(1, (end - begin) * x['rate_hz'])
            found.append((USED[0] / max(used, 1e-9), Verdict(
                level(used, USED), '%s: %.3g %% of the samples that the rate promises are used' % (
                    x['role'], 100 * min(used, 1)), ranges(USED, '%g %%', 100), 'the others only cost sigma')))
    else:
        for x in streams:
            kept = 1 - x['missing'] - x['repeated']
            found.append((USED[0] / max(kept, 1e-9), Verdict(
                level(kept, USED), '%s: %.3g %% of the samples that the rate promises are there and new' % (
                    x['role'], 100 * kept), ranges(USED, '%g %%', 100), 'look at how it is recorded', False)))
    for x in streams:
        jitter = 0 if x['recovered'] else x['jitter_s'] * x['rate_hz']
        found.append((jitter / JITTER[0], Verdict(level(jitter, JITTER), '%s: stamps jitter by %.2g of a period' % (
            x['role'], jitter), ranges(JITTER), 'jitter is part of the noise; use stamps of the sensor')))
    return max(found, key=lambda x: x[0])[1]


def biases(report, s, imu):
    found = []
    for name in ('gyro', 'accel'):
        knots = report.rows('s%d_i%d_%s_bias' % (s, imu, name))
        walk = report.head['options'][name + '_bias_walk'] * np.sqrt(np.diff(knots[:, 0]))[:, None]
        if len(knots) > 1 and walk.min() > 0:
            found.append((np.max(np.abs(np.diff(knots[:, 1:4], axis=0)) / walk), QUANTITIES[name][0], 3 * len(walk)))
    if not found:
        return None
    value, name, count = max(found)
    bounds = largest(count)
    return Verdict(level(value, bounds), '%s: largest step between knots %.2g sigma of its random walk'
                   % (name, value), ranges(bounds, '%.2g sigma'),
                   'set %s_bias_walk to what the IMU does' % ('gyro' if 'gyro' in name else 'accel'), False)


def growth(table):
    half = np.argmin(np.abs(table[:, 0] - 0.5))
    known = table[-1, 1:] > 0
    if not known.any():
        return None
    powers = np.log(table[half, 1:][known] / table[-1, 1:][known]) / np.log(table[-1, 0] / table[half, 0])
    power = max(powers, key=lambda x: abs(np.log2(max(x, 1e-3) / 0.5)))
    found = LOOK if power < GROWTH[0] else level(power, GROWTH[1:])
    return Verdict(found, 'sigmas fall with the power %.2f of the data in the second half' % power,
                   'steady motion: 0.5; good %g to %g, bad from %g' % GROWTH,
                   'the last half moved less; it costs nothing' if power < GROWTH[0] else
                   'the last half moved more, or the first rested; sigmas are within their bounds')


def agreement(report):
    """Of the recordings, or of the halves of one; with the name and the title of the line."""
    found = [(x['agreement'], k + 1) for k, x in enumerate(report.result.get('sessions') or []) if 'agreement' in x]
    if not found:
        sigmas = report.result['quality']['split_half']['sigmas']
        bounds = largest(7 * len(report.result.get('imus') or [0]))  # p, R, time shift
        return 'table', 'Halves of the recording', Verdict(
            level(sigmas, bounds), 'each taken alone, they differ by up to %.1f sigma' % sigmas,
            ranges(bounds, '%.2g sigma'), 'something changed between them: the mount, the marker, the tracker', False)
    x, session = max(found, key=lambda x: x[0]['chi2'] / x[0]['dof'])
    bound = chi_square(x['dof'])
    sigmas = float(x['worst'].split(', ')[1].split()[0])
    return 'table', 'Agreement of the recordings', Verdict(
        BAD if sigmas > AGREEMENT else LOOK if x['chi2'] > bound else GOOD,
        'session %d against the others: chi-square %.0f with %d degrees of freedom, most apart %s' % (
            session, x['chi2'], x['dof'], x['worst']), 'good to %.0f, bad beyond %g sigma' % (bound, AGREEMENT),
        'did the marker or the imu move on the body?', False)


def lever_arm(groups, p, sigma):
    z = np.array([(v[1] - p) / np.hypot(v[2], sigma) for _, values in groups for v in values])
    names = [v[0] for _, values in groups for v in values]
    chi2, dof, worst = np.sum(z ** 2), z.size, np.unravel_index(np.argmax(np.abs(z)), z.shape)
    bound = chi_square(dof)
    found = BAD if np.abs(z).max() > AGREEMENT else LOOK if chi2 > bound else GOOD
    return Verdict(found, 'chi-square %.0f with %d degrees of freedom, most apart: %s along %s, %.1f sigma' % (
        chi2, dof, names[worst[0]], 'xyz'[worst[1]], np.abs(z).max()),
        'good to %.0f, bad beyond %g sigma' % (bound, AGREEMENT),
        'these bands know neither filters nor the errors of the poses; the solve does')


def excitation(report, s):
    bounds = {unit: report.head['options']['weak_%s_std' % name] for unit, name in
              (('m', 'translation'), ('rad', 'rotation'), ('s', 'time_shift'))}
    found = [(d['std'] / bounds[d['unit']], d['direction'], d['status']) for d in
             report.result['quality']['observability'] if d['unit'] in bounds]
    if not found:
        return None
    value, name, status = max(found, key=lambda x: (x[2] == 'degenerate', x[0]))
    if status == 'degenerate':
        return Verdict(BAD, name + ' is not determined', ranges(SIGMA), 'turn about more axes', False)
    return Verdict(level(value, SIGMA), '%s: sigma %.2g of its bound' % (name, value), ranges(SIGMA),
                   'turn faster about all three axes', False)


def missing_motion(rates, angles, names):
    """Of the axes about which it turned most, second and least: one axis alone is not enough, two may do."""
    found = level(rates[1], TURNS)
    if found == GOOD and level(rates[2], TURNS) != GOOD:
        found = LOOK
    k = 1 if found == BAD else 2
    return Verdict(found, 'about %s it turns by %.2g deg at %.2g rad/s rms' % (names[k], angles[k], rates[k]),
                   ranges(TURNS, '%g rad/s'), 'turn about that axis, too, 30 deg and more to and fro', False)


def recorded(poses, gyro):
    """Turn rates of both, which are of one body."""
    if len(poses) < 10 or len(gyro) < 10:
        return None
    gyro = gyro - np.nanmedian(gyro, axis=0)
    of_gyro, of_poses = (np.sqrt(np.nanmean(np.sum(rates ** 2, axis=1))) for rates in (gyro, poses))
    if max(of_gyro, of_poses) < TURNS[1]:
        return Verdict(BAD, 'the body rests: it turns by %.2g rad/s rms' % max(of_gyro, of_poses),
                       ranges(TURNS, '%g rad/s'), 'move it, about all three axes', False)
    ratio = of_gyro / max(of_poses, 1e-6)
    return Verdict(level(max(ratio, 1 / max(ratio, 1e-12)) ** -2, EXPLAINED),
                   'the gyroscope turns %.3g times as fast as the poses' % ratio,
                   'good %.2f to %.2f, bad beyond a factor of %.2f' % (
                       EXPLAINED[0] ** 0.5, EXPLAINED[0] ** -0.5, EXPLAINED[1] ** -0.5),
                   'do units, rates and stamps fit, and is it one body?', False)


def trajectory(report, s):
    session = report.head['sessions'][s]
    poses = [x for x in session['streams'] if x['role'] == 'poses'][0]
    dropped = sum(int(x.split()[0]) for x in poses['dropped'].split(', ') if x) / max(1, poses['count'])
    found = level(dropped, DROPPED)
    if session['jumps'] and found == GOOD:
        found = LOOK
    return Verdict(found, '%d jumps, %d gaps, %.2g %% of the poses dropped' % (
        session['jumps'], session['gaps'], 100 * dropped), 'no jumps; dropped: ' + ranges(DROPPED, '%g %%', 100),
        'poses are cut at jumps and used on both sides' if session['jumps'] else 'the others are enough')


def pose_sensor(sensor, found, jumps):
    """Of a pose sensor, by what is found in a session."""
    pair = lambda name: '%.3g mm, %.3g mrad' % tuple(1e3 * found[name][x] for x in ('position', 'rotation'))
    return Verdict({'ok': GOOD, 'weak': LOOK}.get(sensor['status'], BAD),
                   '%s; noise %s; absolute error (ape) %s; relative error over 1 s (rpe) %s; jumps: %d' % (
                       sensor['status'], pair('noise'), pair('absolute_error'), pair('relative_error'), jumps),
                   'good: ok, bad: degenerate', sensor['message'], False)


def error_bounds(report, s, table):
    session = report.head['sessions'][s]
    known = table[np.isfinite(table).all(axis=1)]
    shares = []
    for quantity, columns in (('position', slice(1, 4)), ('rotation', slice(4, 7))):
        shares.append((np.mean(known[:, columns].max(axis=1) < sensor(session, quantity, 0)['noise']),
                       QUANTITIES[quantity][0]))
    value, name = min(shares)
    return Verdict(level(value, KNOWN), '%s: known better than by one pose for %.3g %% of the time'
                   % (name, 100 * value), ranges(KNOWN, '%g %%', 100),
                   'gaps of the poses are bridged by the IMU alone')
