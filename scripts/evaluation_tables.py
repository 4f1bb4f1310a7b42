"""The tables of an evaluation, a batch or a dataset, of what the programs of the package print: numbers are texts."""

import csv
import glob
import math
import os

import comparison
from comparison import AGREEMENT, DEGREES

DOF = 8  # of chi2
METHODS = ('gp', 'joint')
QUANTITIES = (('rotation', 'deg', DEGREES), ('position', 'mm', 1e3), ('time shift', 'ms', 1e3),
              ('accel delay', 'ms', 1e3))
NORMS = ('error', 'sigma', 'bound', 'least')  # of trials.csv, each with the quantities in this order

REMARKS = {
    'guess': 'Figure 3 of the paper: guesses up to 180 deg and 1 m off, and none. Recordings of 20 s; in simulation '
             'the transform itself is as random, and the clocks are up to an hour apart.',
    'imu_noise': 'White noise added to accelerometer [m/s^2] and gyroscope [rad/s].',
    'pose_noise': 'White noise added to positions [m] and rotations [rad].',
    'repeatability': 'Recordings of one rig, each calibrated alone and compared with every other: what Table 1 of the '
                     'paper is about.',
    'time_shift': 'True shift between the clocks, which nothing tells the calibration.',
    'accel_delay': "True delay of the accelerometer's samples against the gyroscope's.",
    'duration': 'Poses have to span 5 s.',
    'excitation': 'Motions of the simulator, from many full turns to the hovering of a drone.',
    'lever_arm': 'Distance between marker and IMU.',
    'dropouts': 'Share of the time that is lost, in gaps of 1 s.',
    'outliers': 'Poses that are 10 cm and 20 deg astray.',
    'recordings': 'Recordings of one rig, calibrated together.',
    'effects': 'Each effect of the simulator alone, at its usual strength. The bound knows nothing of them.',
}
# Tables of the paper, and their rotation [deg] and position [mm] by cell.
PAPER = {
    'imu_noise': ('Tables 2 and 3', ((0.0012, 0.050), (0.0053, 0.043), (0.0129, 0.049),
                                     (0.0011, 0.498), (0.0060, 0.654), (0.0102, 0.638),
                                     (0.0012, 1.776), (0.0055, 1.865), (0.0115, 1.850))),
    'pose_noise': ('Tables 4 and 5', ((0.011, 3.38), (0.065, 3.07), (0.118, 4.08),
                                      (0.011, 12.4), (0.056, 11.7), (0.135, 13.8),
                                      (0.011, 16.7), (0.064, 21.7), (0.125, 23.5))),
}


# --- Pieces of text ---

def table(header, rows):
    lines = ['| ' + ' | '.join(row) + ' |\n' for row in [header] + rows]
    return lines[0] + '|' + '---|' * len(header) + '\n' + ''.join(lines[1:]) + '\n'


def number(value):
    """Three digits that count; nothing for nothing."""
    if not math.isfinite(value) or value == 0.0:
        return ''
    return '%.*f' % (min(6, max(0, 2 - math.floor(math.log10(abs(value))))), value)


def ratio(value, by):
    return '%.2f' % (value / by) if by > 0.0 and value > 0.0 else ''


def listed(values, form, factor=1.0):
    return ', '.join(form % (factor * float(value)) for value in values)


def rotation_vector(result):
    """[deg] Of its quaternion x, y, z, w."""
    return DEGREES * comparison.rotation_vector(comparison.rotation(result['rotation']))


def is_usable(outcome):
    return outcome['verdict'] in ('ok', 'weak')


# --- Experiments ---

