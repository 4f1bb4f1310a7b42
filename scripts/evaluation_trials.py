"""The experiments of evaluate: their trials, each of which evaluate_trial runs, and what these are compared with."""

import difflib
import itertools
import json
import os
from collections import namedtuple

import evaluation_tables
import yaml
from command_line import LOADER, InputError, program, reason_of, write
from comparison import TRANSFORM, calibration, compare
from evaluation_runner import Task, describe, finished, missing, run_tasks
from evaluation_tables import METHODS, Trial, is_usable

COMPARED = 4  # recordings of one rig, however many are asked for
PARTS, PART = 3, 25  # of a bag that is compared with itself; [s]

# Options of evaluate_trial.
ORDINARY = {'accel-delay': 2e-3}  # poses of 1 mm and 1 mrad
MOTION_CAPTURE = dict(ORDINARY, **{'position-std': 1e-4, 'rotation-std': 2e-4})  # as the paper's, before noise is added
SHORT = {'duration': 20}  # [s] where the length of a recording is not the matter
BOTH = ('sample', 'simulation')  # bases: a bag, or recordings whose truth is known, another motion in every trial

# What changes from cell to cell of a table: name with unit, and for each value its label and options.
Axis = namedtuple('Axis', 'name values')
# Trials on a grid, each with both methods. trials: of a cell, when 30 are asked for; simulated: options that the axes
# change; is_compared: with each other, not with a truth.
Experiment = namedtuple('Experiment', 'name title trials simulated axes bases is_compared', defaults=(False,))
Cell = namedtuple('Cell', 'labels name options')  # labels: of each axis


def axis(name, option, values, unit=1):
    return Axis(name, [('%g' % value, {option: value * unit}) for value in values])


def experiments(effects):
    """All of them, in the order in which they are shown. `effects`: usual strengths by name."""
    def short(name, title, shown):
        return Experiment(name, title, 10, dict(ORDINARY, **SHORT), [shown], BOTH[1:])
    stds = (0.001, 0.005, 0.01)
    return [
        Experiment('guess', 'Robustness to the initial guess', 200,
                   dict(MOTION_CAPTURE, **SHORT, **{'random-rig': True}),
                   [Axis('guess', [('none', {}), ('wrong', {'guess': True})])], BOTH),
        Experiment('imu_noise', 'Noise of the IMU', 30, MOTION_CAPTURE,
                   [axis('accel [m/s^2]', 'add-accel', (0.001, 0.01, 0.1)), axis('gyro [rad/s]', 'add-gyro', stds)],
                   BOTH),
        Experiment('pose_noise', 'Noise of the poses', 30, MOTION_CAPTURE,
                   [axis('position [m]', 'add-position', stds), axis('rotation [rad]', 'add-rotation', stds)], BOTH),
        Experiment('repeatability', 'Repeatability', 30, dict(ORDINARY, **{'one-rig': True}), [], BOTH, True),
        short('time_shift', 'Time shift', axis('time shift [s]', 'time-shift', (0.0, 0.02, 1.5, 3600.0, 1e6))),
        short('accel_delay', 'Delay of the accelerometer', axis('delay [ms]', 'accel-delay', (-5, 0, 5, 20, 45), 1e-3)),
        short('duration', 'Duration', axis('duration [s]', 'duration', (5.1, 10, 20, 40, 80, 120))),
        short('pose_rate', 'Rate of the poses', axis('rate [Hz]', 'pose-rate', (5, 10, 20, 50, 100, 200, 300))),
        short('excitation', 'Excitation',
              Axis('motion', [(motion, {'motion': motion}) for motion in ('tumble', 'handheld', 'arm', 'drone')])),
        short('lever_arm', 'Lever arm', axis('distance [m]', 'lever-arm', (0.01, 0.03, 0.1, 0.3, 1.0))),
        short('dropouts', 'Dropouts of the poses', axis('lost [%]', 'lost', (0, 5, 10, 30, 50))),
        short('outliers', 'Outliers of the poses', axis('outliers [%]', 'outliers', (0, 0.1, 1, 5))),
        short('recordings', 'Number of recordings', axis('recordings', 'recordings', (1, 2, 4))),
        short('effects', 'What real recordings have', Axis('effect', [('none', {})] + [
            ('%s %g' % (name, float(usual)), {name: usual}) for name, usual in effects.items()])),
    ]


