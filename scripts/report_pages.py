"""Pages of reports: the same parts as HTML and, on sheets of A4, as PDF."""

import datetime
import functools
import hashlib
import html
import multiprocessing
import os

import report_axes
from matplotlib.font_manager import FontProperties
from report_axes import Figure, FigureCanvasAgg, GREEN, ORANGE, RED, WIDTH

MOST_HASHED = 1 << 30  # bytes; what takes longer has no checksum
COLORS = {'ok': GREEN, 'weak': ORANGE, 'refused': RED, 'agree': GREEN, 'differ': RED, 'compared': '#888888',
          'good': GREEN, 'look': ORANGE, 'bad': RED}
STYLE = '''
body{font:14px/1.45 "DejaVu Sans",Verdana,sans-serif;color:#222;max-width:960px;margin:1.5em auto;padding:0 1em}
h1{font-size:1.5em;margin:0 0 .3em}h2{font-size:1.2em;margin:2em 0 .4em;border-bottom:1px solid #ccc}
h3{font-size:1em;margin:1.4em 0 .2em}p{overflow-wrap:anywhere}
.verdict{border-left:10px solid;padding:.5em 1em;background:#f4f4f4;margin:1em 0}.verdict b{font-size:1.2em}
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:.6em 0;font-size:.9em}
th,td{text-align:left;padding:.2em .8em .2em 0;border-bottom:1px solid #e2e2e2;vertical-align:top}
th{border-bottom:1px solid #888}td{overflow-wrap:break-word;font-variant-numeric:tabular-nums}
#making_table td{overflow-wrap:anywhere}#making_table td:first-child{min-width:5em}
.judged{list-style:none;padding:0;font-size:.9em}.judged li{padding:.15em 0 .15em 4.6em;border-bottom:1px solid #e2e2e2}
.judged i,figcaption i{color:#666}
.badge{color:#fff;border-radius:3px;padding:0 .5em;font-weight:bold;font-size:.9em}
.judged .badge{float:left;margin-left:-5em;width:3em;text-align:center}
figure{margin:.4em 0 1em;break-inside:avoid}figure svg{width:100%;height:auto;display:block;user-select:none}
figcaption{font-size:.88em;color:#333}.settings{columns:2;font-size:.8em;font-family:monospace}
.settings div{break-inside:avoid}svg text{font-family:"DejaVu Sans",Verdana,sans-serif !important}
#reading{position:absolute;display:none;background:#222;color:#fff;font-size:.8em;padding:.1em .5em;pointer-events:none}
@media(max-width:720px){body{padding:0 .6em}.settings{columns:1}figure div{overflow-x:auto}figure svg{width:760px}
h3{margin-top:1em}}
@media print{@page{size:A4;margin:13mm}body{max-width:none;margin:0;padding:0;font-size:11px}h2,h3{break-after:avoid}
.badge,.verdict{print-color-adjust:exact;-webkit-print-color-adjust:exact}tr,li{break-inside:avoid}
.scroll{overflow:visible}.hint{display:none}}
'''
# Reads out under the pointer; a span that is drawn with it fills the axes, and those of the figure with the same x.
SCRIPT = '''
"use strict";
const tip = document.createElement("div"), NS = document.querySelector("svg")?.namespaceURI;
tip.id = "reading";
document.body.append(tip);
const f = (log, v) => log ? Math.log10(v) : v, back = (log, v) => log ? 10 ** v : v;
const add = (parent, name, values) => {
  const e = document.createElementNS(NS, name);
  for (const k in values) e.setAttribute(k, values[k]);
  return parent.appendChild(e);
};
class Axes {
  constructor(g) {
    const v = JSON.parse(g.dataset.axes);
    [this.x0, this.y0, this.x1, this.y1] = v.slice(0, 4).map(Number);
    const l = v.slice(4, 8).map(Number);
    [this.logs, this.names, this.g] = [v.slice(8, 10), v.slice(10), g];
    this.home = l.map((value, k) => f(this.logs[k >> 1], value));
    this.view = this.home.slice();
  }
  holds(p) { return p.x >= this.x0 && p.x <= this.x1 && p.y >= this.y1 && p.y <= this.y0; }
  at(p) {
    const [a, b, c, d] = this.view;
    return [a + (p.x - this.x0) / (this.x1 - this.x0) * (b - a), c + (p.y - this.y0) / (this.y1 - this.y0) * (d - c)];
  }
  show(view) {
    this.view = view;
    if (!this.parts) this.wrap();
    const h = this.home, v = this.view, sx = (h[1] - h[0]) / (v[1] - v[0]), sy = (h[3] - h[2]) / (v[3] - v[2]);
    const tx = this.x0 * (1 - sx) + (this.x1 - this.x0) * (h[0] - v[0]) / (v[1] - v[0]);
    const ty = this.y0 * (1 - sy) + (this.y1 - this.y0) * (h[2] - v[2]) / (v[3] - v[2]);
    for (const e of this.parts) e.setAttribute("transform", `matrix(${sx} 0 0 ${sy} ${tx} ${ty})`);
    for (const e of this.marks) {
      const x = +e.getAttribute("x"), y = +e.getAttribute("y");
      e.setAttribute("transform", `translate(${sx * x + tx - x} ${sy * y + ty - y})`);
    }
    const is_home = h.every((value, k) => value === v[k]);
    for (const e of this.g.querySelectorAll(".tick")) e.style.display = is_home ? "" : "none";
    if (this.own) this.own.remove();
    if (is_home) return;
    this.own = add(this.g, "g", {fill: "#222", "font-size": "8"});
    this.ticks(0);
    this.ticks(1);
  }
  wrap() {  // what is clipped moves inside of its clip
    this.parts = [];
    this.marks = [];
    for (const e of this.g.querySelectorAll("[clip-path]")) {
      if (e.closest(".tick")) continue;
      const marks = e.closest(".area") ? [] : e.querySelectorAll("use");
      this.marks.push(...marks);
      if (marks.length) continue;
      const outer = document.createElementNS(NS, "g");
      outer.setAttribute("clip-path", e.getAttribute("clip-path"));
      e.removeAttribute("clip-path");
      e.replaceWith(outer);
      outer.append(e);
      for (const part of [e, ...e.querySelectorAll("path")]) part.setAttribute("vector-effect", "non-scaling-stroke");
      this.parts.push(e);
    }
  }
  ticks(k) {
    const a = this.view[2 * k], b = this.view[2 * k + 1], log = this.logs[k];
    const low = back(log, a), high = back(log, b), raw = (high - low) / 5, p = 10 ** Math.floor(Math.log10(raw));
    const step = p * [1, 2, 5, 10].find(m => m * p >= raw);
    const values = [];
    if (log && b - a > 1) for (let e = Math.floor(a); e <= b; ++e) values.push(10 ** e);
    else for (let t = Math.ceil(low / step) * step; t <= high; t += step) values.push(t);
    for (const value of values) {
      const u = (f(log, value) - a) / (b - a);
      if (u < 0 || u > 1) continue;
      const x = this.x0 + u * (this.x1 - this.x0), y = this.y0 + u * (this.y1 - this.y0);
      if (!this.g.querySelector(k ? ".tick.y text" : ".tick.x text")) continue;
      const text = add(this.own, "text", k ? {x: this.x0 - 4, y: y + 3, "text-anchor": "end"}
                                           : {x: x, y: this.y0 + 11, "text-anchor": "middle"});
      text.textContent = +value.toPrecision(6);
      const d = k ? `M${this.x0} ${y}h-3` : `M${x} ${this.y0}v3`;
      add(this.own, "path", {stroke: "#888", "stroke-width": ".5", d: d});
    }
  }
}
for (const svg of document.querySelectorAll("figure svg")) {
  const all = [...svg.querySelectorAll("[data-axes]")].map(g => new Axes(g));
  let from = null, span = null;
  const place = event => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  svg.addEventListener("mousemove", event => {
    const p = place(event), axes = from ? from.axes : all.find(a => a.holds(p));
    tip.style.display = axes ? "block" : "none";
    if (!axes) return;
    const at = axes.at(p).map((value, k) => `${+back(axes.logs[k], value).toPrecision(5)} ${axes.names[k]}`);
    tip.textContent = at.join("   ");
    tip.style.left = Math.min(event.pageX + 14, innerWidth - 220) + "px";
    tip.style.top = event.pageY - 28 + "px";
    if (!from) return;
    if (!span) span = add(svg, "rect", {fill: "#0072B2", "fill-opacity": ".2"});
    const x = Math.max(axes.x0, Math.min(axes.x1, p.x)), low = Math.min(x, from.p.x);
    for (const [k, v] of [["x", low], ["width", Math.abs(x - from.p.x)], ["y", axes.y1], ["height", axes.y0 - axes.y1]])
      span.setAttribute(k, v);
  });
  svg.addEventListener("mousedown", event => {
    const p = place(event), axes = all.find(a => a.holds(p));
    if (axes && !event.button) from = {axes: axes, p: p};
  });
  svg.addEventListener("mouseup", event => {
    if (from && span && Math.abs(+span.getAttribute("width")) > 4) {
      const x = +span.getAttribute("x"), axes = from.axes, y = axes.y0;
      const a = axes.at({x: x, y: y})[0], b = axes.at({x: x + +span.getAttribute("width"), y: y})[0];
      for (const other of all)
        if (other.view[0] === axes.view[0] && other.view[1] === axes.view[1] && other !== axes)
          other.show([a, b, ...other.view.slice(2)]);
      axes.show([a, b, ...axes.view.slice(2)]);
    }
    if (span) span.remove();
    from = span = null;
  });
  svg.addEventListener("mouseleave", () => { tip.style.display = "none"; });
  svg.addEventListener("dblclick", () => all.forEach(a => a.show(a.home.slice())));
}
'''