class Trial:
    """One recording of an experiment. `cell`: place of its cell; `options`: of evaluate_trial, whose outcome is taken
    in the end; numbers that this has not are 0."""

    def __init__(self, name, cell, options):
        self.name, self.cell, self.options = name, cell, options

    def take(self, outcome):
        def numbers(key, count):
            return [float(text) for text in outcome.get(key, ['0'] * count)]
        self.outcome, self.verdict, self.reason = outcome, outcome['verdict'], outcome['reason'].split('\n')[0]
        self.is_usable = is_usable(outcome)
        self.norms = {name: numbers(name, 4) for name in NORMS}
        std = numbers('std', 6)
        self.norms['sigma'] = [math.sqrt(sum(x * x for x in part)) for part in (std[3:], std[:3])] + [
            numbers(key, 2)[1] for key in ('time_shift', 'accel_delay')]
        self.chi2, self.model_chi2 = numbers('chi2', 2)
        self.guess_angle, self.guess_distance = numbers('guess', 2)


class Summary:
    """Root mean squares over the usable trials of a cell; 0 without any, or of what is not known."""

    def __init__(self, trials, within):
        usable = [trial for trial in trials if trial.is_usable]
        self.trials, self.usable = len(trials), len(usable)
        self.within = sum(all(error < bound for error, bound in zip(trial.norms['error'], within)) for trial in usable)
        count = max(1, self.usable)
        self.norms = {name: [math.sqrt(sum(trial.norms[name][q] * trial.norms[name][q] for trial in usable) / count)
                             for q in range(4)] for name in NORMS}
        self.chi2 = sum(trial.chi2 / DOF for trial in usable) / count
        self.model_chi2 = sum(trial.model_chi2 / DOF for trial in usable) / count


def summarize(plan, within):
    """Gives an experiment on one base, with trials and cells, by cell and method its trials and their summary, and
    what the paper prints."""
    plan.by_cell = [{method: [t for t in plan.trials if t.cell == c and t.options['method'] == method]
                     for method in METHODS} for c in range(len(plan.cells))]
    plan.sums = [{method: Summary(cell[method], within) for method in METHODS} for cell in plan.by_cell]
    plan.printed_in, plan.printed = PAPER.get(plan.name, ('', None))


def keys(plan, c, method):
    """The columns by which rows of CSV files tell cells and methods."""
    return [plan.name, plan.base, '"%s"' % ';'.join(plan.cells[c].labels), method]


def chi_square_band(dof):
    """The 2.5 and 97.5 % quantiles of chi-square over its degrees of freedom."""
    return [comparison.chi_square(dof, sigmas) / dof for sigmas in (-1.959964, 1.959964)]


def cell_table(plan, columns):
    """A row for each cell, of what columns(c, summary of gp, summary of joint) gives: names and texts."""
    found = [columns(c, sums['gp'], sums['joint']) for c, sums in enumerate(plan.sums)]
    return table([axis.name for axis in plan.axes] + [name for name, _ in found[0]],
                 [cell.labels + [text for _, text in row] for cell, row in zip(plan.cells, found)])


def error_table(plan, quantities):
    """Errors of both methods, beside what they are measured by."""
    def columns(c, gp, joint):
        row = []
        for q in quantities:
            name, unit, factor = QUANTITIES[q]

            def shown(summary, norm):
                return number(summary.norms[norm][q] * factor)
            own = [('gp', shown(gp, 'error')), ('joint', shown(joint, 'error'))]
            if plan.printed and q < 2:
                own.insert(0, ('paper', '%g' % plan.printed[c][q]))
            if plan.base == 'simulation':
                own += [('bound', shown(joint, 'bound')),
                        ('joint / bound', ratio(joint.norms['error'][q], joint.norms['bound'][q]))]
            else:
                own.append(('sigma of joint', shown(joint, 'sigma')))
            own[0] = ('%s [%s]: %s' % (name, unit, own[0][0]), own[0][1])
            row += own
        return row
    return cell_table(plan, columns)


def count_table(plan):
    """How many were right, and how honest the sigmas are."""
    def columns(_, gp, joint):
        row = [('gp: usable', '%d/%d' % (gp.usable, gp.trials)),
               ('joint: usable', '%d/%d' % (joint.usable, joint.trials)),
               ('gp: within bounds', '%d/%d' % (gp.within, gp.trials)),
               ('joint: within bounds', '%d/%d' % (joint.within, joint.trials))]
        if plan.base == 'simulation':
            band = '%.2f-%.2f' % tuple(chi_square_band(DOF * joint.usable)) if joint.usable else ''
            row += [('gp: chi²/dof', number(gp.chi2)), ('joint: chi²/dof', number(joint.chi2)),
                    ('joint: of the model', number(joint.model_chi2)), ('band', band)]
        return row
    return cell_table(plan, columns)


