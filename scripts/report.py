#!/usr/bin/python3
"""Draws the report of a calibration from the numbers that are in a folder.

report.py FOLDER OUT.html    one HTML file with SVG figures and a script of its own, without links to anything else
report.py FOLDER OUT.pdf     the same on sheets of A4
"""

import os
import sys

sys.dont_write_bytecode = True
sys.path.insert(0, os.path.dirname(os.path.realpath(__file__)))
try:
    import numpy as np
    import report_axes
    import report_figures as figures
    import report_verdicts
    from report_axes import DEGREES, QUANTITIES, Report, numbers, of_session, residuals, sensor
    from report_pages import making_rows, new_page
    from report_verdicts import BAD, GOOD, LOOK, within
except ImportError as error:
    sys.exit('%s: apt install python3-matplotlib python3-yaml' % error)

MOST_PAIRS = 6  # of session and IMU with figures

# Name, title, what a good and a bad one look like, function of (report, session, imu).
PER_IMU = (
    ('signals', 'Measured against predicted',
     'Left: least and largest of each bin; purple: the second to the right. Good: the dots, which are measured, lie '
     'on the black lines, what the calibrated trajectory predicts, in every swing. Bad: the lines lag behind (time '
     'shift), cut the peaks (poses too slow) or swing to another height (lever arm).',
     figures.signals),
    ('residuals', 'Residuals over time',
     'Good: an even band within about three times the dashed noise. Bad: bursts, slow waves, many red triangles '
     '(samples weighed down) or grey (left out): look at these seconds of the recording.',
     figures.residual_series),
    ('distributions', 'Distribution of the residuals',
     'In units of the robust spread. Good: steps follow the dashed bell. Bad: wide shoulders (outliers, shocks: they '
     'weigh little, but should be few; the outermost steps hold all beyond) or a middle beside 0 (something that the '
     'model lacks).',
     figures.distributions),
    ('spectra', 'Spectra of the residuals',
     'Blue: residuals. Good: at the dashed line, the noise of the solve, or below it where the trajectory follows '
     'this sensor. Bad: hills above it, which are vibration, a filter of the tracker or motion that the model does '
     'not follow; below the dotted end of the band they move the result.',
     figures.spectra),
    ('time_shift', 'Time shift',
     'Good: one peak near 1 at 0, far above the others. Bad: several peaks of one height (motion that repeats '
     'itself: the shift may be a repetition away) or a top beside 0 by more than some milliseconds.',
     figures.time_shift),
    ('stamps', 'Stamps and rates',
     'Good: steps in one thin band, and as many samples used as recorded. Bad: steps up (gaps, lost samples), a wide '
     'band (stamps of arrival) and black far below orange (samples left out).',
     figures.stamp_figure),
    ('biases', 'Biases',
     'With 3 sigma. Good: level, or a walk that stays within its sigmas. Bad: swings or a drift far beyond what the '
     'IMU\'s data sheet allows: something else hides in the bias.',
     figures.biases),
    ('growth', 'Sigma against the share of the data',
     'Good: falls like the dotted line and faster while new motion comes. Bad: level from some share on (the rest '
     'of the recording says nothing new), or still steep at 100 % (record longer). Shape by the motion alone, '
     'scaled to the final sigmas.',
     figures.growth),
    ('lever_arm', 'Lever arm by parts of the data',
     'Good: points scatter about the black line of the result as far as their bars say. Bad: a trend with frequency '
     '(filters, a mount that bends) or one session apart; red: beyond the picture. Bands differentiate the recorded '
     'positions twice, so their bars grow with frequency and are no measure of the result.',
     figures.p_figure),
)
PER_SESSION = (
    ('excitation', 'Excitation and observability',
     'Numbers: sigma over its bound. Good: three bars of similar height, and every sigma left of the dashed bound. '
     'Bad: a turn bar near 0 (turn about that axis, too), or a direction beyond its bound.',
     figures.excitation),
    ('trajectory', 'Trajectory and lever arm',
     'Good: smooth loops in all directions, with the imu\'s path at a constant distance from the marker\'s. Bad: '
     'jumps, or a motion in one plane or about one point only.',
     figures.trajectory),
    ('error_bounds', 'Error bounds of the trajectory',
     'Sigmas of the solve, with those of the calibration. Good: below the dashed noise of one pose. Bad: hills, where '
     'poses are missing or left out.',
     figures.error_bounds),
)
PER_SENSOR = (
    'Residuals against the trajectory of the solve, and by how far the world of the sensor moves where the sensor is, '
    'against where it was as its piece began. Errors are those of evo, aligned as the session begins. Good: an even '
    'band within about three times the dashed noise, few red triangles, drift without steps. Bad: residuals that swing '
    'with the motion (clock, mount, a filter), or drift that takes up jumps.')
