#!/usr/bin/python3
"""Of scripts/comparison.py and calibration_files.py; test_compare runs it."""

import math
import os
import pathlib
import sys
import tempfile
import unittest

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'scripts'))
sys.dont_write_bytecode = True
import calibration_files as files  # noqa: E402
import comparison  # noqa: E402
from command_line import InputError  # noqa: E402
from comparison import (Calibration, compare, exp, mean, quaternion, repeat, rotation, rotation_vector,  # noqa: E402
                        stack)

ALL = tuple(comparison.QUANTITIES)


def example():
    """Its components are correlated within translation and rotation."""
    A = np.array([[1.0, 0.0, 0.0], [0.7, 0.6, 0.0], [-0.3, 0.2, 1.5]])
    covariance = np.zeros((8, 8))
    covariance[:3, :3] = 1e-6 * A @ A.T
    covariance[3:6, 3:6] = 1e-8 * A.T @ A
    covariance[6:, 6:] = np.diag([1e-5 ** 2, 2e-5 ** 2])
    return Calibration(comparison.transform(exp(np.array([0.7, -0.4, 1.9])), [0.1, -0.2, 0.3]),
                       np.array([0.003, -1034771.5]), covariance)


def moved(one, x, covariance=None):
    """By a difference of 8 values."""
    T = comparison.transform(one.T[:3, :3] @ exp(np.array(x[3:6], float)), one.T[:3, 3] + x[:3])
    return Calibration(T, one.times + x[6:], one.covariance if covariance is None else covariance)