def escape(text):
    return html.escape(str(text))


class Html:
    """Writes a page of a run; all text is given plain."""

    def __init__(self, title, run):
        self.parts = ['<!DOCTYPE html><!-- imu_pose_calib: report of a calibration -->',
                      '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
                      '<meta name="generator" content="%s"><title>%s</title><style>%s</style></head><body>'
                      % (escape(run), escape(title), STYLE)]

    def draw(self, report, wanted):
        tasks = [(report, x[1], x[3], x[4]) for x in wanted]
        with multiprocessing.get_context('fork').Pool(2) as pool:
            return pool.map(report_axes.draw, tasks, chunksize=1)

    def title(self, text, below):
        self.parts.append('<h1>%s</h1><p>%s</p>' % (escape(text), escape(below)))

    def verdict(self, status, text):
        self.parts.append('<div class="verdict" id="verdict" style="border-color:%s"><b>%s</b> %s</div>'
                          % (COLORS.get(status, RED), status.upper(), escape(text)))

    def judged(self, rows):
        items = ['<li>%s<a href="#%s">%s</a>: %s <i>(%s)%s</i></li>' % (
            self.badge(v.level), name, escape(title), escape(v.value), escape(v.bounds), escape(why and '. ' + why))
            for name, title, v, why in rows]
        self.parts.append('<ul class="judged" id="judged">%s</ul>' % ''.join(items))

    @staticmethod
    def badge(level):
        return '<span class="badge" style="background:%s">%s</span>' % (COLORS[level], level)

    def heading(self, name, text, high=False):
        self.parts.append('<h%d id="%s">%s</h%d>' % (3 - high, name, escape(text), 3 - high))

    def text(self, text, hint=False):
        self.parts.append('<p%s>%s</p>' % (' class="hint"' if hint else '', escape(text)))

    def table(self, name, header, rows):
        rows, lines = list(rows), []
        columns = len(header or rows[0])
        for tag, row in ([('th', header)] if header else []) + [('td', row) for row in rows]:
            rest = ' colspan="%d"' % (columns - len(row) + 1) if len(row) < columns else ''
            cells = ['<%s>%s</%s>' % (tag, escape(cell), tag) for cell in row[:-1]]
            lines.append('<tr>%s<%s%s>%s</%s></tr>' % (''.join(cells), tag, rest, escape(row[-1]), tag))
        self.parts.append('<div class="scroll" id="%s"><table>%s</table></div>' % (name, ''.join(lines)))

    def figures(self, wanted, drawn):
        for (name, title, sentence, _, _), found in zip(wanted, drawn):
            if found:
                judged = found[1] and '%s %s <i>(%s)</i><br>' % (
                    self.badge(found[1].level), escape(found[1].value), escape(found[1].bounds)) or ''
                self.parts.append('<h3 id="%s">%s</h3><figure><div>%s</div><figcaption>%s%s</figcaption></figure>'
                                  % (name, escape(title), found[0], judged, escape(sentence)))

    def settings(self, rows):
        self.parts.append('<div class="settings">%s</div>' % ''.join('<div>%s: %s</div>' % (escape(k), escape(v))
                                                                      for k, v in rows))

    def write(self, file):
        file.write(('\n'.join(self.parts) + '\n<script>%s</script></body></html>\n' % SCRIPT).encode())