def refusals(plan):
    """Why trials were not usable, each reason once."""
    text = ''
    for (labels, _, _), cell in zip(plan.cells, plan.by_cell):
        for method in METHODS:
            first = next((trial for trial in cell[method] if not trial.is_usable), None)
            if first:
                text += '- %s, %s: %s: %s\n' % (', '.join(labels), method, first.verdict, first.reason)
    return 'The first that was not usable of each:\n\n' + text + '\n' if text else ''


def result_table(results):
    return table(['recording', 'p [mm]', 'sigma', 'R as a rotation vector [deg]', 'sigma', 'accel delay [ms]',
                  'verdict'],
                 [[r['name'], listed(r['translation'], '%.3f', 1e3), listed(r['std'][:3], '%.3f', 1e3),
                   listed(rotation_vector(r), '%.4f'), listed(r['std'][3:], '%.4f', DEGREES),
                   '%.4f ± %.4f' % tuple(1e3 * float(x) for x in r['accel_delay']), r['verdict']] for r in results])


def difference_table(what, differences):
    rows = []
    for name, d in differences:
        worst = d.worst()
        rows.append([name, number(d.angle * DEGREES), number(d.distance * 1e3),
                     '%.1f / %d' % (d.chi2, d.dof) if d.dof > 0 else '',
                     '%s, %.1f' % (worst.name, worst.sigmas) if worst else ''])
    return table([what, 'rotation [deg]', 'position [mm]', 'chi² / dof', 'largest, in sigma'], rows)


def section(plan):
    text = '## %s, %s\n\n' % (plan.title, plan.base)
    if plan.name in REMARKS:
        text += REMARKS[plan.name] + '\n\n'
    if plan.compared:
        for method in METHODS:
            found = plan.compared[method]
            text += '### %s\n\n' % method + result_table(found['results'])
            text += difference_table('pair', found['pairs'])
            if 'chain' in found:
                text += 'Less the chained calibration, which is taken as exact:\n\n'
                text += difference_table('recording', found['chain'])
        return text + refusals(plan)
    if plan.printed:
        text += "The paper's figures are its %s, of another recording.\n\n" % plan.printed_in
    return (text + error_table(plan, (0, 1)) + error_table(plan, (2, 3)) + count_table(plan) + refusals(plan) +
            '![%s](%s_%s.png)\n\n' % (plan.title, plan.name, plan.base))


def introduction(wanted, version, bases):
    text = ('# Evaluation of imu_pose_calib %s\n\n'
            'Root mean squares of the errors over the usable trials; %d trials a cell in the tables of the paper. '
            '`gp` is the method of the paper, `joint` the default.\n\n' % (version, wanted.trials))
    if 'sample' in bases:
        text += ('**sample**: %s, %s from %g s on. Noise is added to what was recorded, and errors are those against '
                 'what the same method says of the recording as it is, as in the paper.\n\n'
                 % (os.path.basename(wanted.bag), '%g s' % wanted.duration if wanted.duration > 0 else 'all',
                    wanted.start))
    if 'simulation' in bases:
        text += ('**simulation**: errors are those against the truth, another motion in every trial; recordings of '
                 '40 s in the tables of the paper, of 20 s where nothing else is said. *bound* is the Cramér-Rao '
                 'bound for what `joint` estimates, of which it knows as much as its priors say; cells.csv also has '
                 'it with all else known (*least*). chi² is the error squared by the covariance that is reported, '
                 'over its 8 degrees of freedom, *of the model* by that of independent residuals; *band* holds 95 % '
                 'of such means when the sigmas are right.\n\n')
    return text + '*Within bounds*: usable, and less than 10 mm, 0.01 rad and 2 ms off. Time and memory: usage.md.\n\n'


