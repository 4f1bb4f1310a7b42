#!/usr/bin/python3
"""Of the scripts of evaluate; test_evaluation runs it: test_evaluation.py FOLDER_OF_PROGRAMS"""

import argparse
import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time
import unittest
from signal import SIGKILL

import yaml

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'scripts'))
sys.dont_write_bytecode = True
import command_line  # noqa: E402
import comparison  # noqa: E402
import evaluation_runner as runner  # noqa: E402
import evaluation_sequences as sequences  # noqa: E402
import evaluation_tables as tables  # noqa: E402
import evaluation_trials as trials  # noqa: E402

ABOUT = {}  # what evaluate_trial says of itself


class InFolder(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name

    def path(self, name):
        return os.path.join(self.folder, name)

    def write(self, name, text):
        path = pathlib.Path(self.path(name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


class Runner(InFolder):
    def task(self, name, command, description='as is'):
        return runner.Task(name, description, ['sh', '-c', command], trials.trial_outcome)

    def marked(self, name, description='as is'):
        """Leaves a mark each time it runs."""
        return self.task(name, 'printf x >> %s; echo result of %s' % (self.path(name + '.mark'), name), description)

    def marks(self, name):
        return os.path.getsize(self.path(name + '.mark'))

    def used(self, part):
        """Tasks of a part of which time and memory are known."""
        with open(self.path('usage_%s.csv' % part)) as file:
            rows = [line.split(',') for line in file]
        self.assertTrue(all(float(wall) >= 0.0 and float(memory) > 0.1 for _, wall, _, memory in rows), rows)
        return len(rows)

    def test_keeps_what_is_done(self):
        tasks = [self.marked('a'), self.marked('b')]
        runner.run_tasks(tasks[:1], self.folder, 2)
        runner.run_tasks(tasks, self.folder, 2)
        self.assertEqual((self.marks('a'), self.marks('b')), (1, 1))
        self.assertEqual(runner.finished(self.folder, tasks[0]), 'result of a\n')
        self.assertEqual(self.used('1_1'), 2)
        self.assertEqual(sorted(os.listdir(self.path('trials'))), ['a.yaml', 'b.yaml'])

    def test_runs_again_what_follows_from_something_else(self):
        runner.run_tasks([self.marked('a')], self.folder, 2)
        changed = self.marked('a', 'otherwise')
        self.assertIsNone(runner.finished(self.folder, changed))
        runner.run_tasks([changed], self.folder, 2)
        self.assertEqual(self.marks('a'), 2)

    def test_a_file_that_was_replaced_is_another(self):
        self.write('x.bag', 'some')
        words = ['--bag', self.path('x.bag')]
        before = runner.describe(words)
        self.assertEqual(runner.describe(words), before)
        self.write('x.bag', 'same')
        os.utime(self.path('x.bag'), (1e9, 1e9))
        self.assertNotEqual(runner.describe(words), before)

    def test_every_task_is_in_one_part(self):
        tasks = [self.marked(name) for name in 'abcde']
        for part in range(3):
            runner.run_tasks(tasks, self.folder, 2, part, 3)
        self.assertEqual([self.marks(name) for name in 'abcde'], [1] * 5)
        self.assertEqual(self.used('1_3') + self.used('2_3') + self.used('3_3'), 5)

    def test_a_task_that_dies_fails_alone(self):
        dies, works = self.task('dies', 'kill -9 $$'), self.marked('works')
        runner.run_tasks([dies, works], self.folder, 2)
        self.assertEqual(yaml.safe_load(runner.finished(self.folder, dies)),
                         {'verdict': 'failed', 'reason': 'it died or took too long'})
        self.assertEqual(runner.finished(self.folder, works), 'result of works\n')

    def test_an_input_error_ends_it(self):
        wrong = self.task('wrong', 'echo "sh: error: no such bag" >&2; exit 1')
        slow = self.task('slow', 'exec sleep 60')
        begin = time.monotonic()
        with self.assertRaisesRegex(command_line.InputError, '^no such bag$'):
            runner.run_tasks([slow, wrong], self.folder, 2)
        self.assertLess(time.monotonic() - begin, 30.0)
        self.assertEqual(len(runner.missing(self.folder, [wrong, slow])), 2)

    def test_what_a_task_may_use_is_limited_and_it_ends_with_this_process(self):
        ask_signal = 'import ctypes; n = ctypes.c_int(); ctypes.CDLL(None).prctl(2, ctypes.byref(n)); print(n.value)'
        task = self.task('limits', 'ulimit -c; ulimit -t; ulimit -v;'  # blocks, [s], [kB]
                         'exec /usr/bin/python3 -c "%s"' % ask_signal)
        runner.run_tasks([task], self.folder, 1)
        self.assertEqual(runner.finished(self.folder, task).split(), ['0', '3600', str(16 << 20), str(int(SIGKILL))])


def wanted(**given):
    return argparse.Namespace(**dict({'bag': 'x/my.bag', 'start': 0.0, 'duration': 40.0, 'trials': 6, 'rig': []},
                                     **given))


class Experiments(unittest.TestCase):
    def setUp(self):
        self.all = {experiment.name: experiment for experiment in trials.experiments(ABOUT['effects'])}

    def test_every_trial_has_a_name_of_its_own(self):
        names = [trial.name for experiment in self.all.values() for base in experiment.bases
                 for trial in trials.Plan(experiment, base, wanted()).trials]
        self.assertEqual(len(names), len(set(names)))
        self.assertIn('guess/simulation/guess_wrong/joint/040', names)  # 20 / 3 as many
        self.assertIn('duration/simulation/duration_5.1/gp/002', names)  # a third
        self.assertNotIn('duration/simulation/duration_5.1/gp/003', names)
        self.assertIn('repeatability/simulation/all/gp/004', names)
        self.assertIn('repeatability/sample/recording_my_25-50_s/gp/001', names)
        self.assertIn('effects/simulation/effect_size-effect_0.003/joint/002', names)
        self.assertNotIn('guess/sample/guess_none/gp/002', names)  # would be the same again

    def test_noise_of_a_cell_is_what_its_labels_say(self):
        plan = trials.Plan(self.all['pose_noise'], 'simulation', wanted(trials=1))
        self.assertEqual(len(plan.cells), 9)  # of the paper
        self.assertEqual(plan.cells[5].labels, ['0.005', '0.01'])
        self.assertEqual((plan.trials[5].cell, plan.trials[5].options['add-position'],
                          plan.trials[5].options['add-rotation']), (5, 0.005, 0.01))
        self.assertNotIn('add-gyro', plan.trials[5].options)

    def test_a_bag_is_as_long_as_is_wanted_and_enough(self):
        for given, name, used in ((40.0, 'imu_noise', 40.0), (40.0, 'guess', 20), (10.0, 'guess', 10.0),
                                  (0.0, 'guess', 20), (0.0, 'imu_noise', 0)):
            plan = trials.Plan(self.all[name], 'sample', wanted(duration=given))
            self.assertEqual([trial.options['duration'] for trial in plan.trials + plan.references()],
                             [used] * (len(plan.trials) + 2))
            self.assertNotIn('position-std', plan.trials[0].options)


class EvaluateTrial(InFolder):
    SHORT = ('--method', 'gp', '--duration', '12')

    def run_trial(self, *words):
        return command_line.ask([command_line.program('evaluate_trial')] + list(self.SHORT) + list(words))

    def test_is_the_same_again_and_is_read_back_exactly(self):
        words = '--add-position 1e-3 --add-rotation 1e-3 --outliers 0.5 --lost 10 --accel-delay -1e-3 --index'.split()
        outcome = self.run_trial(*words, '3')
        self.assertEqual(outcome['verdict'], 'ok', outcome)
        self.assertEqual(self.run_trial(*words, '3'), outcome)
        self.assertNotEqual(self.run_trial(*words, '4')['translation'], outcome['translation'])
        self.assertTrue(0.0 < float(outcome['error'][1]) < 0.01, outcome)  # [m]
        self.assertNotIn('bound', outcome)  # of the joint solve alone
        same = comparison.compare(*[comparison.calibration(outcome)] * 2)
        self.assertEqual((same.distance, same.angle, same.chi2, same.dof), (0.0, 0.0, 0.0, 8))

    def test_noise_is_added_to_a_bag(self):
        bag = self.path('A.bag')
        subprocess.run([command_line.program('simulate_bag'), bag, '--duration', '12', '--position-std', '1e-4',
                        '--rotation-std', '1e-4'], check=True)
        reference = self.run_trial('--bag', bag)
        self.assertNotIn('error', reference)  # without a truth

        def errors(noise):
            outcome = self.run_trial('--bag', bag, '--reference', json.dumps(reference), '--index', '3',
                                     '--add-position', noise, '--add-rotation', noise)
            return [float(error) for error in outcome['error']]
        self.assertEqual(errors('0'), [0.0] * 4)
        self.assertGreater(errors('5e-3')[0], 3.0 * errors('2e-4')[0])

    def test_noise_of_poses_costs_the_sample_no_more_than_it_says(self):
        # Where splines cannot follow what the samples of an IMU tell, p was up to 12 sigma off and the mount soft; where no
        # sample sees them, passes did not settle: at ends of runs and where equal readings in a row leave gaps.
        def trial(index, *noise):
            return command_line.ask([command_line.program('evaluate_trial'), '--bag', ABOUT['sample'], '--method', 'joint',
                                     '--duration', '40', '--index', index, *noise])
        exact = trial('1')
        for position, rotation, index in (('1e-3', '1e-3', '1'), ('5e-3', '1e-3', '1'), ('5e-3', '5e-3', '3')):
            noisy = trial(index, '--add-position', position, '--add-rotation', rotation)
            self.assertEqual(noisy['verdict'], 'ok', noisy)
            for axis in range(3):
                move = float(noisy['translation'][axis]) - float(exact['translation'][axis])
                variance = sum(float(outcome['covariance'][axis][axis]) for outcome in (exact, noisy))
                self.assertLess(abs(move), 3.0 * math.sqrt(variance), (position, rotation, axis))

    def test_refuses_and_fails(self):
        with self.assertRaisesRegex(command_line.InputError, "^motion 'fly' is unknown; must be handheld, "):
            self.run_trial('--motion', 'fly')
        with self.assertRaisesRegex(command_line.InputError, '^--guess of a bag needs its --reference$'):
            self.run_trial('--bag', 'x.bag', '--guess')
        outcome = self.run_trial('--guess', '--pose-rate', '0.5')
        self.assertEqual((outcome['verdict'], sorted(outcome)), ('refused', ['guess', 'reason', 'verdict']))

    def test_constants_are_what_the_tables_say(self):
        self.assertEqual([float(bound) for bound in ABOUT['within']], [0.01, 0.01, 2e-3])
        self.assertTrue(os.path.isfile(ABOUT['sample']))


def trial(error):
    """A trial whose position is off by that [m]."""
    taken = tables.Trial('name', 0, {'method': 'gp'})
    taken.take({'verdict': 'ok' if error < 0.5 else 'refused', 'reason': '', 'error': ['0', repr(error), '0', '0'],
                'std': ['0.001', '0.002', '0.002', '0', '0', '0'], 'bound': ['0', '0.002', '0', '0'],
                'chi2': ['16', '8']})
    return taken


class Tables(unittest.TestCase):
    def test_quantiles_of_chi_square(self):
        low, high = tables.chi_square_band(8.0)  # from tables of the distribution
        self.assertAlmostEqual(8.0 * low, 2.180, delta=0.03)
        self.assertAlmostEqual(8.0 * high, 17.535, delta=0.03)
        self.assertAlmostEqual(240.0 * tables.chi_square_band(240.0)[1], 284.80, delta=0.1)

    def test_summarizes_usable_trials(self):
        cell = tables.Summary([trial(error) for error in (3e-3, 4e-3, 30e-3, 1.0)], [0.01, 0.01, 2e-3])
        self.assertEqual((cell.trials, cell.usable, cell.within), (4, 3, 2))
        self.assertAlmostEqual(cell.norms['error'][1], math.sqrt((9e-6 + 16e-6 + 900e-6) / 3.0), delta=1e-12)
        self.assertAlmostEqual(cell.norms['sigma'][1], 3e-3, delta=1e-12)
        self.assertAlmostEqual(cell.norms['bound'][1], 2e-3, delta=1e-12)
        self.assertAlmostEqual(cell.chi2, 2.0, delta=1e-12)
        self.assertAlmostEqual(cell.model_chi2, 1.0, delta=1e-12)

    def test_cells_of_the_paper(self):
        self.assertEqual([len(cells) for _, cells in tables.PAPER.values()], [9, 9])
        self.assertEqual(tables.PAPER['pose_noise'][1][5][1], 13.8)  # Table 5, second row, last column

    def test_numbers_have_three_digits(self):
        self.assertEqual([tables.number(x) for x in (0.0, math.nan, 123.4, 1.234, 0.012345, 1e-9)],
                         ['', '', '123', '1.23', '0.0123', '0.000000'])


class Sequences(InFolder):
    def test_sources_of_poses_of_a_dataset(self):
        imu = '#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],a_RS_S_x [m s^-2]\n'
        position = '#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]'
        for name, header in (('imu0', imu), ('leica0', position + '\n'), ('cam0', '#timestamp [ns],filename\n'),
                             ('mocap0', position + ', q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n')):
            self.write('rooms/V1/mav0/%s/data.csv' % name, header)
        self.write('rooms/V1/mav0/imu0/sensor.yaml', 'T_BS: {data: [1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]}\n')
        found, = sequences.find_sequences('tum-vi', self.folder)
        self.assertEqual(found[:2], ('rooms/V1/mocap0', 'rooms/mocap0'))
        self.assertEqual(found.published[0], [1.0, 0.0, 0.0, 0.0])  # said to be those of the IMU
        self.assertIsNone(sequences.find_sequences('broad', self.folder)[0].published)
        mocap = 'rooms/V1/mav0/mocap0/sensor.yaml'
        self.write(mocap, 'T_BS: {data: [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n')
        self.assertEqual(sequences.find_sequences('euroc', self.folder)[0].published,
                         [[0, 1, 0, 2], [-1, 0, 0, -1], [0, 0, 1, 3], [0, 0, 0, 1]])
        self.write(mocap, 'T_BS: {data: [1, 2]}\n')
        with self.assertRaisesRegex(command_line.InputError, 'mocap0/sensor.yaml.*16 elements'):
            sequences.find_sequences('euroc', self.folder)

    def test_a_dataset_may_be_bags(self):
        self.write('rooms/room1.bag', '')
        bag, = sequences.find_sequences('tum-vi', self.folder)
        self.assertEqual(bag[:2], ('rooms/room1', 'rooms/bags'))
        self.assertEqual(bag.words, [self.path('rooms/room1.bag'), '--imu-topic', '/imu0'])
        bag, = sequences.find_sequences('euroc', self.folder, ['--imu-topic', '/imu1'])
        self.assertEqual(bag.words[1:], ['--imu-topic', '/imu1'])


if __name__ == '__main__':
    command_line.PROGRAMS = sys.argv.pop(1)
    ABOUT = command_line.ask([command_line.program('evaluate_trial'), '--about'])
    unittest.main()