@functools.lru_cache(maxsize=None)
def text_width(text, size, weight='normal'):
    """[inch]"""
    renderer = FigureCanvasAgg(Figure(dpi=72)).get_renderer()
    return renderer.get_text_width_height_descent(text, FontProperties(size=size, weight=weight), False)[0] / 72


def wrap(text, width, size, weight='normal'):
    lines, room = [''], width
    for word in str(text).split(' '):
        while text_width(word, size, weight) > width and len(word) > 8:
            half = int(len(word) * width / text_width(word, size, weight))
            lines.append(word[:half])
            word, room = word[half:], 0
        need = text_width(word + ' ', size, weight)
        if need > room and lines[-1]:
            lines.append('')
            room = width
        lines[-1] += word + ' '
        room -= need
    return [line.rstrip() for line in lines if line.strip()] or ['']


class Pdf:
    """The same on sheets of A4."""

    SIZE, MARGIN = (8.27, 11.69), 0.5

    def __init__(self, title, run):
        self.run = run
        self.sheets, self.y, self.caption = [], 0, None
        self.shown, self.references = {}, []  # sheet of each figure, after the text; where it is to be named
        self.width, self.name = self.SIZE[0] - 2 * self.MARGIN, title
        self.scale = self.width / WIDTH
        report_axes.text_size(self.scale)
        report_axes.place = self.place

    def room(self, height):
        """Makes room for something of a height, on a new sheet if need be."""
        if not self.sheets or self.y - height < self.MARGIN:
            self.sheets.append(report_axes.empty(*self.SIZE))
            self.y = self.SIZE[1] - self.MARGIN

    def line(self, text, size, x=0, color='#222222', weight='normal'):
        height = 1.35 * size / 72
        self.room(height)
        self.y -= height
        return self.sheets[-1].text((self.MARGIN + x) / self.SIZE[0], (self.y + 0.25 * height) / self.SIZE[1],
                                    text.replace('$', r'\$'), fontsize=size, color=color, weight=weight)

    def paragraph(self, text, size=7.5, x=0, right=0, **more):
        for line in wrap(text, self.width - x - right, size, more.get('weight', 'normal')):
            self.line(line, size, x, **more)

    def place(self, height):
        """Of a figure: below its title, with room for what is said of it."""
        title, sentence = self.caption
        below = len(wrap(sentence, self.width, 7)) + 2
        self.room(self.scale * height + 0.35 + below * 1.35 * 7 / 72)
        self.y -= 0.08
        self.line(title, 10, weight='bold')
        self.y -= self.scale * height
        return report_axes.Place(self.sheets[-1], self.MARGIN, self.y, self.scale)

    def draw(self, report, wanted):
        drawn = []
        for name, title, sentence, function, arguments in wanted:
            self.caption = title, sentence
            found = function(report, *arguments)
            drawn.append(found and (len(self.sheets), found[1]))
            if not found:
                continue
            self.shown[name] = len(self.sheets)
            if found[1]:
                self.badge(found[1].level, 7)
                self.paragraph('%s (%s)' % found[1][1:3], 7, 0.45)
            self.paragraph(sentence, 7)
        self.drawn, self.sheets = (self.sheets, self.y), []
        return drawn

    def badge(self, level, size):
        self.room(3 * size / 72)
        y = self.y
        self.line(level, size, color=COLORS[level], weight='bold')
        self.y = y

    def title(self, text, below):
        self.line(text, 14, weight='bold')
        self.paragraph(below, 8)

    def verdict(self, status, text):
        self.y -= 0.1
        self.line(status.upper(), 11, color=COLORS.get(status, RED), weight='bold')
        self.paragraph(text, 9)

    def judged(self, rows):
        for name, title, v, why in rows:
            self.badge(v.level, 7.5)
            if name in self.shown:
                y = self.y
                self.references.append((self.line('', 7.5, self.width - 0.4), self.shown[name]))
                self.y = y
            self.paragraph('%s: %s (%s)%s' % (title, v.value, v.bounds, why and '. ' + why), 7.5, 0.45, 0.5)

    def heading(self, name, text, high=False):
        self.room(0.9)
        self.y -= 0.12
        self.line(text, 11 if high else 10, weight='bold')

    def text(self, text, hint=False):
        if not hint:
            self.paragraph(text)

    def table(self, name, header, rows, size=6.5):
        rows = [[str(cell) for cell in row] for row in ([header] if header else []) + list(rows)]
        columns = range(max(len(row) for row in rows))
        pad, natural, least = 0.12, [], []
        for k in columns:
            own = [row[k] for row in rows if k < len(row) and (k + 1 < len(row) or len(row) == len(columns))]
            natural.append(pad + max(text_width(cell, size, 'bold') for cell in own))
            least.append(pad + max(text_width(word, size, 'bold') for cell in own for word in cell.split(' ')))
        spare = max(0, self.width - sum(least)) / max(1e-9, sum(natural) - sum(least))
        widths = [low + min(1, spare) * (high - low) for low, high in zip(least, natural)]
        over = min(1, self.width / sum(widths))
        for i, row in enumerate(rows):
            weight = 'bold' if header and i == 0 else 'normal'
            spans = widths[:len(row) - 1] + [sum(widths[len(row) - 1:])]
            cells = [wrap(cell, over * span - 0.6 * pad, size, weight) for cell, span in zip(row, spans)]
            self.room(1.35 * size / 72 * max(len(lines) for lines in cells))
            top = lowest = self.y
            for k, lines in enumerate(cells):
                self.y = top
                for line in lines:
                    self.line(line, size, over * sum(widths[:k]), weight=weight)
                lowest = min(lowest, self.y)
            self.y = lowest

    def figures(self, wanted, drawn):
        for text, sheet in self.references:
            text.set_text('page %d' % (len(self.sheets) + sheet))
        self.sheets += self.drawn[0]
        self.y = self.drawn[1]

    def settings(self, rows):
        rows = ['%s: %s' % row for row in rows]
        rows += [''] * (-len(rows) % 4)
        step = len(rows) // 4
        self.table('settings', None, zip(*(rows[k * step:(k + 1) * step] for k in range(4))), 6)

    def write(self, file):
        from matplotlib.backends.backend_pdf import PdfPages
        with PdfPages(file) as pages:
            for k, sheet in enumerate(self.sheets):
                sheet.text(0.5, 0.3 / self.SIZE[1], '%d / %d' % (k + 1, len(self.sheets)), fontsize=7, ha='center')
                pages.savefig(sheet)
        file.write(('%% %s\n' % self.run).encode())  # a comment may follow the end