def choose(every, wanted):
    """Experiments by name; all of them without any."""
    by_name = {experiment.name: experiment for experiment in every}
    for name in wanted:
        if name not in by_name:
            near = difflib.get_close_matches(name, by_name, 1, 0.7)
            raise InputError("there is no experiment '%s'%s There are: %s" % (
                name, "; did you mean '%s'?" % near[0] if near else '.', ', '.join(by_name)))
    return [by_name[name] for name in wanted] or every


def cells_of(axes):
    def file_name(label):
        return label.replace(' ', '_').replace('/', '_').split('_[')[0]
    cells = []
    for values in itertools.product(*(shown.values for shown in axes)):
        labels = [label for label, _ in values]
        name = ','.join('%s_%s' % (file_name(shown.name), file_name(label)) for shown, label in zip(axes, labels))
        cells.append(Cell(labels, name, {key: value for _, options in values for key, value in options.items()}))
    return cells if len(cells) > 1 else [cells[0]._replace(name='all')]


def recordings(wanted):
    """What is compared with each other: the bags of the rig, or parts of one."""
    def stem(path):
        return os.path.splitext(os.path.basename(path))[0]
    if wanted.rig:
        return Axis('recording', [(stem(path), {'bag': path, 'start': 0, 'duration': 0}) for path in wanted.rig])
    return Axis('recording', [('%s %d-%d s' % (stem(wanted.bag), PART * i, PART * (i + 1)),
                               {'bag': wanted.bag, 'start': PART * i, 'duration': PART}) for i in range(PARTS)])


