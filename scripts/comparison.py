"""Compares calibrations of one IMU, taken as independent: for compare_calibrations, its page and evaluate."""

from collections import namedtuple

import numpy as np

AGREEMENT = 5  # [sigma] Calibrations agree when no component differs by more
DEGREES = 180 / np.pi

# What is compared: its place in a difference, and how it is shown.
Quantity = namedtuple('Quantity', 'place unit factor')
QUANTITIES = {'translation': Quantity(slice(0, 3), 'mm', 1e3), 'rotation': Quantity(slice(3, 6), 'deg', DEGREES),
              'accel delay': Quantity(slice(6, 7), 'ms', 1e3), 'time shift': Quantity(slice(7, 8), 'ms', 1e3)}
TRANSFORM = ('translation', 'rotation')

# T: T_marker_imu, 4 x 4 [m]; times: accel delay and time shift [s], that of the same instant in all; covariance: of p
# in the marker frame [m], rotation about the imu axes [rad], times. A variance of 0: given, not estimated.
Calibration = namedtuple('Calibration', 'T times covariance')
# Of a difference. name: 'translation x'; sigma: 0 when neither is estimated, so that nothing is judged.
Component = namedtuple('Component', 'quantity name value sigma sigmas')
# How one quantity scatters. deviation: about the plain mean; sigma: root mean square; chi2: about the weighted mean,
# not judged with a dof of 0.
Scatter = namedtuple('Scatter', 'quantity deviation sigma chi2 dof')
# from_others: each less the mean of all others.
Repeatability = namedtuple('Repeatability', 'mean scatters from_others')


class Comparison(namedtuple('Comparison', 'components chi2 dof distance angle')):
    """chi2, dof: of the quantities that are judged; distance, angle: [m], [rad]."""

    def worst(self):
        """The component with most sigmas; None when none is judged."""
        return max((x for x in self.components if x.sigma > 0), key=lambda x: x.sigmas, default=None)

    def most(self, quantity):
        return max(x.sigmas for x in self.components if x.quantity == quantity)


# --- Transforms ---

def rotation(q):
    """Matrix of a quaternion x, y, z, w."""
    x = np.array(q, float)
    v, w = np.split(x / np.linalg.norm(x), [3])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * np.cross(np.eye(3), v)


