"""Reads results of calibrate_bag and transforms of any program. Errors name file and key."""

import contextlib
import os
import re

import numpy as np
import yaml
from command_line import LOADER, InputError
from comparison import calibration, quaternion, rotation, transform

MOST_BYTES = 10000000
MOST_DEPTH = 20  # on more, the parser could exhaust the stack


@contextlib.contextmanager
def naming(what, path):
    """Errors in it begin with WHAT 'PATH'."""
    try:
        yield
    except InputError as error:
        raise InputError("%s '%s': %s" % (what, path, error))


class Keys:
    """Part of a YAML file, whose scalars are texts; errors begin with the keys that lead to it."""

    def __init__(self, value, path=()):
        self.value, self.path = value, path

    def fail(self, what):
        raise InputError('%s %s' % (': '.join(self.path), what) if self.path else what)

    def __contains__(self, key):
        return isinstance(self.value, dict) and key in self.value

    def __getitem__(self, key):
        if not isinstance(self.value, dict):
            self.fail('must be a map')
        found = Keys(self.value.get(key), self.path + (key,))
        return found if found.value is not None else found.fail('is missing')

    def __iter__(self):
        if not isinstance(self.value, list) or not self.value:
            self.fail('must be a list that is not empty')
        return (Keys(value, self.path + (str(k),)) for k, value in enumerate(self.value))

    def text(self):
        return self.value if isinstance(self.value, str) else self.fail('must be a string')

    def numbers(self, *shape):
        """One, a list of them, or the rows of a matrix."""
        if shape and not (isinstance(self.value, list) and len(self.value) == shape[0]):
            self.fail(('must be a list of %d numbers' if len(shape) == 1 else 'must have %d rows of %d') % shape)
        try:
            values = np.array(self.value, float)
        except (TypeError, ValueError):
            values = np.array(np.nan)
        if values.shape != shape or not np.all(np.isfinite(values)):
            self.fail('must hold finite numbers' if len(shape) < 2 else 'must hold %d x %d finite numbers' % shape)
        return values

    def with_std(self, key):
        return [self[key].numbers(), self[key + '_std'].numbers()]


