"""Page of report.py that compares calibrations: p and R with ellipses, clocks, noise, chi-square."""

import os

import numpy as np
from report_axes import BLUE, DEGREES, QUANTITIES, RED, axes_of, numbers
from report_verdicts import AGREEMENT, BAD, GOOD, LOOK, NOISE, Verdict, chi_square, level, ranges

UNITS = {'translation': ('mm', 1e3), 'rotation': ('deg', DEGREES), 'accel delay': ('ms', 1e3),
         'time shift': ('ms', 1e3)}


def product(a, b):
    """Of quaternions x, y, z, w."""
    return np.r_[a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3]), a[3] * b[3] - a[:3] @ b[:3]]


def rotation_vector(q, mean):
    """[rad] of q after the mean, about the axes of the imu."""
    x = product(np.array(mean) * (-1, -1, -1, 1), np.array(q))
    x = x * np.sign(x[3] or 1)
    sine = np.linalg.norm(x[:3])
    return x[:3] * (2 * np.arctan2(sine, x[3]) / sine if sine > 1e-12 else 2)


def scatter_verdict(report, quantity):
    found = [x for x in report.head.get('scatters') or [] if x['quantity'] == quantity and x['dof'] > 0]
    if not found:
        return None
    chi2, dof = found[0]['chi2'], found[0]['dof']
    bound = chi_square(dof)
    worst = max(x['from_others']['most'][quantity] for x in report.head['results'])
    return Verdict(BAD if worst > AGREEMENT else LOOK if chi2 > bound else GOOD,
                   '%s: chi-square %.1f with %d degrees of freedom, %.2g times the scatter that the sigmas say, up to '
                   '%.1f sigma' % (quantity, chi2, dof, np.sqrt(chi2 / dof), worst),
                   'good to %.0f, bad beyond %g sigma' % (bound, AGREEMENT),
                   'Something changes between the recordings that no sigma holds: look at the one most apart')


def ellipses(report, quantity):
    """Each result less the mean in the three planes, with the ellipses of 1 and 3 sigma."""
    figure, axes = axes_of(1, 3, 2.1)
    unit, factor = UNITS[quantity]
    mean, first = report.head['mean'], 0 if quantity == 'translation' else 3
    rows = [(str(k + 1), x['calibration'], BLUE) for k, x in enumerate(report.head['results'])]
    if 'reference' in report.head:
        rows.append(('ref', report.head['reference'], RED))
    angle = np.linspace(0, 2 * np.pi, 60)
    for ax, (a, b) in zip(axes[0], ((0, 1), (0, 2), (1, 2))):
        for name, x, color in rows:
            value = factor * (np.subtract(x['translation'], mean['translation']) if first == 0 else
                              rotation_vector(x['rotation'], mean['rotation']))[[a, b]]
            block = factor ** 2 * np.array(x['covariance'])[np.ix_([first + a, first + b], [first + a, first + b])]
            size, turn = np.linalg.eigh(block)
            ring = turn @ (np.sqrt(np.maximum(size, 0))[:, None] * [np.cos(angle), np.sin(angle)])
            for sigmas, width in ((1, 1.0), (3, 0.5)):
                ax.plot(*(value[:, None] + sigmas * ring), color=color, linewidth=width, alpha=0.7)
            ax.plot(*value, '.', color=color)
            ax.annotate(name, value, xytext=(3, 3), textcoords='offset points', fontsize='small')
        ax.plot(0, 0, '+', color='black')
        axis = 'marker' if first == 0 else 'imu'
        ax.set(xlabel='%s %s [%s]' % (axis, 'xyz'[a], unit), ylabel='%s %s [%s]' % (axis, 'xyz'[b], unit))
    return figure, scatter_verdict(report, quantity)


def clocks(report):
    """The shift of the clocks, less the mean, and the delay of the accelerometer."""
    figure, axes = axes_of(1, 2, 1.6)
    results = report.head['results']
    place = np.arange(1, len(results) + 1)
    for ax, key, title in ((axes[0, 0], 'accel_delay', 'accel delay'), (axes[0, 1], 'time_shift', 'time shift')):
        values = 1e3 * np.array([x['calibration'][key] for x in results])
        middle = values[:, 0].mean() if key == 'time_shift' else 0
        ax.errorbar(place, values[:, 0] - middle, yerr=values[:, 1], fmt='o', color=BLUE, markersize=4, capsize=3)
        ax.set(title=title + (' less %.7g s' % (1e-3 * middle) if middle else ''), xlabel='result', ylabel='[ms]',
               xticks=place, xlim=(0.4, len(results) + 0.6))
        ax.set_navigate(False)
    found = [x for x in (scatter_verdict(report, name) for name in ('accel delay', 'time shift')) if x]
    return figure, max(found, key=lambda x: (GOOD, LOOK, BAD).index(x.level), default=None)


