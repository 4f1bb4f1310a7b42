"""Draws the figures of an evaluation from the tables that evaluate writes into a folder."""

import collections
import csv
import os

import matplotlib
matplotlib.use('Agg')
import matplotlib.pyplot as plt

# Files that depend on the numbers alone.
matplotlib.rcParams.update({'svg.hashsalt': 'imu_pose_calib', 'font.size': 8, 'axes.grid': True, 'grid.alpha': 0.3})
QUANTITIES = (('rotation', 'deg'), ('position', 'mm'), ('time_shift', 'ms'), ('accel_delay', 'ms'))
STYLES = {'gp': ('tab:orange', 'o'), 'joint': ('tab:blue', 's')}


def rows(path):
    with open(path, newline='') as file:
        return list(csv.DictReader(file))


def grouped(table):
    groups = collections.OrderedDict()
    for row in table:
        groups.setdefault((row['experiment'], row['base']), []).append(row)
    return groups


def save(figure, folder, name):
    for ending, metadata in (('png', {'Software': None}), ('svg', {'Date': None})):
        figure.savefig(os.path.join(folder, '%s.%s' % (name, ending)), dpi=110, bbox_inches='tight', metadata=metadata)
    plt.close(figure)


def number(text):
    try:
        return float(text)
    except ValueError:
        return None


def error_figure(cells):
    """Errors of both methods by cell, with bound or sigma and the paper's figures."""
    labels = list(collections.OrderedDict((row['cell'], None) for row in cells))
    values = [number(label) for label in labels]
    is_line = None not in values and len(values) > 1 and min(values) > 0
    places = values if is_line else list(range(len(labels)))
    is_wide = len(labels) > 12
    figure, all_axes = plt.subplots(2 if is_wide else 1, 2 if is_wide else 4, sharex=True,
                                    figsize=(13, 6.5 if is_wide else 3.2))
    all_axes = all_axes.ravel()
    for axes, (quantity, unit) in zip(all_axes, QUANTITIES):
        def series(method, column):
            found = {row['cell']: float(row[column] or 'nan') for row in cells if row['method'] == method}
            return [found.get(label) or float('nan') for label in labels]
        line = '-' if is_line else ''
        for method, (color, marker) in STYLES.items():
            axes.plot(places, series(method, '%s_rmse_%s' % (quantity, unit)), marker + line, color=color, ms=4,
                      label=method)
        reference = 'bound' if cells[0]['base'] == 'simulation' else 'sigma'
        axes.plot(places, series('joint', '%s_%s_%s' % (quantity, reference, unit)), 'k--' if is_line else 'k_', ms=12,
                  label='Cramér-Rao bound' if reference == 'bound' else 'sigma of joint')
        if quantity in ('rotation', 'position') and cells[0]['paper_rotation_deg']:
            axes.plot(places, series('joint', 'paper_%s_%s' % (quantity, unit)), 'x', color='tab:red', label='paper')
        axes.set_title('%s [%s]' % (quantity.replace('_', ' '), unit))
        if any(value > 0 for line_ in axes.lines for value in line_.get_ydata()):
            axes.set_yscale('log')
        if is_line:
            axes.set_xscale('log')
        else:
            axes.set_xticks(places)
            axes.set_xticklabels([label.replace(';', ', ') for label in labels], rotation=90)
    for axes in all_axes[-2:] if is_wide else all_axes:
        axes.set_xlabel(cells[0]['experiment'].replace('_', ' '))
    handles, names = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc='upper center', ncol=len(names), frameon=False, bbox_to_anchor=(0.5, 1.03))
    return figure


def guess_figure(trials):
    """As Figure 3 of the paper: error by the error of the guess."""
    figure, all_axes = plt.subplots(2, 2, figsize=(9, 7), sharex=True, sharey=True)
    for row, (quantity, unit) in zip(all_axes, QUANTITIES[:2]):
        wanted = [t for t in trials if t['cell'] == 'wrong']
        column = '%s_error_%s' % (quantity, unit)
        usable = [float(t[column]) for t in wanted if t['verdict'] in ('ok', 'weak')]
        for axes, method in zip(row, STYLES):
            mine = [t for t in wanted if t['method'] == method]
            good = [t for t in mine if t['verdict'] in ('ok', 'weak')]
            bad = [t for t in mine if t not in good]
            if good:
                drawn = axes.scatter([float(t['guess_deg']) for t in good], [float(t['guess_m']) for t in good], s=14,
                                     c=[float(t[column]) for t in good], cmap='viridis', vmin=0, vmax=max(usable) or 1)
                figure.colorbar(drawn, ax=axes, label='error of the %s [%s]' % (quantity, unit))
            axes.plot([float(t['guess_deg']) for t in bad], [float(t['guess_m']) for t in bad], 'rx', ms=4,
                      label='refused')
            axes.set_title('%s: %d of %d usable' % (method, len(good), len(mine)))
            axes.set_ylabel('guess off by [m]')
            if bad:
                axes.legend()
    for axes in all_axes[1]:
        axes.set_xlabel('guess off by [deg]')
    return figure


def consistency_figure(trials):
    """Normalised errors squared of all simulated trials against chi-square of 8 degrees of freedom."""
    figure, axes = plt.subplots(figsize=(5, 3.2))
    limit, bins = 30.0, 30
    for method, (color, _) in STYLES.items():
        chi2 = [min(float(t['chi2']), limit) for t in trials
                if t['method'] == method and t['verdict'] in ('ok', 'weak')]
        if chi2:
            axes.hist(chi2, bins=bins, range=(0, limit), density=True, histtype='step', color=color,
                      label='%s (last: all beyond)' % method)
    x = [limit * k / 300 for k in range(301)]
    axes.plot(x, [v ** 3 * 2.718281828459045 ** (-v / 2) / 96 for v in x], 'k--', label='chi-square, 8')
    axes.set_xlabel('error squared, by the covariance reported')
    axes.legend()
    return figure


def draw(folder):
    """Reads cells.csv and trials.csv of the folder; writes NAME.png and NAME.svg."""
    cells, trials = grouped(rows(os.path.join(folder, 'cells.csv'))), grouped(rows(os.path.join(folder, 'trials.csv')))
    for (experiment, base), table in cells.items():
        name = '%s_%s' % (experiment, base)
        save(guess_figure(trials[(experiment, base)]) if experiment == 'guess' else error_figure(table), folder, name)
    simulated = [t for (experiment, base), table in trials.items() for t in table
                 if base == 'simulation' and experiment in ('imu_noise', 'pose_noise')]
    if simulated:
        save(consistency_figure(simulated), folder, 'consistency')