class Plan:
    """An experiment on one base, with its trials by method and cell."""

    def __init__(self, experiment, base, wanted):
        self.name, self.title, self.base, self.axes = experiment.name, experiment.title, base, experiment.axes
        self.is_compared = experiment.is_compared
        self.fixed = dict(experiment.simulated)
        if base == 'sample':
            used = min(filter(None, (wanted.duration, self.fixed.get('duration'))), default=0)  # 0: all
            self.fixed = {'bag': wanted.bag, 'start': wanted.start, 'duration': used}
            self.axes = [recordings(wanted)] if self.is_compared else self.axes
        self.cells = cells_of(self.axes)
        count = COMPARED if self.is_compared else max(1, wanted.trials * experiment.trials // 30)
        self.trials = []
        for method, (c, cell) in itertools.product(METHODS, enumerate(self.cells)):
            # The same bag gives the same again.
            is_random = base == 'simulation' or (cell.options and not self.is_compared)
            for i in range(1, count + 1 if is_random else 2):
                self.trials.append(Trial('%s/%s/%s/%s/%03d' % (self.name, base, cell.name, method, i), c,
                                         dict(self.fixed, index=i, method=method, **cell.options)))

    def references(self):
        """The bag as it is, by each method, where noise is added to it: the truth."""
        return [Trial('reference/sample/duration_%g/%s' % (self.fixed['duration'], method), 0,
                      dict(self.fixed, index=1, method=method))
                for method in METHODS if self.base == 'sample' and not self.is_compared]


def trial_outcome(status, output, error):
    """Of evaluate_trial. Input that cannot be used ends all."""
    if status == 1:
        raise InputError(reason_of(error))
    return output if status == 0 else 'verdict: failed\nreason: it died or took too long\n'


class Evaluation:
    """Of what the command line asks for. `about`: what evaluate_trial --about says."""

    def __init__(self, wanted, about):
        self.wanted, self.about, self.folder = wanted, about, wanted.out
        self.plans = [Plan(experiment, base, wanted)
                      for experiment in choose(experiments(about['effects']), wanted.experiments)
                      for base in experiment.bases if base in wanted.bases]
        if not self.plans:
            raise InputError('none of the experiments runs on a bag; leave out --bag or add --simulate')

    def task(self, trial, reference=None):
        options = [word for name, value in trial.options.items()
                   for word in (['--' + name] if value is True else ['--' + name, str(value)])]
        return Task(trial.name, describe([self.about['version']] + options), [program('evaluate_trial')] + options + (
            ['--reference', json.dumps(reference)] if reference else []), trial_outcome)

    def outcome(self, trial):
        return yaml.load(finished(self.folder, self.task(trial)), LOADER)

    def run(self):
        """Runs the trials that are missing, and, as soon as those of all parts are there, writes tables and figures,
        which follow from the trials alone. Returns the text that says what was done."""
        wanted, found = self.wanted, {}  # references by name
        trials = {trial.name: trial for plan in self.plans for trial in plan.references()}
        tasks = [self.task(trials[name]) for name in sorted(trials)]
        if not wanted.merge:  # every part needs them
            run_tasks(tasks, self.folder, wanted.jobs, title='references', quiet=wanted.quiet)
        if not missing(self.folder, tasks):
            found = {name: self.outcome(trial) for name, trial in trials.items()}
        for name, outcome in found.items():
            if not is_usable(outcome):
                raise InputError("the bag '%s' cannot be evaluated with %s: %s"
                                 % (wanted.bag, trials[name].options['method'], outcome['reason']))
        own = []
        for plan in self.plans:
            references = {trial.options['method']: found.get(trial.name) for trial in plan.references()}
            own += [self.task(trial, references.get(trial.options['method'])) for trial in plan.trials]
        if not wanted.merge:
            run_tasks(own, self.folder, wanted.jobs, wanted.part, wanted.parts, 'trials', wanted.quiet)
        tasks += own
        absent = len(missing(self.folder, tasks))
        if absent > 0 and wanted.merge:
            raise InputError("%d of %d trials are missing in '%s'; run them, and merge again"
                             % (absent, len(tasks), self.folder))
        if wanted.parts > 1:  # others may be at it, too
            return '%d of %d trials are done; --merge makes the tables\n' % (len(tasks) - absent, len(tasks))
        self.write_tables()
        return "tables and figures are in '%s': evaluation.md\n" % self.folder

    def compared(self, plan, method):
        """The usable calibrations of a method, every pair of them, and each less the chained one, with names."""
        results = [dict(trial.outcome, name=', '.join(plan.cells[trial.cell].labels) or
                        'recording %d' % trial.options['index'])
                   for trial in plan.trials if trial.options['method'] == method and trial.is_usable]
        named = [(result['name'], calibration(result)) for result in results]
        found = {'results': results,
                 'pairs': [('%s less %s' % (second, first), compare(a, b, (*TRANSFORM, 'accel delay')))
                           for (first, a), (second, b) in itertools.combinations(named, 2)]}
        if named and self.wanted.chained and plan.base == 'sample':
            found['chain'] = [(name, compare(self.wanted.chained, one, TRANSFORM)) for name, one in named]
        return found

    def write_tables(self):
        for plan in self.plans:
            for trial in plan.trials:
                trial.take(self.outcome(trial))
            plan.compared = {m: self.compared(plan, m) for m in METHODS} if plan.is_compared else {}
        for name, text in evaluation_tables.evaluation(self.wanted, self.about, self.plans).items():
            write(os.path.join(self.folder, name), text)
        try:
            import evaluation_figures
        except ImportError as error:
            raise InputError('the figures cannot be drawn: %s: apt install python3-matplotlib' % error)
        evaluation_figures.draw(self.folder)
