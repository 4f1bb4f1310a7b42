"""What the figures of report.py are made with: the series of calibration_report.h, axes, colours."""

import html
import io
import json
import os
import re

import numpy as np
import yaml
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

# Okabe and Ito's palette, which everybody can tell apart.
BLUE, ORANGE, GREEN, RED, SKY, PURPLE = '#0072B2', '#E69F00', '#009E73', '#D55E00', '#56B4E9', '#CC79A7'
AXES = (('x', BLUE), ('y', ORANGE), ('z', GREEN))
WIDTH = 8.6  # [inch]
BINS = 500  # of what is drawn over the whole recording
DOTS = 60  # of a second
DEGREES = 180 / np.pi
QUANTITIES = {  # title, unit, factor from SI
    'position': ('position of the poses', 'mm', 1e3),
    'rotation': ('rotation of the poses', 'mrad', 1e3),
    'gyro': ('gyroscope', 'rad/s', 1.0),
    'accel': ('accelerometer', 'm/s²', 1.0),
}

rcParams.update({'svg.fonttype': 'none', 'pdf.fonttype': 42, 'axes.spines.top': False, 'axes.spines.right': False,
                 'axes.grid': True, 'grid.color': '#e4e4e4', 'grid.linewidth': 0.6, 'lines.linewidth': 0.9,
                 'legend.frameon': False, 'axes.linewidth': 0.6, 'svg.hashsalt': 'report', 'axes.axisbelow': True})
if 'axes.titlelocation' in rcParams:  # not before matplotlib 3.2; Ubuntu 20.04 has 3.1
    rcParams['axes.titlelocation'] = 'left'


class Report:
    """The folder."""

    def __init__(self, folder):
        self.folder = folder
        self.head = self.yaml('report.yaml')
        self.result = self.yaml('result.yaml') if self.head['solved'] else None
        self.pose_sensors = (self.result or {}).get('pose_sensors') or []
        self.has_imu = bool(self.result) and 'transform' in self.result
        self.halves = ''  # what the halves of the recording say, each taken alone
        if self.has_imu:
            sigmas = self.result['quality']['split_half']['sigmas']
            self.halves = 'the halves of the recording %s %.1f sigma (bound 5)' % (
                'agree to' if sigmas <= 5 else 'differ by', sigmas)

    def yaml(self, name):
        with open(os.path.join(self.folder, name), encoding='utf-8') as file:
            return yaml.load(file, Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))

    def rows(self, name):
        return np.load(os.path.join(self.folder, name + '.npy'), allow_pickle=False)

    def times(self, name):
        return self.rows(name)[:, 0]


# --- Helpers of figures ---

class Place:
    """Where a figure goes: WIDTH wide before `scale`, from x, y [inch] of a matplotlib figure on."""

    def __init__(self, figure, x=0, y=0, scale=1):
        self.figure, self.x, self.y, self.scale = figure, x, y, scale

    def box(self, left, bottom, right, top):
        """In shares of the matplotlib figure, of inches before `scale`."""
        width, height = self.figure.get_size_inches()
        return [(self.x + self.scale * left) / width, (self.y + self.scale * bottom) / height,
                (self.x + self.scale * right) / width, (self.y + self.scale * top) / height]


def empty(width, height):
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def place(height):
    """Of a figure that is `height` inches high: one of its own. The sheets of PDF replace this."""
    return Place(empty(WIDTH, height))


def axes_of(rows, columns, height, widths=None, share=False, left=0.75, gap=0.8, bottom=0.5):
    """A figure of `rows` x `columns` axes, each row `height` inches high."""
    top, between = 0.28, (0.28 if share else 0.68)
    total = top + bottom + rows * height + (rows - 1) * between
    where = place(total)
    width = (WIDTH - left - 0.15 - (columns - 1) * gap) / columns
    x0, y0, x1, y1 = where.box(left, bottom, WIDTH - 0.15, total - top)
    grid = where.figure.add_gridspec(rows, columns, left=x0, right=x1, bottom=y0, top=y1, wspace=gap / width,
                                     hspace=between / height, width_ratios=widths)
    axes = np.empty((rows, columns), dtype=object)
    for row in range(rows):
        for column in range(columns):
            axes[row, column] = where.figure.add_subplot(grid[row, column],
                                                         sharex=axes[0, column] if share and row else None)
            if share and row + 1 < rows:
                axes[row, column].tick_params(labelbottom=False)
    return where.figure, axes


def text_size(factor):
    """Of all text, by a factor."""
    rcParams.update({'font.size': 8 * factor, 'axes.titlesize': 9 * factor, 'legend.fontsize': 7 * factor})


text_size(1)


def envelope(t, y, bins=None, span=None):
    """Middle of each bin of time, least and largest value in it; nan where there is none."""
    first, last = span if span else (t[0], t[-1])
    bins = bins or BINS
    edges = np.linspace(first, last, bins + 1)
    place = np.searchsorted(t, edges)
    low, high = np.full(bins, np.nan), np.full(bins, np.nan)
    full = np.flatnonzero(place[1:] > place[:-1])
    if full.size:
        stop = place[full[-1] + 1]
        low[full] = np.fmin.reduceat(y[:stop], place[full])
        high[full] = np.fmax.reduceat(y[:stop], place[full])
    return 0.5 * (edges[1:] + edges[:-1]), low, high