def read_yaml(path):
    """The first document of a file, as Keys."""
    try:
        with open(path, 'rb') as file:
            text = file.read(MOST_BYTES + 1)
    except IsADirectoryError:
        raise InputError('is a directory, must be a file')
    except OSError as error:
        raise InputError('cannot be read: ' + error.strerror)
    if len(text) > MOST_BYTES:
        raise InputError('is larger than 10 MB')
    text = re.sub(rb'\A%YAML:.*', b'', text)  # as OpenCV begins its files, which is no YAML
    depth = 0
    try:
        for event in yaml.parse(text, LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH:
                raise InputError('line %d: nested deeper than %d levels' % (event.start_mark.line + 1, MOST_DEPTH))
        return Keys(next(yaml.load_all(text, LOADER), None))
    except yaml.MarkedYAMLError as error:
        raise InputError('line %d: %s' % (error.problem_mark.line + 1, error.problem))
    except yaml.YAMLError as error:
        raise InputError(str(error))


# --- Results ---

class Result:
    """What a result file says of one of its IMUs. `sources`: its recordings; `calibration`: see load_results()."""

    def __init__(self, path, imu):
        self.path = path
        with naming('result', path):
            keys = read_yaml(path)
            if 'imu_pose_calib' not in keys:
                raise InputError('is not a result of calibrate_bag: it has no key imu_pose_calib')
            run = keys['imu_pose_calib']
            self.status, self.message = run['status'].text(), run['message'].text()
            if self.status not in ('ok', 'weak'):
                run['status'].fail("is '%s'; only a result that is ok or weak can be used" % self.status)
            if 'pose_sensors' in keys and 'transform' not in keys:
                imus = []
            else:
                imus = list(keys['imus']) if 'sessions' in keys else [keys]
        if not 0 <= imu < len(imus):
            raise InputError("--imu %d: '%s' has %d imus, from 0" % (imu, path, len(imus)))
        with naming('result', path):
            self.read(keys, imus[imu])

    def read(self, keys, imu):
        """A rig has lists of its IMUs and sessions; else the only IMU and its clock are at the top."""
        data, clock = keys['data'], keys
        self.pose_topic, self.duration = data['pose_topic'].text(), data['duration'].numbers()
        self.sources = [data['bag'].text() or self.pose_topic]
        if imu is keys:
            self.topic = data['imu_topic'].text() or data['gyro_topic'].text()
        else:
            self.topic, name = imu['topic'].text(), imu['name'].text()
            self.sources = [session['source'].text() for session in keys['sessions']]
            clock = next((found for session in keys['sessions'] for found in session['imus']
                          if found['name'].text() == name), None)
            if clock is None:
                imu['name'].fail('is in no session')
        self.marker = keys['frames']['marker'].text()
        of_poses, of_imu = keys['noise'], clock['noise']
        self.noise = {'position': of_poses['position_std'].numbers(), 'rotation': of_poses['rotation_std'].numbers(),
                      'gyro': of_imu['gyro_std'].numbers(), 'accel': of_imu['accel_std'].numbers()}
        T = imu['transform']
        self.rotation = T['rotation'].numbers(4)
        if abs(np.linalg.norm(self.rotation) - 1) > 1e-6:
            T['rotation'].fail('must be a unit quaternion')
        self.found = {'translation': T['translation'].numbers(3), 'rotation': self.rotation,
                      'covariance': T['covariance'].numbers(6, 6), 'accel_delay': imu.with_std('accel_delay')}
        self.time_shift, self.drift = clock.with_std('time_shift'), clock.with_std('clock_drift')
        self.clock_reference = clock['clock_reference'].numbers()


def load_results(paths, imu):
    """Results of one IMU, with time shifts at the mean of the instants at which they hold."""
    results = [Result(path, imu) for path in paths]
    instant = np.mean([result.clock_reference for result in results])
    for result in results:
        away = instant - result.clock_reference
        (shift, shift_std), (drift, drift_std) = result.time_shift, result.drift
        result.calibration = calibration({**result.found, 'time_shift': [shift + drift * away,
                                                                         np.hypot(shift_std, drift_std * away)]})
    return results


# --- Transforms ---

def parse_numbers(name, text, count):
    """"a b c", with blanks or commas between them; `name` says what the text was given for."""
    values = []
    for word in text.replace(',', ' ').split():
        try:
            values.append(float(word))
        except ValueError:
            values.append(np.nan)
        if not np.isfinite(values[-1]):
            raise InputError("%s '%s': '%s' is not a finite number" % (name, text, word))
    if len(values) != count:
        raise InputError("%s '%s' must be %d numbers, not %d" % (name, text, count, len(values)))
    return values


def from_numbers(p, q, name):
    norm = np.linalg.norm(q)
    if abs(norm - 1) > 0.01:
        raise InputError('%s must be a unit quaternion x, y, z, w; its norm is %g' % (name, norm))
    return transform(rotation(q), p)


def from_rows(rows):
    T = rows.numbers(4, 4)
    R = T[:3, :3]
    if (not np.allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-3) or np.linalg.det(R) < 0 or
            not np.allclose(T[3], (0, 0, 0, 1))):
        rows.fail('must be a rotation and a translation')
    return transform(rotation(quaternion(R)), T[:3, 3])


def transform_in(keys):
    below = [keys[key] for key in ('transform', 'transformation') if key in keys]
    for found in below + [keys]:
        if 'translation' in found:
            return from_numbers(found['translation'].numbers(3), found['rotation'].numbers(4), 'rotation')
        if 'qw' in found:
            return from_numbers([found[key].numbers() for key in ('x', 'y', 'z')],
                                [found[key].numbers() for key in ('qx', 'qy', 'qz', 'qw')], 'qx, qy, qz, qw')
        if 'matrix' in found:
            return from_rows(found['matrix'])
    raise InputError('must hold x y z qx qy qz qw, translation and rotation, or matrix, at the top or below '
                     'transform or transformation')


def read_transform(name, text):
    """Of seven numbers "x y z qx qy qz qw", or of the YAML or JSON file of that name."""
    if os.path.exists(text) or text.endswith(('.yaml', '.json')):
        with naming(name, text):
            return transform_in(read_yaml(text))
    values = parse_numbers(name, text, 7)
    return from_numbers(values[:3], values[3:], "%s '%s': qx qy qz qw" % (name, text))


def read_camera(path, name):
    """T_cam_imu of a camera of a camchain-imucam.yaml of Kalibr, or of OpenVINS, which may give T_imu_cam."""
    with naming('camera chain', path):
        keys = read_yaml(path)
        if name in keys and 'T_cam_imu' in keys[name]:
            return from_rows(keys[name]['T_cam_imu'])
        if name in keys and 'T_imu_cam' in keys[name]:
            return np.linalg.inv(from_rows(keys[name]['T_imu_cam']))
        if name in keys:
            keys[name].fail('has no T_cam_imu; give the camchain-imucam.yaml of the calibration with the imu')
    raise InputError("--cam '%s' is not in '%s'" % (name, path))