class Rotations(unittest.TestCase):
    def test_of_quaternions(self):
        angle = 2 * math.asin(0.6)
        for q, vector in ((('0', '0', '0', '-1'), [0, 0, 0]), (('0', '0.6', '0', '0.8'), [0, angle, 0]),
                          (('0', '-0.6', '0', '-0.8'), [0, angle, 0]), (('1', '0', '0', '0'), [math.pi, 0, 0])):
            np.testing.assert_allclose(rotation_vector(rotation(q)), vector, atol=1e-15)

    def test_there_and_back(self):
        random = np.random.RandomState(1)
        for scale in (0.0, 1e-9, 1e-3, 1.0):
            for vector in scale * random.uniform(-1.8, 1.8, (100, 3)):
                R = exp(vector)
                np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
                self.assertAlmostEqual(np.linalg.det(R), 1.0, delta=1e-14)
                np.testing.assert_allclose(rotation_vector(R), vector, rtol=1e-7, atol=1e-15)
                np.testing.assert_allclose(rotation(quaternion(R)), R, atol=1e-15)

    def test_turns_as_quaternions_do(self):
        # A quarter about z takes x to y.
        np.testing.assert_allclose(exp(np.array([0, 0, math.pi / 2])) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


class Comparing(unittest.TestCase):
    def test_of_the_same_is_none(self):
        found = compare(example(), example(), ALL)
        self.assertEqual(len(found.components), 8)
        self.assertEqual((found.dof, found.chi2, found.worst().sigmas), (8, 0.0, 0.0))
        self.assertEqual((found.distance, found.angle), (0.0, 0.0))

    def test_says_second_less_first_and_the_sigma_of_both(self):
        first = example()
        covariance = first.covariance.copy()
        covariance[:6, :6] *= 3.0
        covariance[7, 7] = 0.0  # given
        found = compare(first, moved(first, [0.001, -0.002, 0.003, 0.01, 0.0, -0.02, 1e-4, 5e-4], covariance))
        x = found.components
        self.assertAlmostEqual(x[1].value, -0.002, delta=1e-15)
        self.assertAlmostEqual(x[1].sigma, 2.0 * np.sqrt(first.covariance[1, 1]), delta=1e-12)
        self.assertAlmostEqual(x[3].value, 0.01, delta=1e-12)
        self.assertAlmostEqual(x[5].value, -0.02, delta=1e-12)
        self.assertEqual([c.name for c in x[4:]], ['rotation y', 'rotation z', 'accel delay', 'time shift'])
        self.assertAlmostEqual(x[6].value, 1e-4, delta=1e-15)
        self.assertAlmostEqual(x[6].sigma, np.sqrt(2.0) * 1e-5, delta=1e-15)
        self.assertAlmostEqual(x[7].value, 5e-4, delta=1e-9)
        self.assertAlmostEqual(x[7].sigma, 2e-5, delta=1e-15)
        self.assertAlmostEqual(x[7].sigmas, 25.0, delta=1e-4)
        self.assertAlmostEqual(found.distance, np.sqrt(14.0) * 1e-3, delta=1e-12)
        self.assertAlmostEqual(found.angle, np.hypot(0.01, 0.02), delta=1e-12)
        self.assertEqual(found.most('time shift'), x[7].sigmas)

    def test_takes_covariances_of_rotations_in_one_frame(self):
        first, covariance = example()._replace(covariance=np.zeros((8, 8))), np.zeros((8, 8))
        covariance[3:6, 3:6] = np.diag([1e-8, 4e-8, 9e-8])
        # x of second is y of first
        second = moved(first, [0, 0, 0, 0, 0, math.pi / 2, 0, 0], covariance)
        sigmas = [x.sigma for x in compare(first, second, ['rotation']).components]
        np.testing.assert_allclose(sigmas, [2e-4, 1e-4, 3e-4], atol=1e-12)

    def test_judges_nothing_that_is_not_estimated(self):
        first = example()._replace(covariance=np.zeros((8, 8)))
        found = compare(first, moved(first, [1.0, 0, 0, 0, 0, 0, 0, 0]), ['translation'])
        self.assertIsNone(found.worst())
        self.assertEqual(found.dof, 0)
        self.assertEqual(found.components[0].value, 1.0)


def draw(count, seed, scale):
    """Calibrations that scatter as their covariances say."""
    random, drawn = np.random.RandomState(seed), []
    for i in range(count):
        covariance = (1.0 + i % 3) ** 2 * example().covariance  # some are better than others
        drawn.append(moved(example(), scale * np.linalg.cholesky(covariance) @ random.normal(size=8), covariance))
    return drawn


class Repeating(unittest.TestCase):
    def test_chi_square_is_that_of_the_scatter(self):
        trials = 200
        chi2, dof, covered = np.zeros(4), np.zeros(4), 0.0
        for seed in range(trials):
            found = repeat(draw(6, seed, 1.0), ALL)
            chi2 += [x.chi2 for x in found.scatters]
            dof += [x.dof for x in found.scatters]
            covered += compare(example(), found.mean, ['translation']).chi2
        np.testing.assert_array_equal(dof, np.array([15, 15, 5, 5]) * trials)
        self.assertTrue(np.all(np.abs(chi2 / dof - 1.0) < 4.0 * np.sqrt(2.0 / dof)), chi2 / dof)
        # The truth's own covariance is in the comparison, so less than 3 a trial.
        self.assertLess(covered / trials, 3.0)

    def test_scatter_beyond_the_sigmas_shows(self):
        for x in repeat(draw(30, 5, 4.0), ALL).scatters:
            self.assertGreater(x.chi2 / x.dof, 5.0, x.quantity)
            self.assertGreater(x.chi2, comparison.chi_square(x.dof))
            self.assertTrue(np.all(x.deviation > 2.0 * x.sigma), x)

    def test_the_odd_one_stands_out_from_the_others(self):
        calibrations = draw(5, 7, 1.0)
        calibrations[3] = moved(calibrations[3], [0, 0, 0, 0, 0.01, 0, 0, 0])
        worst = [x.worst() for x in repeat(calibrations, ALL).from_others]
        self.assertEqual(worst[3].name, 'rotation y')
        self.assertGreater(worst[3].value, 0.009)
        self.assertTrue(all(x.sigmas < worst[3].sigmas for x in worst[:3] + worst[4:]), worst)

    def test_mean_weighs_by_inverse_variance(self):
        weights = np.diag([1e-8] * 6 + [1e-10, 4e-10])
        good = example()._replace(covariance=weights)
        worse = weights.copy()
        worse[:6, :6] *= 3.0
        bad = moved(good, [0.004, 0, 0, 0, 0, 0.008, 0, 0.004], worse)
        found = mean(stack([good, bad]))
        self.assertAlmostEqual(found.T[0, 3], good.T[0, 3] + 0.001, delta=1e-12)
        self.assertAlmostEqual(found.covariance[0, 0], 0.75e-8, delta=1e-15)
        self.assertAlmostEqual(rotation_vector(good.T[:3, :3].T @ found.T[:3, :3])[2], 0.002, delta=1e-9)
        self.assertAlmostEqual(found.times[1], good.times[1] + 0.002, delta=1e-9)
        self.assertAlmostEqual(np.sqrt(found.covariance[7, 7]), 2e-5 / np.sqrt(2.0), delta=1e-12)

    def test_mean_is_plain_without_sigmas(self):
        exact = example()._replace(covariance=np.zeros((8, 8)))
        found = mean(stack([exact, moved(example(), [0.004, 0, 0, 0, 0, 0.008, 0, 0])]))
        self.assertAlmostEqual(found.T[0, 3], exact.T[0, 3] + 0.002, delta=1e-12)
        self.assertEqual(np.abs(found.covariance).max(), 0.0)


class Files(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.path = os.path.join(folder.name, 'x.yaml')

    def refuses(self, text, words, read=lambda path: files.read_transform('--reference', path)):
        pathlib.Path(self.path).write_text(text)
        with self.assertRaisesRegex(InputError, words):
            read(self.path)

    def test_errors_name_file_and_key(self):
        self.refuses('', "^--reference '.*x.yaml': must hold x y z")
        self.refuses('- 1\n', 'must hold x y z')
        self.refuses('a: [1\nb: 2\n', "x.yaml': line 2: ")
        self.refuses('a: ' + 100000 * '[', 'line 1: nested deeper than 20 levels$')
        self.refuses('transform: {translation: [1, 2], rotation: [0, 0, 0, 1]}',
                     'transform: translation must be a list of 3 numbers$')
        self.refuses('{translation: [1, 2, .nan], rotation: [0, 0, 0, 1]}', 'translation must hold finite numbers$')
        self.refuses('{translation: [1, 2, 3]}', "x.yaml': rotation is missing$")
        self.refuses('{translation: [1, 2, 3], rotation: [0, 0, 0, 2]}', 'unit quaternion x, y, z, w; its norm is 2$')
        self.refuses('matrix: [[1, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]', 'matrix must hold 4 x 4 '
                     'finite numbers$')
        self.refuses('matrix: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]',
                     'matrix must be a rotation and a translation$')
        self.refuses('imu_pose_calib: {status: degenerate, message: m}',
                     "^result '.*x.yaml': imu_pose_calib: status is 'degenerate'; only",
                     lambda path: files.load_results([path], 0))
        self.refuses('a: 1', 'has no key imu_pose_calib$', lambda path: files.load_results([path], 0))
        self.refuses('cam0: {T_cam_imu: 1}', "^camera chain '.*': cam0: T_cam_imu must have 4 rows of 4$",
                     lambda path: files.read_camera(path, 'cam0'))

    def test_numbers_of_a_transform(self):
        T = files.read_transform('--reference', '1, 2 3 0 0 0.7071 0.7071')
        np.testing.assert_allclose(T, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)


if __name__ == '__main__':
    unittest.main()