def draw_series(ax, t, y, color, label=None, alpha=0.75):
    """A line, or the band that it fills when it is too long for one."""
    if t.size == 0:
        return
    if t.size < 2 * BINS:
        ax.plot(t, y, color=color, label=label)
        return
    middle, low, high = envelope(t, y)
    ax.fill_between(middle, low, high, color=color, alpha=alpha, linewidth=0.3, label=label)


def log_scale(ax, name, subs=(1, 2, 5)):
    """A logarithmic x or y axis with plain numbers; minor ticks would take most of the time."""
    getattr(ax, 'set_%sscale' % name)('log')
    axis = getattr(ax, name + 'axis')
    axis.set_major_locator(LogLocator(subs=subs, numticks=6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: '%g' % value))
    axis.set_minor_locator(NullLocator())


def note(ax, text, x=0.99, y=0.96, **more):
    ax.text(x, y, text, transform=ax.transAxes, ha='right' if x > 0.5 else 'left', va='top', fontsize='small',
            bbox={'facecolor': 'white', 'edgecolor': 'none', 'alpha': 0.75, 'pad': 1}, **more)


def legend(ax, **more):
    """Above the axes, where it hides no data."""
    ax.legend(**{**{'loc': 'lower right', 'bbox_to_anchor': (1.0, 0.98), 'ncol': 5, 'handlelength': 1.2,
                    'columnspacing': 1.0, 'borderaxespad': 0.1}, **more})


def runs(t, rate):
    """Ranges of indices without a gap."""
    if t.size < 2:
        return []
    cuts = np.flatnonzero(np.diff(t) > 3.0 / rate) + 1
    return list(zip(np.r_[0, cuts], np.r_[cuts, t.size]))


def numbers(values, factor, form):
    return ', '.join(form % (factor * value) for value in values)


def of_session(report, s):
    """What the name of something ends with that is of one session of several."""
    return ', session %d' % (s + 1) if len(report.head['sessions']) > 1 else ''


def sensor(session, quantity, imu):
    for found in session['sensors']:
        if found['quantity'] == quantity and (quantity in ('position', 'rotation') or found['imu'] == imu):
            return found
    return None


def residuals(report, s, quantity, imu):
    """Times, residuals and weights of a sensor, in order of time."""
    name = 's%d_%s' % (s, quantity) if quantity in ('position', 'rotation') else 's%d_i%d_%s' % (s, imu, quantity)
    t, rows = report.times(name + '_residual_t'), report.rows(name + '_residual')
    if np.any(np.diff(t) < 0):
        order = np.argsort(t, kind='stable')
        t, rows = t[order], rows[order]
    return t, rows[:, :3].astype(float), rows[:, 3]


def runs_of(mask):
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0]))
    return list(zip(edges[::2], edges[1::2]))


def stamps(report, s, stream, imu):
    """Recorded stamps [s] in order of arrival."""
    return report.times('s%d_poses_t' % s if stream == 'poses' else 's%d_i%d_%s_t' % (s, imu, stream))


# --- Figures in HTML ---

def reading(figure, ax):
    """What the page's script needs to read the axes: their box in the SVG, the limits, which are logarithmic, names."""
    width, height = 72 * figure.get_size_inches()
    box = ax.get_position()
    values = [box.x0 * width, (1 - box.y0) * height, box.x1 * width, (1 - box.y1) * height, *ax.get_xlim(),
              *ax.get_ylim()]
    return json.dumps(['%.7g' % value for value in values]
                      + [int(scale == 'log') for scale in (ax.get_xscale(), ax.get_yscale())]
                      + [ax.get_xlabel(), ax.get_ylabel()])


def svg(figure, label):
    """The figure as it can stand in HTML: without the parts that only a file of its own needs."""
    out = io.StringIO()
    figure.savefig(out, format='svg', metadata={'Date': None})
    text = out.getvalue()
    text = text[text.index('<svg'):]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.S)
    for k, ax in enumerate(figure.axes):
        if ax.get_navigate() and ax.name == 'rectilinear':
            text = text.replace('<g id="axes_%d">' % (k + 1),
                                '<g data-axes="%s">' % html.escape(reading(figure, ax), True), 1)
    text = re.sub(r'<g id="([xy])tick_\d+">', r'<g class="tick \1">', text)
    text = re.sub(r'<g id="(FillBetween)?PolyCollection_\d+">', '<g class="area">', text)
    text = re.sub(r' id="[a-zA-Z0-9]+_[a-zA-Z0-9_]*\d"', '', text)
    text = re.sub(r' xmlns:xlink="[^"]*"| xmlns="[^"]*"| xmlns:\w+="[^"]*"', '', text, count=3)
    text = text.replace('xlink:href', 'href')
    text = re.sub(r'<[^>]*>', lambda tag: tag.group() if 'data-axes' in tag.group() else
                  re.sub(r'(\d\.\d\d)\d+', r'\1', tag.group()), text)
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r'(\.\d)\d', r'\1', path.group()).replace('\n', ' '), text)
    text = re.sub(r'\n\s*', '\n', text)
    return text.replace('<svg', '<svg role="img" aria-label="%s"' % html.escape(label, True), 1)


def draw(task):
    """A figure as SVG and its verdict; nothing when there is nothing to draw. `task`: report, title, function,
    its arguments."""
    report, title, function, arguments = task
    drawn = function(report, *arguments)
    return drawn and (svg(drawn[0], title), drawn[1])
