#!/usr/bin/python3
"""Draws the report of a calibration from the numbers that calibrate_bag writes into a folder.

report.py FOLDER OUT.html    one HTML file with SVG figures, without scripts or links to anything
report.py FOLDER OUT.pdf     the same figures as PDF
"""

import html
import multiprocessing
import os
import sys
import textwrap

sys.dont_write_bytecode = True
sys.path.insert(0, os.path.dirname(os.path.realpath(__file__)))
try:
    import numpy as np
    import report_axes
    import report_figures as figures
    from report_axes import DEGREES, Figure, FigureCanvasAgg, GREEN, ORANGE, RED, Report
except ImportError as error:
    sys.exit('%s: apt install python3-matplotlib python3-yaml' % error)

MOST_PAIRS = 6  # of session and IMU with figures

# Name, title, what a good and a bad one look like, function of (report, session, imu).
PER_IMU = (
    ('signals', 'Measured against predicted',
     'Good: dots lie on the black lines, which are what the calibrated trajectory predicts, in every swing. Bad: the '
     'lines lag behind (time shift), cut the peaks (poses too slow) or swing to another height (lever arm).',
     figures.signals),
    ('residuals', 'Residuals over time',
     'Good: an even band within about three times the dashed sigma. Bad: bursts, slow waves, many red triangles '
     '(samples weighed down) or grey (left out): look at these seconds of the recording.',
     figures.residual_series),
    ('distributions', 'Distribution of the residuals',
     'Good: steps follow the dashed bell. Bad: wide shoulders (outliers, shocks: they weigh little, but should be '
     'few; the outermost steps hold all beyond) or a middle beside 0 (something that the model lacks).',
     figures.distributions),
    ('spectra', 'Spectra of the residuals',
     'Good: at the dashed line, or below it where the trajectory follows this sensor. Bad: hills above it, which are '
     'vibration, a filter of the tracker or motion that the model does not follow; below the dotted end of the band '
     'they move the result.',
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
     'Good: nearly level. Bad: swings or a drift far beyond what the IMU\'s data sheet allows: something else hides '
     'in the bias.',
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
     'Good: three bars of similar height, and every sigma left of the dashed bound. Bad: a turn bar near 0 (turn '
     'about that axis, too), or a direction beyond its bound.',
     figures.excitation),
    ('trajectory', 'Trajectory and lever arm',
     'Good: smooth loops in all directions, with the imu\'s path at a constant distance from the marker\'s. Bad: '
     'jumps, or a motion in one plane or about one point only.',
     figures.trajectory),
)
REFUSED = (
    ('recorded', 'What was recorded',
     'Good: all four swing at the same times, about all three axes. Bad: a line that stays level (a sensor that '
     'rests, an axis without turns), values of another size than the unit allows, or streams that do not move '
     'together.',
     figures.recorded),
    [x for x in PER_IMU if x[0] == 'stamps'][0],
)
COLORS = {'ok': GREEN, 'weak': ORANGE}
STYLE = '''
body{font:14px/1.45 "DejaVu Sans",Verdana,sans-serif;color:#222;max-width:960px;margin:1.5em auto;padding:0 1em}
h1{font-size:1.5em;margin:0 0 .3em}h2{font-size:1.2em;margin:2em 0 .4em;border-bottom:1px solid #ccc}
h3{font-size:1em;margin:1.4em 0 .2em}
.verdict{border-left:10px solid;padding:.5em 1em;background:#f4f4f4;margin:1em 0}.verdict b{font-size:1.2em}
table{border-collapse:collapse;margin:.6em 0;font-size:.9em}th,td{text-align:left;padding:.2em .8em .2em 0;
border-bottom:1px solid #e2e2e2;vertical-align:top}th{font-weight:bold;border-bottom:1px solid #888}
td.n{font-variant-numeric:tabular-nums;white-space:nowrap}
figure{margin:.4em 0 1em;break-inside:avoid}figure svg{width:100%;height:auto;display:block}
figcaption{font-size:.88em;color:#333}pre{font-size:.78em;background:#f4f4f4;padding:.8em;white-space:pre-wrap}
nav{font-size:.85em}.settings{columns:2;font-size:.8em;font-family:monospace}.settings div{break-inside:avoid}
svg text{font-family:"DejaVu Sans",Verdana,sans-serif !important}
@media print{body{max-width:none;margin:0;font-size:11px}nav{display:none}h2,h3{break-after:avoid}
pre{break-inside:auto}.verdict{background:none;border:1px solid #888;border-left-width:10px}}
'''


