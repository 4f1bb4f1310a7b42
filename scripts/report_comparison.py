"""Page that compares calibrations: p and R with ellipses, clocks, noise, chi-square."""

import io
import os
import sys
from collections import namedtuple

import numpy as np
from command_line import printable, version, write
from comparison import AGREEMENT, DEGREES, QUANTITIES, TRANSFORM, chi_square, compare, less, repeat
from report_axes import BLUE, RED, axes_of, numbers
from report_axes import QUANTITIES as SENSORS
from report_pages import making_rows, new_page
from report_verdicts import BAD, GOOD, LOOK, NOISE, Verdict, level, ranges

# What figures show. middle: what all are drawn less of; scatters, from_others: see comparison.py, empty of one result;
# reference: may be None.
Shown = namedtuple('Shown', 'results middle scatters from_others reference')


def scatter_verdict(shown, quantity):
    found = [x for x in shown.scatters if x.quantity == quantity and x.dof > 0]
    if not found:
        return None
    chi2, dof = found[0].chi2, found[0].dof
    bound = chi_square(dof)
    worst = max(x.most(quantity) for x in shown.from_others)
    return Verdict(BAD if worst > AGREEMENT else LOOK if chi2 > bound else GOOD,
                   '%s: chi-square %.1f with %d degrees of freedom, %.2g times the scatter that the sigmas say, up to '
                   '%.1f sigma' % (quantity, chi2, dof, np.sqrt(chi2 / dof), worst),
                   'good to %.0f, bad beyond %g sigma' % (bound, AGREEMENT),
                   'Something changes between the recordings that no sigma holds: look at the one most apart')


def ellipses(shown, quantity):
    """Each result less the mean in the three planes, with the ellipses of 1 and 3 sigma."""
    figure, axes = axes_of(1, 3, 2.1)
    place, unit, factor = QUANTITIES[quantity]
    rows = [(str(k + 1), x.calibration, BLUE) for k, x in enumerate(shown.results)]
    if shown.reference:
        rows.append(('ref', shown.reference, RED))
    angle = np.linspace(0, 2 * np.pi, 60)
    for ax, (a, b) in zip(axes[0], ((0, 1), (0, 2), (1, 2))):
        for name, one, color in rows:
            x, covariance = less(one, shown.middle)
            value = factor * x[place][[a, b]]
            size, turn = np.linalg.eigh(factor ** 2 * covariance[place, place][np.ix_([a, b], [a, b])])
            ring = turn @ (np.sqrt(np.maximum(size, 0))[:, None] * [np.cos(angle), np.sin(angle)])
            for sigmas, width in ((1, 1.0), (3, 0.5)):
                ax.plot(*(value[:, None] + sigmas * ring), color=color, linewidth=width, alpha=0.7)
            ax.plot(*value, '.', color=color)
            ax.annotate(name, value, xytext=(3, 3), textcoords='offset points', fontsize='small')
        ax.plot(0, 0, '+', color='black')
        axis = 'marker' if quantity == 'translation' else 'imu'
        ax.set(xlabel='%s %s [%s]' % (axis, 'xyz'[a], unit), ylabel='%s %s [%s]' % (axis, 'xyz'[b], unit))
    return figure, scatter_verdict(shown, quantity)


def clocks(shown):
    """The delay of the accelerometer, and the shift of the clocks, less the mean."""
    figure, axes = axes_of(1, 2, 1.6)
    calibrations = [x.calibration for x in shown.results]
    place = np.arange(1, len(calibrations) + 1)
    for k, title in enumerate(('accel delay', 'time shift')):
        ax, values = axes[0, k], 1e3 * np.array([x.times[k] for x in calibrations])
        sigma = 1e3 * np.sqrt([x.covariance[6 + k, 6 + k] for x in calibrations])
        middle = values.mean() if title == 'time shift' else 0
        ax.errorbar(place, values - middle, yerr=sigma, fmt='o', color=BLUE, markersize=4, capsize=3)
        ax.set(title=title + (' less %.7g s' % (1e-3 * middle) if middle else ''), xlabel='result', ylabel='[ms]',
               xticks=place, xlim=(0.4, len(calibrations) + 0.6))
        ax.set_navigate(False)
    found = [x for x in (scatter_verdict(shown, name) for name in ('accel delay', 'time shift')) if x]
    return figure, max(found, key=lambda x: (GOOD, LOOK, BAD).index(x.level), default=None)