def quaternion(R):
    """x, y, z, w of rotation matrices, w not negative."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, (-2, -1), (0, 1))
    outer = np.moveaxis(np.array([[1 + a - e - i, b + d, c + g, h - f],  # 4 q q^T
                                  [b + d, 1 - a + e - i, f + h, c - g],
                                  [c + g, f + h, 1 - a - e + i, d - b],
                                  [h - f, c - g, d - b, 1 + a + e + i]]), (0, 1), (-2, -1))
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, largest[..., None, None], -2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True) * np.where(q[..., 3:] < 0, -1, 1)


def rotation_vector(R):
    """[rad] Of rotation matrices."""
    q = quaternion(R)
    half = np.arctan2(np.linalg.norm(q[..., :3], axis=-1, keepdims=True), q[..., 3:])
    return 2 * q[..., :3] / np.sinc(half / np.pi)


def exp(vector):
    """The matrix of a rotation vector [rad]."""
    angle = np.linalg.norm(vector)
    return rotation(np.r_[0.5 * np.sinc(angle / (2 * np.pi)) * vector, np.cos(angle / 2)])


def transform(R, p):
    """4 x 4"""
    return np.block([[R, np.array(p, float)[:, None]], [np.zeros(3), 1]])


# --- Calibrations ---

def calibration(found):
    """Of translation, rotation (a quaternion), covariance, accel_delay and time_shift (each with its sigma), as
    evaluate_trial prints them: numbers may be texts."""
    times = np.array([found['accel_delay'], found['time_shift']], float)
    covariance = np.zeros((8, 8))
    covariance[:6, :6] = np.array(found['covariance'], float)
    covariance[6:, 6:] = np.diag(times[:, 1] ** 2)
    return Calibration(transform(rotation(found['rotation']), found['translation']), times[:, 0], covariance)


def given(T, std=(0, 0)):
    """A transform that is given, with sigmas of position [m] and rotation [rad] along each axis."""
    return Calibration(np.array(T, float), np.zeros(2), np.diag(np.repeat([*std, 0], (3, 3, 2)) ** 2.0))


def stack(calibrations):
    """As one whose arrays have a first axis more."""
    return Calibration(*map(np.array, zip(*calibrations)))


def less(ones, reference):
    """A calibration or several less a reference, and their own covariances: rotations are from the axes of the
    reference."""
    turns = reference.T[:3, :3].T @ ones.T[..., :3, :3]
    axes = np.zeros(ones.covariance.shape) + np.eye(8)
    axes[..., 3:6, 3:6] = turns
    x = (ones.T[..., :3, 3] - reference.T[:3, 3], rotation_vector(turns), ones.times - reference.times)
    return np.concatenate(x, axis=-1), axes @ ones.covariance @ axes.swapaxes(-1, -2)


def are_estimated(covariances):
    """One or several."""
    return np.all(np.isfinite(covariances)) and np.all(np.linalg.eigvalsh(covariances) > 0)


def squared(x, covariance):
    return x @ np.linalg.solve(covariance, x)


def chi_square(dof, sigmas=3):
    """Which chance exceeds as rarely as a normal distribution exceeds that many sigma: Wilson and Hilferty."""
    return dof * (1 - 2 / (9 * dof) + sigmas * np.sqrt(2 / (9 * dof))) ** 3


def component_names(quantity):
    """"translation x", ...; of a time the name alone."""
    place = QUANTITIES[quantity].place
    return ['%s %s' % (quantity, axis) for axis in 'xyz'] if place.stop - place.start == 3 else [quantity]


def compare(first, second, quantities=tuple(QUANTITIES)):
    """Second less first."""
    x, covariance = less(second, first)
    covariance = covariance + first.covariance
    components, chi2, dof = [], 0.0, 0
    for quantity in quantities:
        k = QUANTITIES[quantity].place
        for name, value, variance in zip(component_names(quantity), x[k], np.diag(covariance)[k]):
            sigma = np.sqrt(max(0.0, variance))
            components.append(Component(quantity, name, value, sigma, abs(value) / sigma if sigma > 0 else 0.0))
        if are_estimated(covariance[k, k]):
            chi2 += squared(x[k], covariance[k, k])
            dof += len(x[k])
    return Comparison(components, chi2, dof, np.linalg.norm(x[:3]), np.linalg.norm(x[3:6]))


def weighted_mean(x, covariances):
    """By the inverse covariances, and its covariance; the plain mean and 0 when one has none."""
    if not are_estimated(covariances):
        return x.mean(axis=0), 0.0
    weights = np.linalg.inv(covariances)
    covariance = np.linalg.inv(weights.sum(axis=0))
    return covariance @ np.einsum('nij,nj->i', weights, x), covariance


def mean(ones):
    """Of each quantity. One that is not estimated in all of them has the plain mean, and sigma 0."""
    middle = Calibration(*(array[0] for array in ones))
    for _ in range(10):  # the tangent space of rotations moves with the mean
        x, covariances = less(ones, middle)
        step, covariance = np.zeros(8), np.zeros((8, 8))
        for quantity in QUANTITIES.values():
            k = quantity.place
            step[k], covariance[k, k] = weighted_mean(x[:, k], covariances[:, k, k])
        T = transform(middle.T[:3, :3] @ exp(step[3:6]), middle.T[:3, 3] + step[:3])
        middle = Calibration(T, middle.times + step[6:], covariance)
    return middle


def scatter(quantity, x, covariances):
    count, size = x.shape
    chi2, dof = 0.0, 0
    if are_estimated(covariances):
        middle, _ = weighted_mean(x, covariances)
        chi2, dof = sum(map(squared, x - middle, covariances)), size * (count - 1)
    sigma = np.sqrt(np.diag(covariances.mean(axis=0)))
    return Scatter(quantity, x.std(axis=0, ddof=1), sigma, chi2, dof)


def repeat(calibrations, quantities=tuple(QUANTITIES)):
    """Of at least two calibrations of one rig."""
    ones = stack(calibrations)
    middle = mean(ones)
    x, covariances = less(ones, middle)
    scatters = []
    for quantity in quantities:
        k = QUANTITIES[quantity].place
        scatters.append(scatter(quantity, x[:, k], covariances[:, k, k]))
    others = [mean(Calibration(*(np.delete(array, i, axis=0) for array in ones))) for i in range(len(calibrations))]
    return Repeatability(middle, scatters,
                         [compare(other, one, quantities) for other, one in zip(others, calibrations)])