REFUSED = (
    ('missing', 'Motion: how fast and how far it turned',
     'About the axes of the marker about which it turned most, second and least. Good: every bar reaches the dashed '
     'line. Bad: a red bar; turn about that axis, too.',
     figures.missing),
    ('recorded', 'What was recorded',
     'Good: all four swing at the same times, about all three axes. Bad: a line that stays level (a sensor that '
     'rests, an axis without turns), values of another size than the unit allows, or streams that do not move '
     'together.',
     figures.recorded),
    [x for x in PER_IMU if x[0] == 'stamps'][0],
)
def sections(report):
    """(name, title, sentence, function, its arguments) of everything that can be drawn."""
    head = report.head
    pairs = [(s, imu) for s, session in enumerate(head['sessions']) for imu in session['imus']]
    for count, (s, imu) in enumerate(pairs[:MOST_PAIRS]):
        session = head['sessions'][s]
        of_imu = of_session(report, s) + (', imu%d' % imu if len(session['imus']) > 1 else '')
        wanted = [(*x, (s, imu), of_imu) for x in (PER_IMU if head['solved'] else REFUSED[1:])]
        if imu == session['imus'][0]:
            own = [(*x, (s,), of_session(report, s)) for x in (PER_SESSION if head['solved'] else REFUSED[:1])]
            wanted = wanted + own if head['solved'] else own + wanted
        for name, title, sentence, function, arguments, of in wanted:
            yield name + ('-%d' % (count + 1) if count else ''), title + of, sentence, function, arguments
    pairs = sorted((x['session'] - 1, k) for k, sensor in enumerate(report.pose_sensors) for x in sensor['sessions'])
    for count, (s, k) in enumerate(pairs[:MOST_PAIRS]):
        title = 'Pose sensor %d, %s' % (k, report.pose_sensors[k]['frame']) + of_session(report, s)
        yield 'pose_sensor' + ('-%d' % (count + 1) if count else ''), title, PER_SENSOR, figures.pose_sensor, (s, k)


# --- Tables ---