def sections(report):
    """(heading, [(name, title, sentence, function, its arguments)]) of everything that can be drawn."""
    head = report.head
    pairs = [(s, imu) for s, session in enumerate(head['sessions']) for imu in session['imus']]
    for s, imu in pairs[:MOST_PAIRS]:
        session = head['sessions'][s]
        heading = []
        if len(head['sessions']) > 1:
            heading.append('session %d: %s' % (s + 1, session['source']))
        if len(session['imus']) > 1:
            heading.append('imu%d' % imu)
        wanted = [(*x, (s, imu)) for x in (PER_IMU if head['solved'] else REFUSED)]
        if imu == session['imus'][0]:
            wanted += [(*x, (s,)) for x in PER_SESSION[:2 if head['solved'] else 1]]
        yield ', '.join(heading), wanted


# --- Tables ---

def cells(row, tag='td'):
    return '<tr>%s</tr>' % ''.join('<%s%s>%s</%s>' % (tag, ' class="n"' if k and tag == 'td' else '', cell, tag)
                                   for k, cell in enumerate(row))


def table(header, rows):
    return '<table>%s%s</table>' % (cells(header, 'th'), ''.join(cells(row) for row in rows))


def triple(values, factor, form):
    return ', '.join(form % (factor * value) for value in values)