def exact(value):
    return '%.9g' % value


def cells_csv(plans):
    names = ['%s_%s_%s' % (name.replace(' ', '_'), '%s', unit) for name, unit, _ in QUANTITIES]
    header = ['experiment', 'base', 'cell', 'method', 'trials', 'usable', 'within_bounds']
    header += [name % norm for norm in ('rmse', 'sigma', 'bound', 'least') for name in names]
    rows = [header + ['chi2_per_dof', 'model_chi2_per_dof', 'paper_rotation_deg', 'paper_position_mm']]
    for plan in plans:
        for c, sums in enumerate(plan.sums):
            for method in METHODS:
                s = sums[method]
                rows.append(keys(plan, c, method) + [str(count) for count in (s.trials, s.usable, s.within)] +
                            [exact(s.norms[norm][q] * QUANTITIES[q][2]) for norm in NORMS for q in range(4)] +
                            [exact(s.chi2), exact(s.model_chi2)] +
                            ([exact(value) for value in plan.printed[c]] if plan.printed else ['', '']))
    return ''.join(','.join(row) + '\n' for row in rows)


def trials_csv(plans):
    rows = [['experiment', 'base', 'cell', 'method', 'trial', 'verdict', 'rotation_error_deg', 'position_error_mm',
             'time_shift_error_ms', 'accel_delay_error_ms', 'chi2', 'model_chi2', 'guess_deg', 'guess_m']]
    for plan in plans:
        for c, cell in enumerate(plan.by_cell):
            for method in METHODS:
                for i, t in enumerate(cell[method]):
                    errors = t.norms['error'] if t.is_usable else [math.nan] * 4
                    rows.append(keys(plan, c, method) + [str(i + 1), t.verdict] +
                                [exact(error * quantity[2]) for error, quantity in zip(errors, QUANTITIES)] +
                                [exact(t.chi2), exact(t.model_chi2), exact(t.guess_angle * DEGREES),
                                 exact(t.guess_distance)])
    return ''.join(','.join(row) + '\n' for row in rows)