def noises(report):
    figure, axes = axes_of(1, 4, 1.3, gap=0.6)
    results = report.head['results']
    place = np.arange(1, len(results) + 1)
    for ax, (quantity, (title, unit, factor)) in zip(axes[0], QUANTITIES.items()):
        ax.bar(place, [factor * x['noise'][quantity] for x in results], color=BLUE, width=0.6)
        ax.set(title=title.replace(' of the poses', ''), xlabel='result', ylabel='[%s]' % unit)
        if len(results) < 12:
            ax.set_xticks(place)
        ax.set_navigate(False)
    ratio, title = max((max(v) / max(min(v), 1e-300), QUANTITIES[q][0]) for q in QUANTITIES
                       for v in [[x['noise'][q] for x in results]])
    # Sigmas are as the noise: at 2 and 5 times, one recording outweighs the other 4 and 25 times.
    return figure, Verdict(level(ratio, NOISE), '%s: largest over least %.2g' % (title, ratio), ranges(NOISE),
                           'One recording outweighs the others: look at its report')


FIGURES = (
    ('translation', 'Translation, less the mean',
     'Ellipses of 1 and 3 sigma, numbers as in the table; cross: the mean; red: the reference. Good: ellipses of '
     '3 sigma hold the cross. Bad: ellipses far apart.', ellipses, ('translation',)),
    ('rotation', 'Rotation, less the mean', 'As a rotation vector about the axes of the imu.', ellipses, ('rotation',)),
    ('clocks', 'Clocks',
     'With 1 sigma. A delay belongs to the IMU and should repeat; a time shift does so only where the clocks '
     'are the same.', clocks, ()),
    ('noise', 'Noise of the solve', 'Good: bars of one height.', noises, ()),
)


def result_rows(results):
    for k, x in enumerate(results):
        c = x['calibration']
        sigma = np.sqrt(np.diag(c['covariance']))
        yield (k + 1, os.path.basename(x['path']), x['status'], numbers(c['translation'], 1e3, '%.3f'),
               numbers(sigma[:3], 1e3, '%.3f'),
               numbers(c['rotation'], 1, '%.5f'), numbers(sigma[3:], DEGREES, '%.4f'),
               '%.6f ± %.6f' % tuple(c['time_shift']), '%.4f ± %.4f' % tuple(1e3 * v for v in c['accel_delay']))


def difference_rows(results, key):
    for k, x in enumerate(results):
        d = x[key]
        axis = ' ' + 'xyz'[d['axis']] if d['worst'] in ('translation', 'rotation') else ''
        yield (k + 1, '%.3f' % (1e3 * d['distance']), '%.4f' % (DEGREES * d['angle']),
               '%.1f / %d' % (d['chi2'], d['dof']), '%s, %.1f sigma' % (d['worst'] + axis, d['sigmas']))


def write_comparison(report, page, making_rows):
    head, results = report.head, report.head['results']
    wanted = [(*x,) for x in FIGURES]
    drawn = page.draw(report, wanted)
    page.title('Comparison of %d calibration%s' % (len(results), 's' * (len(results) > 1)), results[0]['source']
               if len(results) == 1 else '')
    page.verdict(head['status'], head['message'])
    judged = [(x[0], x[1], found[1], found[1].why if found[1].level != GOOD else '') for x, found in zip(wanted, drawn)
              if found and found[1]]
    page.judged(sorted(judged, key=lambda x: (BAD, LOOK, GOOD).index(x[2].level)))
    page.table('table', ('', 'result', 'status', 'p [mm]', 'sigma', 'quaternion x y z w',
                         'sigma about the imu axes [deg]', 'time shift [s]', 'accel delay [ms]'), result_rows(results))
    for key, title in (('from_others', 'Each less the mean of the others'),
                       ('from_reference', 'Each less the reference')):
        if key in results[0]:
            page.heading(key, title)
            page.table(key + '_table', ('', 'distance [mm]', 'angle [deg]', 'chi-square', 'most apart'),
                       difference_rows(results, key))
    if head.get('scatters'):
        page.heading('scatter', 'Repeatability')
        page.table('scatter_table', ('', 'scatter', 'sigma, rms', 'chi-square'),
                   [('%s [%s]' % (x['quantity'], UNITS[x['quantity']][0]),
                     *(numbers(x[key], UNITS[x['quantity']][1], '%.4f') for key in ('deviation', 'sigma')),
                     '%.1f / %d' % (x['chi2'], x['dof'])) for x in head['scatters']])
    page.figures(wanted, drawn)
    page.heading('making', 'How this was made')
    page.table('making_table', None, making_rows(head, [x['path'] for x in results]))