def noises(shown):
    figure, axes = axes_of(1, 4, 1.3, gap=0.6)
    place = np.arange(1, len(shown.results) + 1)
    for ax, (sensor, (title, unit, factor)) in zip(axes[0], SENSORS.items()):
        ax.bar(place, [factor * x.noise[sensor] for x in shown.results], color=BLUE, width=0.6)
        ax.set(title=title.replace(' of the poses', ''), xlabel='result', ylabel='[%s]' % unit)
        if len(shown.results) < 12:
            ax.set_xticks(place)
        ax.set_navigate(False)
    ratio, title = max((max(v) / max(min(v), 1e-300), SENSORS[sensor][0]) for sensor in SENSORS
                       for v in [[x.noise[sensor] for x in shown.results]])
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
        p, (delay, shift) = x.calibration.T[:3, 3], x.calibration.times
        sigma = np.sqrt(np.diag(x.calibration.covariance))
        yield (k + 1, printable(os.path.basename(x.path)), x.status, numbers(p, 1e3, '%.3f'),
               numbers(sigma[:3], 1e3, '%.3f'), numbers(x.rotation, 1, '%.5f'), numbers(sigma[3:6], DEGREES, '%.4f'),
               '%.6f ± %.6f' % (shift, sigma[7]), '%.4f ± %.4f' % (1e3 * delay, 1e3 * sigma[6]))


def difference_rows(differences):
    for k, x in enumerate(differences):
        worst = x.worst()
        yield (k + 1, '%.3f' % (1e3 * x.distance), '%.4f' % (DEGREES * x.angle), '%.1f / %d' % (x.chi2, x.dof),
               '%s, %.1f sigma' % (worst.name, worst.sigmas) if worst else '')


def scatter_rows(scatters):
    for x in scatters:
        _, unit, factor = QUANTITIES[x.quantity]
        yield ('%s [%s]' % (x.quantity, unit), numbers(x.deviation, factor, '%.4f'),
               numbers(x.sigma, factor, '%.4f'), '%.1f / %d' % (x.chi2, x.dof))


def fill(page, shown, head):
    results = shown.results
    drawn = page.draw(shown, FIGURES)
    page.title('Comparison of %d calibration%s' % (len(results), 's' * (len(results) > 1)),
               printable(results[0].sources[0]) if len(results) == 1 else '')
    page.verdict(head['status'], head['message'])
    judged = [(x[0], x[1], found[1], found[1].why if found[1].level != GOOD else '')
              for x, found in zip(FIGURES, drawn) if found and found[1]]
    page.judged(sorted(judged, key=lambda x: (BAD, LOOK, GOOD).index(x[2].level)))
    page.table('table', ('', 'result', 'status', 'p [mm]', 'sigma', 'quaternion x y z w',
                         'sigma about the imu axes [deg]', 'time shift [s]', 'accel delay [ms]'), result_rows(results))
    from_reference = shown.reference and [compare(shown.reference, x.calibration, TRANSFORM) for x in results]
    for name, title, differences in (('from_others', 'Each less the mean of the others', shown.from_others),
                                     ('from_reference', 'Each less the reference', from_reference)):
        if differences:
            page.heading(name, title)
            page.table(name + '_table', ('', 'distance [mm]', 'angle [deg]', 'chi-square', 'most apart'),
                       difference_rows(differences))
    if shown.scatters:
        page.heading('scatter', 'Repeatability')
        page.table('scatter_table', ('', 'scatter', 'sigma, rms', 'chi-square'), scatter_rows(shown.scatters))
    page.figures(FIGURES, drawn)
    page.heading('making', 'How this was made')
    page.table('making_table', None, making_rows(head, [printable(x.path) for x in results]))


def write_page(path, results, quantities, reference, status, message):
    """`quantities`: that are judged; `reference`: what all are compared with, too, or None; `status`: 'agree',
    'differ', or 'compared' of a fleet."""
    calibrations = [x.calibration for x in results]
    shown = Shown(results, *(repeat(calibrations, quantities) if len(results) > 1 else
                             (reference or calibrations[0], [], [])), reference)
    head = {'status': status, 'message': printable(message), 'version': version(),
            'command': printable(' '.join(sys.argv)), 'folder': printable(os.getcwd())}
    page = new_page(path, head, [printable(x.sources[0]) for x in results])
    fill(page, shown, head)
    file = io.BytesIO()
    page.write(file)
    write(path, file.getvalue())