def usage(plans, folder):
    """Median and largest of each cell and method."""
    used = {}
    for path in sorted(glob.glob(os.path.join(glob.escape(folder), 'usage_*.csv'))):
        with open(path, newline='', encoding='utf-8') as file:
            for row in csv.reader(file):
                try:
                    name, wall, cpu, memory = row
                    used[name] = float(wall), float(cpu), float(memory)
                except ValueError:
                    pass  # cut off when a process was killed
    rows, processor = [], 0.0
    for plan in plans:
        for (labels, _, _), cell in zip(plan.cells, plan.by_cell):
            for method in METHODS:
                found = [used[trial.name] for trial in cell[method] if trial.name in used]
                if found:
                    wall, cpu, memory = (sorted(column) for column in zip(*found))
                    processor += sum(cpu)
                    rows.append([plan.name, plan.base, ', '.join(labels), method, '%.2f' % wall[len(wall) // 2],
                                 '%.2f' % cpu[len(cpu) // 2], '%.0f' % memory[-1]])
    return ('# Time and memory\n\nMedians over the trials; their recording is simulated or has its noise added in the '
            'same process, which takes a part of it.\n\n' +
            table(['experiment', 'base', 'cell', 'method', 'time [s]', 'processor [s]', 'memory, most [MB]'], rows) +
            'All trials: %.0f min of a processor.\n' % (processor / 60.0))


def evaluation(wanted, about, plans):
    """Texts of the files in the folder, of plans whose trials have their outcomes."""
    for plan in plans:
        summarize(plan, [float(bound) for bound in about['within']])
    measured = [plan for plan in plans if not plan.compared]
    head = introduction(wanted, about['version'], {plan.base for plan in plans})
    return {'evaluation.md': head + ''.join(map(section, plans)),
            'cells.csv': cells_csv(measured) if measured else '',
            'trials.csv': trials_csv(measured) if measured else '',
            'usage.md': usage(plans, wanted.out)}


# --- Batches and datasets ---

def narrow_table(header, rows):
    """With one blank in an empty cell."""
    return table(header, rows).replace('|  ', '| ')


def sequence_table(results):
    rows = []
    for r in results:
        row = [r['name'], r['verdict']]
        if is_usable(r):
            shift, delay = ([float(x) for x in r[key]] for key in ('time_shift', 'accel_delay'))
            row += [listed(r['translation'], '%.2f', 1e3), listed(r['std'][:3], '%.2f', 1e3),
                    listed(rotation_vector(r), '%.3f'), listed(r['std'][3:], '%.3f', DEGREES),
                    '%.6f' % shift[0], '%.6f' % shift[1], '%.3f' % (1e3 * delay[0]), '%.3f' % (1e3 * delay[1]),
                    r['warnings']]
        else:
            row += [r['reason'].replace('|', '/')] + [''] * 8
        rows.append(row)
    return narrow_table(['recording', 'verdict', 'p [mm]', 'sigma', 'R, rotation vector [deg]', 'sigma',
                         'time shift [s]', 'sigma', 'accel delay [ms]', 'sigma', 'warnings'], rows)


def scatter_table(count, scatter):
    rows = []
    for s in scatter.scatters:
        _, unit, factor = comparison.QUANTITIES[s.quantity]
        rows.append(['%s [%s]' % (s.quantity, unit), listed(s.deviation, '%.3f', factor),
                     listed(s.sigma, '%.3f', factor), '%.1f / %d' % (s.chi2, s.dof)])
    return ('Scatter of %d: mean p %s mm, R %s deg.\n\n'
            % (count, listed(scatter.mean.T[:3, 3], '%.2f', 1e3),
               listed(comparison.rotation_vector(scatter.mean.T[:3, :3]), '%.3f', DEGREES)) +
            narrow_table(['', 'standard deviation', 'sigma, rms', 'chi² / dof'], rows))


def audit_table(audit):
    """Whether poses are in the published frame and on the clock of the IMU."""
    rows = []
    for outcome, d in audit:
        p, R, shift = map(d.most, ('translation', 'rotation', 'time shift'))
        rows.append([outcome['name'], '%.2f (%.1f)' % (1e3 * d.distance, p), '%.3f (%.1f)' % (DEGREES * d.angle, R),
                     '%.3f (%.1f)' % (1e3 * float(outcome['time_shift'][0]), shift),
                     'yes' if max(p, R) <= AGREEMENT else 'no', 'yes' if shift <= AGREEMENT else 'no'])
    return ('Less what is published, in brackets the largest component in its sigma; *yes* is within %g sigma. The '
            'clocks are said to be one.\n\n' % AGREEMENT +
            table(['recording', 'p [mm]', 'R [deg]', 'time shift [ms]', 'frame as published?', 'clock of the IMU?'],
                  rows))


def sequences_csv(results):
    text = ('recording,verdict,x,y,z,x_std,y_std,z_std,qx,qy,qz,qw,rx_std,ry_std,rz_std,time_shift,time_shift_std,'
            'accel_delay,accel_delay_std,warnings,reason\n')
    for r in results:
        numbers = (r['translation'] + r['std'][:3] + r['rotation'] + r['std'][3:] + r['time_shift'] + r['accel_delay']
                   if is_usable(r) else [''] * 17)
        text += '"%s",%s,%s,%s,"%s"\n' % (r['name'], r['verdict'], ','.join(numbers), r['warnings'],
                                          r['reason'].replace('"', "'"))
    return text


def sequences(title, groups):
    """Texts of the files in the folder."""
    text = '# ' + title + '\n\n'
    for group in groups:
        if group['name']:
            text += '## ' + group['name'] + '\n\n'
        text += sequence_table(group['results'])
        if 'scatter' in group:
            text += scatter_table(sum(map(is_usable, group['results'])), group['scatter'])
        if 'audit' in group:
            text += audit_table(group['audit'])
    return {'sequences.md': text, 'sequences.csv': sequences_csv([r for g in groups for r in g['results']])}