def rpy(q):
    x, y, z, w = q
    return (np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def result_table(report):
    result, rows = report.result, []
    imus = result.get('imus') or [result]
    for k, imu in enumerate(imus):
        name = ' of imu%d' % k if len(imus) > 1 else ''
        transform = imu['transform']
        rows.append(('translation%s [mm]' % name, triple(transform['translation'], 1e3, '%.3f'),
                     triple(transform['translation_std'], 1e3, '%.3f'), 'x, y, z in the marker frame'))
        rows.append(('roll, pitch, yaw%s [deg]' % name, triple(rpy(transform['rotation']), DEGREES, '%.3f'),
                     triple(transform['rotation_std'], DEGREES, '%.4f'), 'sigma about the imu axes'))
        rows.append(('quaternion%s' % name, triple(transform['rotation'], 1, '%.6f'), '', 'x, y, z, w'))
        rows.append(('accel delay%s [ms]' % name, '%.4f' % (1e3 * imu['accel_delay']),
                     '%.4f' % (1e3 * imu['accel_delay_std']), 't_pose = t_accel + time_shift - accel_delay'))
    clocks = [(s, imu) for s, session in enumerate(result['sessions']) for imu in session['imus']] \
        if 'sessions' in result else [(0, {**result, 'name': 'imu0'})]
    for s, imu in clocks:
        name = '' if len(clocks) == 1 else ', session %d, %s' % (s + 1, imu['name'])
        rows.append(('time shift%s [s]' % name, '%.7f' % imu['time_shift'], '%.7f' % imu['time_shift_std'],
                     't_pose = t_imu + time_shift'))
        if imu['clock_drift_std'] > 0:
            rows.append(('clock drift%s [ppm]' % name, '%.2f' % (1e6 * imu['clock_drift']),
                         '%.2f' % (1e6 * imu['clock_drift_std']), 'growth of the time shift'))
    rows.append(('gravity [m/s²]', triple(result['gravity']['vector'], 1, '%.4f'), '', 'in the world frame'))
    return table(('imu in marker', 'value', 'sigma', ''), rows)


def stream_table(report):
    rows = []
    for s, session in enumerate(report.head['sessions']):
        for x in session['streams']:
            name = x['role'] + (' of imu%d' % x['imu'] if len(session['imus']) > 1 and x['role'] != 'poses' else '')
            name += ', session %d' % (s + 1) if len(report.head['sessions']) > 1 else ''
            latency = '%.1f ± %.1f ms' % tuple(1e3 * v for v in x['latency']) \
                if 'latency' in x and abs(x['latency'][0]) < 60 else ''
            used = '%d' % x['used'] if report.head['solved'] else ''
            rows.append((name, html.escape(x['topic']), x['count'], used, '%.1f' % x['rate_hz'],
                         '%.2f' % (1e3 * x['jitter_s']), '%.1f' % (1e3 * x['longest_gap_s']),
                         '%.1f' % (100 * x['missing']), '%.1f' % (100 * x['repeated']), latency,
                         'recovered' if x['recovered'] else 'as recorded'))
            if x['dropped']:
                rows.append(('', 'dropped: ' + html.escape(x['dropped'])) + ('',) * 9)
    return table(('stream', 'topic', 'samples', 'used', 'Hz', 'jitter ms', 'longest gap ms', 'missing %', 'repeated %',
                  'record - header', 'stamps'), rows)


def warnings(report):
    found = list(report.result['quality']['warnings']) if report.result else \
        [w for session in report.head['sessions'] for w in session.get('warnings') or []]
    return ''.join('<li>%s</li>' % html.escape(str(w)) for w in found)


def settings(report):
    return '<div class="settings">%s</div>' % ''.join(
        '<div>%s: %s</div>' % (html.escape(str(k)), html.escape('not given' if v is None else str(v).lower() if isinstance(v, bool) else str(v)))
        for k, v in report.head['options'].items())


def write_html(report, path):
    head = report.head
    status, message = head['status'].upper(), html.escape(str(head['message']))
    sources = ', '.join(html.escape(str(session['source'])) for session in head['sessions'])
    parts = ['<html lang="en"><head><meta charset="utf-8"><title>%s: %s</title><style>%s</style></head><body>'
             % (status, sources, STYLE),
             '<h1>Calibration of an IMU on a tracked body</h1><div>%s</div>' % sources,
             '<div class="verdict" id="verdict" style="border-color:%s"><b>%s</b> %s</div>'
             % (COLORS.get(head['status'], RED), status, message)]
    if report.result:
        if head['status'] == 'refused':
            parts.append('<p>No result: the numbers below show why, and are not to be used.</p>')
        parts.append('<div id="table">%s</div>' % result_table(report))
        parts.append('<p>x_marker = R x_imu + p. Sigmas are one standard deviation. Second half of the recording less '
                     'the first: up to %.1f sigma.</p>' % report.result['quality']['split_half']['sigmas'])
    found = warnings(report)
    parts.append('<h3 id="warnings">Warnings</h3><ul>%s</ul>' % found if found else
                 '' if head['status'] == 'refused' else '<p id="warnings">No warnings.</p>')
    parts.append('<h3 id="streams">Streams</h3>%s' % stream_table(report))
    wanted = list(sections(report))
    tasks = [(report, x[1], x[3], x[4]) for _, group in wanted for x in group]
    with multiprocessing.get_context('fork').Pool(2) as pool:
        drawn = iter(pool.map(report_axes.draw, tasks, chunksize=1))
    for count, (heading, group) in enumerate(wanted):
        if heading:
            parts.append('<h2>%s</h2>' % html.escape(heading))
        for (name, title, sentence, _, _), figure in zip(group, drawn):
            if figure:
                parts.append('<h3 id="%s">%s</h3><figure>%s<figcaption>%s</figcaption></figure>'
                             % (name + ('-%d' % (count + 1) if count else ''), title, figure, sentence))
    pairs = sum(len(session['imus']) for session in head['sessions'])
    if pairs > MOST_PAIRS:
        parts.append('<p>%d more pairs of session and imu are without figures.</p>' % (pairs - MOST_PAIRS))
    if report.result:
        parts.append('<h2 id="summary">Summary</h2><pre>%s</pre>' % html.escape(report.text('summary.txt')))
    parts.append('<h2 id="settings">Settings</h2>%s<p>imu_pose_calib %s</p></body></html>\n'
                 % (settings(report), html.escape(str(head['version']))))
    with open(path, 'w', encoding='utf-8') as file:
        file.write('\n'.join(parts))


def write_pdf(report, path):
    from matplotlib.backends.backend_pdf import PdfPages
    head = report.head
    lines = ['%s: %s' % (head['status'].upper(), head['message'])]
    text = textwrap.fill(lines[0], 100) + '\n\n' + (report.text('summary.txt') if report.result else '')
    text += '\nSettings of imu_pose_calib %s\n' % head['version']
    text += '\n'.join('%s: %s' % item for item in head['options'].items())
    with PdfPages(path) as pages:
        rows = text.split('\n')
        for begin in range(0, len(rows), 85):
            page = Figure(figsize=(8.27, 11.69))
            FigureCanvasAgg(page)
            page.text(0.08, 0.96, '\n'.join(rows[begin:begin + 85]), va='top', family='monospace', fontsize=7)
            pages.savefig(page)
        for heading, wanted in sections(report):
            for _, title, sentence, function, arguments in wanted:
                figure = function(report, *arguments)
                if figure is None:
                    continue
                figure.text(0.02, 1.02, ', '.join(filter(None, (title, heading))), fontsize=11, weight='bold')
                figure.text(0.02, -0.02, textwrap.fill(sentence, 130), va='top', fontsize=7.5)
                pages.savefig(figure, bbox_inches='tight')


def main():
    folder, path = sys.argv[1:]
    report = Report(folder)
    pairs = sum(len(session['imus']) for session in report.head['sessions'])
    report_axes.BINS = max(120, report_axes.BINS // min(pairs, MOST_PAIRS))
    (write_pdf if path.endswith('.pdf') else write_html)(report, path)


if __name__ == '__main__':
    main()
