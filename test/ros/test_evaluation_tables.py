#!/usr/bin/python3
"""Of scripts/evaluation_tables.py; test_evaluation runs it."""

import math
import pathlib
import sys
import unittest

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / 'scripts'))
sys.dont_write_bytecode = True
import evaluation_tables as tables  # noqa: E402


def trial(error):
    """A trial whose position is off by that [m]."""
    numbers = [0.0, error, 0.0, 0.0] + [0.0, 3e-3, 0.0, 0.0] + [0.0, 2e-3, 0.0, 0.0] + [0.0] * 4 + [16.0, 8.0, 0.0, 0.0]
    verdict = 'ok' if error < 0.5 else 'refused'
    return tables.Trial(['0', '0', 'gp', 'name', verdict, ''] + [repr(value) for value in numbers])


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


if __name__ == '__main__':
    unittest.main()