# --- Both ---

def new_page(path, head, sources):
    """Of a kind that the path ends in. `head`: status, version, perhaps run_id; sources: paths that name the page."""
    run_id = head.get('run_id')
    return (Pdf if path.endswith('.pdf') else Html)(
        '%s: %s' % (head['status'].upper(), ', '.join(map(os.path.basename, sources))),
        'imu_pose_calib %s%s' % (head['version'], ', run_id: %s' % run_id if run_id else ''))


def checksum(path):
    size = os.path.getsize(path)
    if size > MOST_HASHED:
        return '%d bytes, last written %s' % (size, datetime.datetime.fromtimestamp(os.path.getmtime(path)))
    digest = hashlib.sha256()
    with open(path, 'rb') as file:
        for part in iter(lambda: file.read(1 << 20), b''):
            digest.update(part)
    return '%d bytes, sha256 %s' % (size, digest.hexdigest())


def making_rows(head, names):
    """Date, version, command and the files that are named, which may be several with blanks between them."""
    yield 'made', '%s by imu_pose_calib %s' % (datetime.datetime.utcnow().strftime('%Y-%m-%d %H:%M:%S UTC'),
                                               head['version'])
    yield 'command', '%s (in %s)' % (head['command'], head['folder'])
    for path in sorted({path for name in names for path in ([name] if os.path.exists(name) else name.split())}):
        files = sorted(os.path.join(path, x) for x in os.listdir(path)) if os.path.isdir(path) else [path]
        for file in filter(os.path.isfile, files):
            yield file, checksum(file)