def rpy(q):
    x, y, z, w = q
    return (np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def sensor_rows(report):
    for k, sensor in enumerate(report.pose_sensors):
        if sensor['status'] not in ('ok', 'weak'):
            continue
        transform = sensor['transform']
        yield ('translation of sensor%d [mm]' % k, numbers(transform['translation'], 1e3, '%.3f'),
               numbers(transform['translation_std'], 1e3, '%.3f'), 'x, y, z in the marker frame')
        yield ('quaternion of sensor%d' % k, numbers(transform['rotation'], 1, '%.6f'),
               numbers(transform['rotation_std'], DEGREES, '%.4f deg'), 'x, y, z, w; sigma about the sensor axes')
        for x in sensor['sessions']:
            of = ' of sensor%d' % k + of_session(report, x['session'] - 1)
            yield ('time shift%s [s]' % of, '%.7f' % x['time_shift'], '%.7f' % x['time_shift_std'],
                   't_pose = t_sensor + time_shift')
            yield ('scale' + of, '%.5f' % x['scale'], '%.5f' % x['scale_std'], 'positions of its poses = scale true')


def result_rows(report):
    if report.has_imu:
        yield from imu_rows(report)
    yield from sensor_rows(report)


def imu_rows(report):
    result = report.result
    imus = result.get('imus') or [result]
    for k, imu in enumerate(imus):
        name = ' of imu%d' % k if len(imus) > 1 else ''
        transform, inverse = imu['transform'], imu['inverse_transform']
        yield ('translation%s [mm]' % name, numbers(transform['translation'], 1e3, '%.3f'),
               numbers(transform['translation_std'], 1e3, '%.3f'), 'x, y, z in the marker frame')
        yield ('quaternion%s' % name, numbers(transform['rotation'], 1, '%.6f'),
               numbers(transform['rotation_std'], DEGREES, '%.4f deg'), 'x, y, z, w; sigma about the imu axes')
        angles = rpy(transform['rotation'])
        yield ('roll, pitch, yaw%s [deg]' % name, numbers(angles, DEGREES, '%.3f'), '', 'the same rotation'
               if abs(angles[1]) * DEGREES < 85 else 'the same; near 90 deg of pitch only the quaternion is of use')
        yield ('inverse%s [mm]' % name, numbers(inverse['translation'], 1e3, '%.3f'), '',
               'marker in imu; quaternion ' + numbers(inverse['rotation'], 1, '%.6f'))
        yield ('accel delay%s [ms]' % name, '%.4f' % (1e3 * imu['accel_delay']),
               '%.4f' % (1e3 * imu['accel_delay_std']), 't_pose = t_accel + time_shift - accel_delay')
    clocks = [(s, imu) for s, session in enumerate(result['sessions']) for imu in session['imus']] \
        if 'sessions' in result else [(0, {**result, 'name': 'imu0'})]
    for s, imu in clocks:
        name = '' if len(clocks) == 1 else ', session %d, %s' % (s + 1, imu['name'])
        yield ('time shift%s [s]' % name, '%.7f' % imu['time_shift'], '%.7f' % imu['time_shift_std'],
               't_pose = t_imu + time_shift')
        if imu['clock_drift_std'] > 0:
            yield ('clock drift%s [ppm]' % name, '%.2f' % (1e6 * imu['clock_drift']),
                   '%.2f' % (1e6 * imu['clock_drift_std']), 'growth of the time shift')
    for k, imu in enumerate(imus):
        model = imu.get('imu') or imu['intrinsics']
        for key, title, factor, form, sentence in (
                ('gyro_matrix', 'gyro matrix', 1, '%.5f', 'measured = matrix true + bias'),
                ('accel_matrix', 'accel matrix', 1, '%.5f', 'measured = matrix true + bias'),
                ('accel_positions', 'accel axes [mm]', 1e3, '%.2f', 'where the axes x; y; z are in the imu frame')):
            if np.any(np.array(model.get(key + '_std', 0)) > 0):
                yield (title + (' of imu%d' % k if len(imus) > 1 else ''),
                       *('; '.join(numbers(row, factor, form) for row in model[name]) for name in (key, key + '_std')),
                       sentence)
    for x in result.get('between_imus') or []:
        transform, name = x['transform'], '%s in %s' % (x['second'], x['first'])
        yield ('translation, %s [mm]' % name, numbers(transform['translation'], 1e3, '%.3f'),
               numbers(transform['translation_std'], 1e3, '%.3f'), 'x_%s = R x_%s + p' % (x['first'], x['second']))
        yield ('quaternion, %s' % name, numbers(transform['rotation'], 1, '%.6f'),
               numbers(transform['rotation_std'], DEGREES, '%.4f deg'), 'sigma about the axes of ' + x['second'])
    if result['pose_scale_std'] > 0:
        yield ('pose scale', '%.5f' % result['pose_scale'], '%.5f' % result['pose_scale_std'],
               'positions of poses = pose_scale true')
    yield ('gravity [m/s²]', numbers(result['gravity']['vector'], 1, '%.4f'),
           numbers(result['gravity']['std'], 1, '%.4f'), 'in the world frame')


def residual_rows(report):
    """Normalised by the noise of the solve, x, y, z."""
    for s, session in enumerate(report.head['sessions']):
        for imu in session['imus']:
            for quantity, (title, unit, factor) in QUANTITIES.items():
                r = residuals(report, s, quantity, imu)[1]
                if not r.size or (quantity in ('position', 'rotation') and imu != session['imus'][0]):
                    continue
                noise = sensor(session, quantity, imu)['noise']
                name = title + (' of imu%d' % imu if len(session['imus']) > 1 else '')
                yield (name + of_session(report, s),
                       '%.3g %s' % (factor * noise, unit), numbers(r.mean(axis=0) / noise, 1, '%.3f'),
                       numbers(np.median(r, axis=0) / noise, 1, '%.3f'), numbers(r.std(axis=0) / noise, 1, '%.2f'),
                       numbers(within(report, s, quantity, imu), 100, '%.2f'))


def stream_rows(report):
    for s, session in enumerate(report.head['sessions']):
        for x in session['streams']:
            name = x['role'] + (' of imu%d' % x['imu'] if len(session['imus']) > 1 and x['role'] != 'poses' else '')
            name += of_session(report, s)
            latency = '%.1f ± %.1f ms' % tuple(1e3 * v for v in x['latency']) \
                if 'latency' in x and abs(x['latency'][0]) < 60 else ''
            used = x['used'] if report.head['solved'] else '-'
            yield (name, x['topic'], x['count'], used, '%.1f' % x['rate_hz'], '%.2f' % (1e3 * x['jitter_s']),
                   '%.1f' % (1e3 * x['longest_gap_s']), '%.1f' % (100 * x['missing']), '%.1f' % (100 * x['repeated']),
                   latency, 'recovered' if x['recovered'] else 'as recorded')
            if x['dropped']:
                yield ('', 'dropped: ' + x['dropped'])


def warnings(report):
    return list(report.result['quality']['warnings']) if report.result else \
        [w for session in report.head['sessions'] for w in session.get('warnings') or []]


def remark(report, verdict):
    """Of a figure that is not good: why that is harmless, or what there is to do."""
    if verdict.level == GOOD:
        return ''
    if not verdict.harmless:
        return verdict.why[0].upper() + verdict.why[1:]
    return 'Harmless: ' + verdict.why if report.head['status'] == 'ok' and report.has_imu and \
        report.result['quality']['split_half']['sigmas'] <= 5 else ''


def repetition(report):
    """What the sigmas are of."""
    count = len(report.head['sessions'])
    if count == 1:
        return 'Sigmas are one standard deviation, of this one recording: what is the same all through it, as of the ' \
            'tracker or the mount, they do not show. Take a second one and give both: calibrate_bag A B.'
    return 'Sigmas are one standard deviation, of %d recordings and how they agree.' % count


def write_result(report, page):
    status = report.head['status']
    if status == 'refused':
        page.text('No result: the numbers below show why, and are not to be used.')
    page.table('table', ('imu in marker' if report.has_imu else 'in marker', 'value',
                         'sigma' if len(report.head['sessions']) > 1 else 'sigma of this recording', ''),
               result_rows(report))
    page.text(('x_marker = R x_imu + p. ' if report.has_imu else 'x_marker = R x_sensor + p. ') + repetition(report))
    if not report.has_imu:
        return
    page.heading('normalised', 'Residuals over the noise of the solve, x, y, z')
    page.table('residual_table', ('', 'noise', 'mean', 'median', 'standard deviation', 'within 3 spreads % (99.73)'),
               residual_rows(report))


def write_report(report, page):
    head = report.head
    names = [str(session['source']) for session in head['sessions']]
    wanted = list(sections(report))
    drawn = page.draw(report, wanted)
    page.title('Calibration of %s on a tracked body' % (
        'pose sensors' if report.result and not report.has_imu else 'an IMU'), ', '.join(names))
    page.verdict(head['status'], str(head['message']))
    judged = [(x[0], x[1], found[1], remark(report, found[1])) for x, found in zip(wanted, drawn)
              if found and found[1]]
    if report.has_imu:
        agreement = report_verdicts.agreement(report)
        judged.insert(0, (*agreement, remark(report, agreement[2])))
    page.judged(sorted(judged, key=lambda x: (BAD, LOOK, GOOD).index(x[2].level)))
    if any(row[3].startswith('Harmless') for row in judged):
        page.text('Harmless, since the result is ok all the same, and %s, each taken alone.' % report.halves)
    page.text('Drag across a figure to zoom in, click twice to zoom out; numbers are those under the pointer.', True)
    if report.result:
        write_result(report, page)
    found = warnings(report)
    page.heading('warnings', 'Warnings')
    page.table('warning_table', None, [(w,) for w in found] or
               [('none' if head['status'] != 'refused' else 'none beyond the reason above',)])
    page.heading('streams', 'Streams')
    page.table('stream_table', ('stream', 'topic', 'samples', 'used', 'Hz', 'jitter ms', 'longest gap ms', 'missing %',
                                'repeated %', 'record - header', 'stamps'), stream_rows(report))
    page.heading('making', 'How this was made')
    page.table('making_table', None, making_rows(head, names + [x['topic'] for session in head['sessions']
                                                                for x in session['streams']
                                                                if os.path.isfile(x['topic'])]))
    page.figures(wanted, drawn)
    pairs = sum(len(session['imus']) for session in head['sessions'])
    if pairs > MOST_PAIRS:
        page.text('%d more pairs of session and imu are without figures.' % (pairs - MOST_PAIRS))
    if report.has_imu and not any(found for x, found in zip(wanted, drawn) if x[0].startswith('error_bounds')):
        page.text('No error bounds of trajectory and biases: their covariance was not kept, see max_factor_mb.')
    page.heading('settings', 'Settings', True)
    page.settings([(k, 'not given' if v is None else str(v).lower() if isinstance(v, bool) else v)
                   for k, v in head['options'].items()])


def main():
    folder, path = sys.argv[1:]
    report = Report(folder)
    page = new_page(path, report.head, [str(session['source']) for session in report.head['sessions']])
    pairs = sum(len(session['imus']) for session in report.head['sessions'])
    report_axes.BINS = max(120, report_axes.BINS // max(1, min(pairs, MOST_PAIRS)))
    write_report(report, page)
    with open(path, 'wb') as file:
        page.write(file)


if __name__ == '__main__':
    main()
