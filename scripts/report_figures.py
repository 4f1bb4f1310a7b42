"""Figures of report.py: those of a session and an IMU, of a session, and of data that were refused."""

import numpy as np
import report_axes
import report_series as series
import report_verdicts as verdicts
from mpl_toolkits.mplot3d import Axes3D  # noqa: F401  (registers the projection)
from report_axes import (AXES, BLUE, DEGREES, DOTS, ORANGE, PURPLE, QUANTITIES, RED, SKY, axes_of, draw_series,
                         envelope, legend, log_scale, note, residuals, runs, runs_of, sensor, stamps)


# --- Figures of a session and an IMU ---

def signals(report, s, imu):
    figure, axes = axes_of(2, 2, 1.75, widths=(1.35, 1))
    zoom, whole = (series.predicted(report, s, imu, name) for name in ('zoom', 'predicted'))
    for row, (name, column) in enumerate((('gyro', 1), ('accel', 4))):
        title, unit, _ = QUANTITIES[name]
        t, values = series.recorded(report, s, imu, name)
        ax = axes[row, 0]
        span = (whole[0, 0], whole[-1, 0])
        bins = 250
        middle, low, high = envelope(t, np.linalg.norm(values, axis=1), bins, span)
        ax.fill_between(middle, low, high, color=SKY, linewidth=0, label='measured')
        middle, low, high = envelope(whole[:, 0], np.linalg.norm(whole[:, column:column + 3], axis=1), bins, span)
        ax.plot(middle, low, color='black', linewidth=0.5, label='predicted')
        ax.plot(middle, high, color='black', linewidth=0.5)
        ax.axvspan(zoom[0, 0], zoom[-1, 0], color=PURPLE, alpha=0.5, linewidth=0)
        ax.set(title='%s, norm' % title, ylabel='[%s]' % unit, xlabel='time [s]')
        ax.margins(x=0.01)
        legend(ax)
        ax = axes[row, 1]
        first, last = np.searchsorted(t, (zoom[0, 0], zoom[-1, 0]))
        near = slice(first, last, max(1, -(-(last - first) // DOTS)))
        for k, (axis, color) in enumerate(AXES):
            ax.plot(zoom[:, 0], zoom[:, column + k], color='black', linewidth=0.6,
                    label='predicted' if k == 2 else None)
            ax.plot(t[near], values[near, k], '.', color=color, markersize=4, label=axis, zorder=3)
        ax.set(title='one second', ylabel='[%s]' % unit, xlabel='time [s]')
        ax.margins(x=0.01)
        legend(ax)
    return figure, verdicts.signals(report, s, imu, spectrum)


def draw_residuals(ax, t, r, weight, noise, limit):
    """Of three axes, cut off at the limit; those of little weight are marked."""
    for k, (axis, color) in enumerate(AXES):
        draw_series(ax, t, np.clip(r[:, k], -limit, limit), color, axis, alpha=0.55)
    for sign in (-1, 1):
        ax.axhline(sign * noise, color='black', linestyle='--', linewidth=0.8, label='noise' if sign > 0 else None)
    low = np.flatnonzero(weight < 0.5)
    shown = low[np.linspace(0, low.size - 1, min(low.size, 300)).astype(int)] if low.size else low
    worst = r[shown, np.argmax(np.abs(r[shown]), axis=1)] if low.size else r[shown, 0]
    ax.plot(t[shown], np.clip(worst, -limit, limit), 'v', color=RED, markersize=3, linestyle='none',
            label='weight < 1/2')


def residual_series(report, s, imu):
    session = report.head['sessions'][s]
    figure, axes = axes_of(4, 1, 1.2, share=True)
    for ax, (quantity, (title, unit, factor)) in zip(axes[:, 0], QUANTITIES.items()):
        t, r, weight = residuals(report, s, quantity, imu)
        found = sensor(session, quantity, imu)
        if t.size == 0:
            ax.set_title('%s: not part of this solve' % title)
            continue
        noise = factor * found['noise']
        r *= factor
        limit = max(5 * noise, 1.3 * np.quantile(np.abs(r), 0.999))
        draw_residuals(ax, t, r, weight, noise, limit)
        stream = 'poses' if quantity in ('position', 'rotation') else quantity
        recorded = stamps(report, s, stream, imu)
        bins = int(np.clip((recorded[-1] - recorded[0]) / 0.25, 10, 500))
        count, edges = np.histogram(recorded, bins)
        used, _ = np.histogram(t, edges)
        for begin, end in runs_of(used < 0.5 * count):
            ax.axvspan(edges[begin], edges[end], color='#bbbbbb', alpha=0.6, linewidth=0)
        ax.set(ylabel='[%s]' % unit, ylim=(-1.1 * limit, 1.1 * limit))
        ax.set_title('%s: rms %.3g, noise %.3g %s; %.2g %% weighed down' % (
            title, factor * found['rms'], noise, unit, 100 * np.mean(weight < 0.5)))
        ax.margins(x=0.01)
    axes[-1, 0].set_xlabel('time [s]; grey: more than half of the samples left out')
    legend(axes[0, 0])
    return figure, verdicts.residual_series(report, s, imu)


def distributions(report, s, imu):
    figure, axes = axes_of(1, 4, 1.7, gap=0.5, bottom=0.62)
    x = np.linspace(-6, 6, 61)
    for ax, (quantity, (title, unit, factor)) in zip(axes[0], QUANTITIES.items()):
        _, r, _ = residuals(report, s, quantity, imu)
        ax.set_title(title.replace(' of the poses', ''))
        ax.set_xlabel('residual / spread')
        if r.size == 0:
            continue
        sigma = verdicts.spread(r)
        for k, (axis, color) in enumerate(AXES):
            count, _ = np.histogram(np.clip(r[:, k] / sigma, -6, 6), x)
            density = count / count.sum() / (x[1] - x[0])
            ax.plot(0.5 * (x[1:] + x[:-1]), np.where(density > 0, density, np.nan), color=color, label=axis,
                    drawstyle='steps-mid')
        ax.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi), '--', color='black', label='normal')
        log_scale(ax, 'y', (1,))
        ax.set(ylim=(1e-5, 3), xticks=(-6, -3, 0, 3, 6))
        inside = verdicts.within(report, s, quantity, imu)
        ax.set_xlabel('residual / %.3g %s\nwithin 3: %s %%' % (
            factor * sigma, unit, ', '.join('%.2f' % (100 * share) for share in inside)))
    axes[0, 0].set_ylabel('density')
    legend(axes[0, 0], loc='lower center', bbox_to_anchor=(0.5, 0.0), ncol=2)
    return figure, verdicts.distributions(report, s, imu)


def spectrum(t, r, rate):
    """Amplitude density over the runs of a series, mean of the axes; frequencies."""
    long_runs = [run for run in runs(t, rate) if run[1] - run[0] > 1.5 * rate]
    if not long_runs:
        return None, None
    size = int(min(8 * rate, max(run[1] - run[0] for run in long_runs)))
    window = np.hanning(size)
    power, count = 0.0, 0
    for begin, end in long_runs:
        starts = range(begin, end - size + 1, max(size // 2, (end - begin) // 100))
        for start in starts:
            piece = r[start:start + size] - r[start:start + size].mean(axis=0)
            power = power + (np.abs(np.fft.rfft(window[:, None] * piece, axis=0)) ** 2).mean(axis=1)
            count += 1
    frequency = np.fft.rfftfreq(size, 1 / rate)
    if count == 0:
        return None, None
    density = np.sqrt(2 * power / count / (rate * np.sum(window ** 2)))
    # Means over ever wider bands, as wide on the picture.
    edges = np.unique(np.r_[np.arange(1, 20), np.geomspace(20, frequency.size, 120).astype(int)])
    edges = edges[edges <= frequency.size]
    mean = [np.sqrt(np.mean(density[a:b] ** 2)) for a, b in zip(edges[:-1], edges[1:])]
    return [frequency[a:b].mean() for a, b in zip(edges[:-1], edges[1:])], mean


def spectra(report, s, imu):
    session = report.head['sessions'][s]
    figure, axes = axes_of(2, 2, 1.6, gap=0.9)
    for ax, (quantity, (title, unit, factor)) in zip(axes.flat, QUANTITIES.items()):
        t, r, _ = residuals(report, s, quantity, imu)
        found = sensor(session, quantity, imu)
        ax.set(title=title, xlabel='frequency [Hz]', ylabel='[%s/√Hz]' % unit)
        log_scale(ax, 'x', (1,))
        log_scale(ax, 'y')
        if t.size == 0:
            continue
        frequency, density = spectrum(t, factor * r, found['rate_hz'])
        if frequency is None:
            note(ax, 'no run is long enough')
            continue
        ax.plot(frequency, density, color=BLUE)
        ax.axhline(factor * found['noise'] * np.sqrt(2 / found['rate_hz']), color='black', linestyle='--',
                   label='noise')
        if session['knot_spacing_s'] > 0:
            band = 0.375 / session['knot_spacing_s']
            if band < frequency[-1]:
                ax.axvline(band, color=RED, linestyle=':', label='band')
        legend(ax)
    return figure, verdicts.spectra(report, s, imu, spectrum)


def time_shift(report, s, imu):
    *rates, motion, _ = series.grid(report, s, imu)
    if len(motion.t) < 400:
        return None
    step = motion.t[1] - motion.t[0]
    poses, gyro = (x - x.mean() for x in rates)
    fine, size = 8, 1 << int(np.ceil(np.log2(2 * len(poses))))
    cross = np.fft.rfft(poses, size) * np.conj(np.fft.rfft(gyro, size))
    correlation = fine * np.fft.irfft(cross, fine * size) / np.sqrt(np.sum(poses ** 2) * np.sum(gyro ** 2))
    lag = np.fft.fftfreq(fine * size, 1 / (fine * size)) * step / fine
    order = np.argsort(lag)
    lag, correlation = lag[order], correlation[order]
    figure, axes = axes_of(1, 2, 1.7)
    middle = lag[np.argmax(correlation)]
    for ax, reach, factor, unit in ((axes[0, 0], 2.0, 1, 's'), (axes[0, 1], 0.02, 1e3, 'ms')):
        near = np.flatnonzero(np.abs(lag) <= reach)
        near = near[::max(1, near.size // 600)]
        ax.plot(factor * lag[near], correlation[near], color=BLUE)
        ax.axvline(0, color='black', linestyle='--', linewidth=0.8)
        ax.set_xlabel('time shift less the result [%s]' % unit)
        ax.set_ylabel('correlation of turn rates')
    axes[0, 0].set_title('which repetition of the motion')
    axes[0, 1].set_title('close to the result')
    note(axes[0, 1], 'peak %.3f at %.2f ms' % (correlation.max(), 1e3 * middle), x=0.03, y=0.2)
    return figure, verdicts.time_shift(gyro, step, lag, correlation)


def stamp_figure(report, s, imu):
    session = report.head['sessions'][s]
    streams = [x for x in session['streams'] if x['role'] == 'poses' or x['imu'] == imu]
    figure, axes = axes_of(len(streams), 2, 1.05)
    for row, stream in enumerate(streams):
        t = stamps(report, s, stream['role'], imu)
        title = stream['role']
        if t.size < 3:
            note(axes[row, 0], 'too few samples')
            continue
        t = t[np.abs(t - np.median(t)) < 6 * 3600]
        period = 1e3 * np.diff(t)
        ax = axes[row, 0]
        forward = period > 0
        order = np.argsort(t[1:][forward], kind='stable')
        place, values = t[1:][forward][order], period[forward][order]
        middle, low, high = envelope(place, values, 300)
        ax.fill_between(middle, low, np.maximum(high, 1.03 * low), color=BLUE, linewidth=0.5)
        ax.set(title='%s: step between recorded stamps' % title, ylabel='[ms]')
        log_scale(ax, 'y')
        low_limit, high_limit = np.quantile(values, 0.001), values.max()
        ax.set_ylim(0.4 * min(low_limit, np.median(values)), 3 * high_limit)
        if not forward.all():
            note(ax, '%d steps back or none' % np.sum(~forward))
        ax = axes[row, 1]
        bins = int(np.clip((t.max() - t.min()) / 1.0, 5, 300))
        count, edges = np.histogram(t, bins)
        width = edges[1] - edges[0]
        ax.stairs(count / width, edges, color=ORANGE, linewidth=1.6, label='recorded') if hasattr(ax, 'stairs') else \
            ax.plot(edges[:-1], count / width, color=ORANGE, linewidth=1.6, label='recorded')
        if report.head['solved']:
            used, _ = np.histogram(residuals(report, s, 'position' if stream['role'] == 'poses' else stream['role'],
                                             imu)[0], edges)
            ax.plot(0.5 * (edges[1:] + edges[:-1]), used / width, color='black', linewidth=0.8, label='used')
        ax.set(title='%s: rate' % stream['role'], ylabel='[Hz]', ylim=(0, 1.1 * max(1, (count / width).max())))
        legend(ax)
    for ax in axes[-1]:
        ax.set_xlabel('time [s]' if report.head['solved'] else "time since the stream's first stamp [s]")
    return figure, verdicts.stamp_figure(report, s, imu)


def biases(report, s, imu):
    figure, axes = axes_of(1, 2, 1.5)
    for ax, (name, unit, factor) in zip(axes[0], (('gyro', 'mrad/s', 1e3), ('accel', 'm/s²', 1.0))):
        knots = report.rows('s%d_i%d_%s_bias' % (s, imu, name))
        for k, (axis, color) in enumerate(AXES):
            value, sigma = factor * knots[:, 1 + k], factor * knots[:, 4 + k]
            if np.isfinite(sigma).any():
                ax.fill_between(knots[:, 0], value - 3 * sigma, value + 3 * sigma, color=color, alpha=0.2, linewidth=0,
                                label='3 sigma' if k == 0 else None)
            ax.plot(knots[:, 0], value, color=color, label=axis, marker='.' if len(knots) < 60 else None, markersize=3)
        ax.set(title='bias of the %s' % QUANTITIES[name][0], ylabel='[%s]' % unit, xlabel='time [s]')
        legend(ax)
    return figure, verdicts.biases(report, s, imu)


def error_bounds(report, s):
    """Sigmas of the trajectory of the marker over time."""
    table = report.rows('s%d_error_bounds' % s)
    if not len(table) or not np.isfinite(table[:, 1:]).any():
        return None
    figure, axes = axes_of(1, 2, 1.5)
    for ax, first, quantity in ((axes[0, 0], 1, 'position'), (axes[0, 1], 4, 'rotation')):
        title, unit, factor = QUANTITIES[quantity]
        for k, (axis, color) in enumerate(AXES):
            ax.plot(table[:, 0], factor * table[:, first + k], color=color, label=axis)
        found = sensor(report.head['sessions'][s], quantity, 0)
        ax.axhline(factor * found['noise'], color='black', linestyle='--', linewidth=0.8, label='noise of a pose')
        ax.set(title='%s of the marker' % quantity, ylabel='sigma [%s]' % unit, xlabel='time [s]')
        log_scale(ax, 'y')
        legend(ax)
    return figure, verdicts.error_bounds(report, s, table)


def excitation(report, s):
    found = dict(zip(('turns', 'moves'), series.excitation(report, s)))
    directions = report.result['quality']['observability']
    figure, axes = axes_of(1, 3, 1.9, widths=(1, 1, 3), gap=0.62)
    for ax in axes.flat:
        ax.set_navigate(False)
    for ax, name, frame, unit in ((axes[0, 0], 'turns', 'marker', 'rad/s'), (axes[0, 1], 'moves', 'world', 'm/s²')):
        values = found[name]
        ax.bar(range(3), values, color=[color for _, color in AXES], width=0.65)
        for k, value in enumerate(values):
            ax.text(k, value, '%.2g' % value, ha='center', va='bottom', fontsize='small')
        ax.set(title=name, xlabel='%s axis' % frame, ylabel='rms [%s]' % unit, xticks=range(3), xticklabels='xyz')
        ax.margins(y=0.15)
    ax = axes[0, 2]
    bounds = {unit: report.head['options']['weak_%s_std' % name] for unit, name in
              (('m', 'translation'), ('rad', 'rotation'), ('s', 'time_shift'))}
    shown = [d for d in directions if np.isfinite(d['std']) and d['std'] > 0 and d['unit'] in bounds][:12]
    ratios = [d['std'] / bounds[d['unit']] for d in shown]
    color = {'ok': BLUE, 'weak': ORANGE, 'degenerate': RED}
    ax.barh(range(len(shown)), ratios, color=[color.get(d['status'], BLUE) for d in shown], height=0.7)
    for k, ratio in enumerate(ratios):
        ax.text(1.15 * ratio, k, '%.2g' % ratio, va='center', fontsize='small')
    ax.axvline(1, color='black', linestyle='--', linewidth=0.8)
    ax.set(title='what is determined, the worst first', yticks=range(len(shown)),
           yticklabels=[d['direction'].replace(' in the imu frame', '').replace(' in the marker frame', '')
                        for d in shown], xlabel='sigma / bound')
    log_scale(ax, 'x', (1,))
    if shown:
        ax.set_xlim(0.4 * min(ratios), 8 * max(1, max(ratios)))
    ax.invert_yaxis()
    ax.grid(axis='y')
    box = ax.get_position()
    ax.set_position([box.x0 + 0.3 * box.width, box.y0, 0.7 * box.width, box.height])
    ax.tick_params(axis='y', labelsize='small')
    return figure, verdicts.excitation(report, s)


def growth(report, s, imu):
    table = series.growth(report, s, imu)
    figure, axes = axes_of(1, 3, 1.7, gap=0.7)
    for ax, title, unit, columns in ((axes[0, 0], 'translation', 'mm', ((1, 'x'), (2, 'y'), (3, 'z'))),
                                     (axes[0, 1], 'rotation', 'deg', ((4, 'x'), (5, 'y'), (6, 'z'))),
                                     (axes[0, 2], 'clocks', 'ms', ((7, 'time shift'), (8, 'accel delay')))):
        factor = DEGREES if unit == 'deg' else 1e3
        highest = 0
        for (column, label), (_, color) in zip(columns, AXES):
            if table[-1, column] > 0:
                ax.plot(100 * table[:, 0], factor * table[:, column], color=color, label=label)
                highest = max(highest, factor * table[-1, column])
        if highest > 0:
            ax.plot(100 * table[:, 0], highest / np.sqrt(table[:, 0]), ':', color='black', label='1/√share')
        ax.set(title=title, ylabel='sigma [%s]' % unit, xlabel='share of the data [%]')
        log_scale(ax, 'x')
        log_scale(ax, 'y', (1,))
        ax.set_xticks((2.5, 10, 25, 100))
        legend(ax, loc='upper right', bbox_to_anchor=(1.0, 1.0), ncol=1)
    return figure, verdicts.growth(table)


def p_by_band(report, s, imu):
    """p_MI from the second derivative of the recorded positions and the accelerometer, band by band."""
    _, _, motion, force = series.grid(report, s, imu)
    size = len(motion.t)
    if size < 1000:
        return []
    step = motion.t[1] - motion.t[0]
    frequency = np.fft.rfftfreq(size, step)
    # The motion of the poses alone: of the solve, and what it leaves of them.
    a_W = motion.a_W
    t, r, weight = residuals(report, s, 'position', imu)
    good = weight > 0.5
    if good.sum() > 10:
        left = np.stack([np.interp(motion.t, t[good], r[good, k]) for k in range(3)], axis=1)
        omega2 = (2 * np.pi * frequency[:, None]) ** 2
        a_W = a_W - np.fft.irfft(omega2 * np.fft.rfft(left, axis=0), size, axis=0)
    gravity = np.array(report.head['sessions'][s]['gravity'])
    rest = force - series.specific_force(motion, a_W / report.result['pose_scale'], gravity, np.zeros(3))
    lever = series.lever(motion)
    window = np.hanning(size)
    R_f = np.fft.rfft(window[:, None] * (rest - rest.mean(axis=0)), axis=0)
    L_f = np.fft.rfft(window[:, None, None] * (lever - lever.mean(axis=0)), axis=0)
    end = 0.375 / report.head['sessions'][s]['knot_spacing_s'] if report.head['sessions'][s]['knot_spacing_s'] else 16
    bands = []
    for low, high in ((0.25, 0.5), (0.5, 1), (1, 2), (2, 4), (4, 8), (8, 16)):
        inside = (frequency >= low) & (frequency < high)
        if high > max(2 * end, 1) or inside.sum() < 8:
            continue
        A = L_f[inside].reshape(-1, 3)
        A, b = np.r_[A.real, A.imag], np.r_[R_f[inside].real.ravel(), R_f[inside].imag.ravel()]
        information = A.T @ A
        p = np.linalg.lstsq(A, b, rcond=None)[0]
        # Half of the rows are independent under this window.
        variance = np.sum((b - A @ p) ** 2) / max(1, len(b) - 3) * 2
        sigma = np.sqrt(variance * np.diag(np.linalg.pinv(information)))
        bands.append(('%g-%g Hz' % (low, high), p, sigma))
    # Bands that tell nothing would hide the others.
    least = min([sigma.max() for _, _, sigma in bands], default=0)
    return [band for band in bands if band[2].max() <= 30 * least]


def p_figure(report, s, imu):
    """The lever arm as parts of the data tell it: bands of frequency, and sessions alone."""
    groups = [('by band of frequency, up to a minute', p_by_band(report, s, imu))]
    sessions = report.result.get('sessions') or []
    own = [('session %d' % (k + 1), np.array(x['own']['translation']), np.array(x['own']['translation_std']))
           for k, x in enumerate(sessions) if 'own' in x and x['own']['imu'] == 'imu%d' % imu]
    if s == 0 and own:
        groups.append(('what each session says alone', own))
    groups = [group for group in groups if group[1]]
    if not groups:
        return None
    transform = series.imu_result(report, imu)['transform']
    p, sigma = np.array(transform['translation']), np.array(transform['translation_std'])
    figure, axes = axes_of(3, len(groups), 0.95, share=True)
    for column, (title, values) in enumerate(groups):
        place = np.arange(len(values))
        for k, (axis, color) in enumerate(AXES):
            ax = axes[k, column]
            ax.axhspan(1e3 * (p[k] - sigma[k]), 1e3 * (p[k] + sigma[k]), color='#cccccc', linewidth=0)
            ax.axhline(1e3 * p[k], color='black', linewidth=0.8)
            ax.errorbar(place, [1e3 * v[1][k] for v in values], yerr=[1e3 * v[2][k] for v in values], fmt='o',
                        color=color, markersize=4, capsize=3)
            reach = 6 * max(np.median([1e3 * v[2][k] for v in values]), 1e3 * sigma[k])
            near = [1e3 * v[1][k] for v in values if abs(1e3 * (v[1][k] - p[k])) < 4 * reach] + [1e3 * p[k]]
            low, high = min(near) - reach, max(near) + reach
            ax.set_ylim(low, high)
            for x, v in zip(place, values):
                if not low < 1e3 * v[1][k] < high:
                    ax.plot(x, np.clip(1e3 * v[1][k], low, high), '^' if 1e3 * v[1][k] > high else 'v', color=RED,
                            clip_on=False)
            ax.set_ylabel('p %s [mm]' % axis)
        axes[0, column].set_title(title)
        axes[2, column].set_xticks(place)
        axes[2, column].set_xticklabels([v[0] for v in values])
        axes[2, column].set_xlim(-0.6, len(values) - 0.4)
    for ax in axes.flat:
        ax.set_navigate(False)
    return figure, verdicts.lever_arm(groups, p, sigma)


def trajectory(report, s):
    motion = series.session_motion(report, s)
    known = motion[np.isfinite(motion).all(axis=1)]
    if len(known) < 10:
        return None
    where = report_axes.place(3.5)
    thin = motion[::max(1, len(motion) // 2000)]
    for column, (title, rows) in enumerate((('the whole recording', thin), ('five seconds', None))):
        if rows is None:
            begin = known[len(known) // 2, 0]
            rows = motion[(motion[:, 0] >= begin) & (motion[:, 0] <= begin + 5)]
            rows = rows if len(rows) > 20 else known[len(known) // 2:][:20]
        x0, y0, x1, y1 = where.box(0.05 + 4.3 * column, -0.4, 4.05 + 4.3 * column, 3.95)
        ax = where.figure.add_axes([x0, y0, x1 - x0, y1 - y0], projection='3d')
        ax.plot(*rows[:, 1:4].T, color=BLUE, linewidth=0.7, label='marker')
        ax.plot(*rows[:, 4:7].T, color=ORANGE, linewidth=0.7, label='imu')
        for k, row in enumerate(rows[::max(1, len(rows) // (60 if column else 25))]):
            ax.plot(*np.c_[row[1:4], row[4:7]], color='black', linewidth=0.8, label='lever arm' if k == 0 else None)
        fill_box(ax, np.r_[rows[:, 1:4], rows[:, 4:7]])
        ax.set_title(title, loc='left', y=0.86)
        ax.tick_params(labelsize='x-small', pad=0)
        ax.legend(loc='lower right', bbox_to_anchor=(1.0, 0.855), ncol=3)
    return where.figure, verdicts.trajectory(report, s)


# --- Figures of a session and a pose sensor ---

def pose_sensor(report, s, k):
    found, t, rows, world = series.pose_sensor(report, s, k)
    figure, axes = axes_of(4, 1, 1.2, share=True)
    begins = np.flatnonzero(world[:, 7])
    for row, (quantity, unit, column) in enumerate((('position', 'mm', 0), ('rotation', 'mrad', 3))):
        ax, weight, noise = axes[row, 0], rows[:, 6 + row], 1e3 * found['noise'][quantity]
        limit = 6 * noise
        draw_residuals(ax, t, 1e3 * rows[:, column:column + 3], weight, noise, limit)
        ax.set(ylabel='[%s]' % unit, ylim=(-1.1 * limit, 1.1 * limit))
        ax.set_title('%s: rms %.3g, noise %.3g %s; %.2g %% weighed down' % (
            quantity, 1e3 * found['rms'][quantity], noise, unit, 100 * np.mean(weight < 0.5)))
        ax = axes[2 + row, 0]
        moved = np.insert(1e3 * world[:, 1 + column:4 + column], begins, np.nan, axis=0)  # no line from piece to piece
        times = np.insert(world[:, 0], begins, np.nan)
        for axis, (name, color) in enumerate(AXES):
            ax.plot(times, moved[:, axis], color=color, label=name)
        for begin in begins[1:]:
            ax.axvline(world[begin, 0], color=RED, linestyle=':', label='jump' if begin == begins[1] else None)
        ax.set_ylabel('[%s]' % unit)
        ax.set_title('drift of the world in %s: %.2g %s/√s' % (quantity, 1e3 * found['drift'][quantity], unit))
    for ax in axes[:, 0]:
        ax.margins(x=0.01)
    axes[-1, 0].set_xlabel('time [s]')
    legend(axes[0, 0])
    legend(axes[2, 0])
    return figure, verdicts.pose_sensor(report.pose_sensors[k], found, len(begins) - 1)


def fill_box(ax, points):
    """Limits about the points, of one scale; before matplotlib 3.3 in a cube."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    extent = np.maximum(high - low, 0.3 * max((high - low).max(), 1e-3))
    if hasattr(ax, 'set_box_aspect'):
        ax.set_box_aspect(tuple(extent), zoom=0.85)
    else:
        extent[:] = extent.max()
    for axis, middle, half in zip('xyz', 0.5 * (low + high), 0.53 * extent):
        getattr(ax, 'set_%slim' % axis)(middle - half, middle + half)
        getattr(ax, 'set_%slabel' % axis)('%s [m]' % axis, labelpad=-8 if axis == 'z' else -3)
        count = max(2, int(round(5 * half / (0.53 * extent.max()))))
        getattr(ax, 'set_%sticks' % axis)(np.round(np.linspace(middle - 0.9 * half, middle + 0.9 * half, count), 2))


# --- Figures of data that were refused ---

def recorded(report, s, imu):
    """What the streams hold, as recorded: each on its own clock."""
    figure, axes = axes_of(4, 1, 1.15)
    t, poses = series.in_order(report, 's%d_poses' % s)
    draw_axes(axes[0, 0], t, poses[:, :3] - np.nanmean(poses[:, :3], axis=0) if len(poses) else poses[:, :3],
              'poses: position about its mean', 'm')
    times, rates = turn_rates(t, poses[:, 3:7])
    draw_axes(axes[1, 0], times, rates, 'poses: turn rate about the marker axes', 'rad/s')
    for ax, name in ((axes[2, 0], 'gyro'), (axes[3, 0], 'accel')):
        title, unit, _ = QUANTITIES[name]
        draw_axes(ax, *series.recorded(report, s, imu, name), title, unit)
    axes[3, 0].set_xlabel("time since the stream's first stamp [s]")
    return figure, verdicts.recorded(rates, report.rows('s%d_i%d_gyro' % (s, imu)).astype(float))


def missing(report, s):
    """How fast and how far the marker turned about the axes of most, second and least turning, and what is asked."""
    t, poses = series.in_order(report, 's%d_poses' % s)
    t, rates = turn_rates(t, poses[:, 3:7])
    if len(rates) < 10:
        return None
    axes_M = np.linalg.eigh(rates.T @ rates)[1][:, ::-1].T
    axes_M *= np.sign(axes_M[np.arange(3), np.abs(axes_M).argmax(axis=1)])[:, None]
    names = ['marker ' + 'xyz'[a.argmax()] if a.max() > 0.999 else '(%.2f, %.2f, %.2f)' % tuple(a) for a in axes_M]
    along = rates @ axes_M.T
    step = np.minimum(np.diff(t, prepend=t[0]), 3 * np.median(np.diff(t)))
    fast, far = np.sqrt(np.mean(along ** 2, axis=0)), DEGREES * np.ptp(np.cumsum(along * step[:, None], axis=0), axis=0)
    figure, axes = axes_of(1, 2, 1.6)
    for ax, values, asked, title, unit in ((axes[0, 0], fast, verdicts.TURNS[0], 'how fast it turned', 'rad/s rms'),
                                           (axes[0, 1], far, 30, 'how far it turned', 'deg')):
        ax.bar(range(3), values, color=[BLUE if value >= asked else RED for value in values], width=0.6)
        for k, value in enumerate(values):
            ax.text(k, max(value, 0.02 * values.max()), '%.2g' % value, ha='center', va='bottom', fontsize='small')
        ax.axhline(asked, color='black', linestyle='--', linewidth=0.8, label='asked for')
        ax.set(title=title, ylabel='[%s]' % unit, xticks=range(3),
               xticklabels=names, ylim=(0, 1.2 * max(values.max(), asked)))
        ax.set_navigate(False)
    legend(axes[0, 1])
    return figure, verdicts.missing_motion(fast, far, names)


def draw_axes(ax, t, values, title, unit):
    ax.set(title=title, ylabel='[%s]' % unit)
    if t.size < 2:
        note(ax, 'no samples')
        return
    for k, (axis, color) in enumerate(AXES):
        draw_series(ax, t, values[:, k], color, axis, alpha=0.65)
    ax.margins(x=0.01)
    legend(ax)


def turn_rates(t, q):
    """Rates about the body's axes [rad/s] over steps of at least 0.05 s; without the steps over gaps."""
    if t.size < 3:
        return t[:0], np.zeros((0, 3))
    stride = max(1, int(np.ceil(0.05 / max(np.median(np.diff(t)), 1e-6))))
    t, q = t[::stride], q[::stride]
    a, b = q[:-1] * (-1, -1, -1, 1), q[1:]
    w = a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)
    v = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    v = v * np.sign(np.where(w == 0, 1, w))[:, None]
    sine = np.linalg.norm(v, axis=1)
    angle = 2 * np.arctan2(sine, np.abs(w))
    step = np.diff(t)
    good = (step > 0) & (step < 4 * np.median(step)) & np.isfinite(angle)
    rate = v * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None]
    return 0.5 * (t[1:] + t[:-1])[good], rate[good] / step[good, None]
