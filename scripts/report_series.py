"""Series of report.py that follow from the motion of the solve, the rows of calibration_report.cpp: what an IMU should
have measured by doc/math.md, Eq. (2), and what that tells of the calibration."""

from collections import namedtuple

import numpy as np
from report_axes import sensor

# Of the marker: time [s], position [m], rotation matrix, turn rate about its axes [rad/s] and its derivative,
# acceleration [m/s^2].
Motion = namedtuple('Motion', 't p_WM R_WM omega alpha a_W')
# Sigmas of what is known before: of gravity's magnitude [m/s^2], and of everything, in its unit.
GRAVITY_PRIOR, PRIOR = 1e-3, 10.0
SHARES = 40  # of the data, up to which the information grows


def rotations(q):
    """Matrices of quaternions x, y, z, w."""
    x, y, z, w = q.T
    return np.stack([np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=1),
                     np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1),
                     np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)], axis=1)


def hats(v):
    """Matrices of cross products with v."""
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], axis=1), np.stack([z, o, -x], axis=1), np.stack([-y, x, o], axis=1)], axis=1)


def motion(rows):
    return Motion(rows[:, 0], rows[:, 1:4], rotations(rows[:, 4:8]), rows[:, 8:11], rows[:, 11:14], rows[:, 14:17])


def around(report, name, count):
    """Motions at instants and around them, in the order of calibration_report.cpp."""
    rows = report.rows(name)
    return [motion(rows[k::count]) for k in range(count)]


def lever(m):
    """What a lever arm in M is multiplied by to be its acceleration in M."""
    return hats(m.alpha) + hats(m.omega) @ hats(m.omega)


def times(matrices, vectors):
    return np.einsum('...ij,...j->...i', matrices, vectors)


def specific_force(m, a_W, gravity, p_MI):
    """Of the IMU, in M."""
    return times(m.R_WM.swapaxes(1, 2), a_W - gravity) + times(lever(m), p_MI)


def imu_result(report, imu):
    return report.result['imus'][imu] if 'imus' in report.result else report.result


def clock_result(report, s, imu):
    """Of an IMU in a session."""
    return [x for x in report.result['sessions'][s]['imus'] if x['name'] == 'imu%d' % imu][0] \
        if 'sessions' in report.result else report.result


def mount(report, imu):
    """p_MI, R_MI."""
    transform = imu_result(report, imu)['transform']
    return np.array(transform['translation']), rotations(np.array([transform['rotation']]))[0]


def intrinsics(report, imu):
    """Matrices of gyroscope and accelerometer; rows: where the axes of the accelerometer are in I [m]."""
    found = imu_result(report, imu)
    found = found.get('intrinsics') or found['imu']
    return [np.array(found[key]) for key in ('gyro_matrix', 'accel_matrix', 'accel_positions')]


def each_axis(t, series_t, series):
    return np.stack([np.interp(t, series_t, column, np.nan, np.nan) for column in series.T], axis=1)


def bias(report, s, imu, name, t):
    knots = report.rows('s%d_i%d_%s_bias' % (s, imu, name))
    return each_axis(np.clip(t, knots[0, 0], knots[-1, 0]), knots[:, 0], knots[:, 1:4])


def in_order(report, name):
    """Times and rows of a recorded stream, in order of time."""
    t, values = report.times(name + '_t'), report.rows(name)
    order = np.argsort(t, kind='stable')
    return t[order], values[order].astype(float)


def recorded(report, s, imu, name):
    return in_order(report, 's%d_i%d_%s' % (s, imu, name))


def session_motion(report, s):
    """Rows of time, position of the marker and of the first IMU that the session has."""
    m = motion(report.rows('s%d_motion' % s))
    p_MI, _ = mount(report, report.head['sessions'][s]['imus'][0])
    return np.c_[m.t, m.p_WM, m.p_WM + times(m.R_WM, p_MI)]


def excitation(report, s):
    """Rms about the mean of turn rates [rad/s] and accelerations [m/s^2]."""
    m = motion(report.rows('s%d_motion' % s))
    return [np.nanstd(x, axis=0) for x in (m.omega, m.a_W)]


def predicted(report, s, imu, name):
    """Rows of time, gyroscope and accelerometer as they should be."""
    before, now, after = around(report, 's%d_i%d_%s' % (s, imu, name), 3)
    p_MI, R_MI = mount(report, imu)
    gyro_matrix, accel_matrix, places = intrinsics(report, imu)
    gravity, scale = report.head['sessions'][s]['gravity'], report.result['pose_scale']
    f = [specific_force(m, m.a_W / scale, gravity, p_MI) for m in (before, now, after)]
    step = 0.5 * (after.t - before.t)[:, None]
    # The mean over the time that gyroscope and accelerometer average over.
    smoothing = imu_result(report, imu)['gyro_smoothing']
    slower = 0.5 * smoothing / step ** 2 * (before.omega - 2 * now.omega + after.omega)
    omega = now.omega + np.where(np.isfinite(slower), slower, 0)
    smoothing = smoothing + imu_result(report, imu)['accel_smoothing']
    more = 0.5 * smoothing / step ** 2 * (f[0] - 2 * f[1] + f[2])
    # What a mount that gives way adds, by the acceleration of the IMU in the world.
    f_W = [times(m.R_WM, x) for m, x in zip((before, now, after), f)]
    swing = times(np.swapaxes(now.R_WM, 1, 2), f_W[0] - 2 * f_W[1] + f_W[2]) / step ** 2
    more = more - imu_result(report, imu)['mount_compliance'] * swing
    mean = times(R_MI.T, f[1] + np.where(np.isfinite(more), more, 0))
    by_size = np.einsum('nij,ij->ni', R_MI.T @ lever(now) @ R_MI, places)
    return np.c_[now.t, times(gyro_matrix @ R_MI.T, omega) + bias(report, s, imu, 'gyro', now.t),
                 times(accel_matrix, mean + by_size) + bias(report, s, imu, 'accel', now.t)]


def grid(report, s, imu):
    """Even rows without gaps: time, |omega| of the poses alone and of the gyroscope, the motion of the solve, and the
    specific force in M that the accelerometer shows."""
    name = 's%d_i%d_grid' % (s, imu)
    m, rates = motion(report.rows(name)), report.times(name + '_rates')
    gyro_matrix, accel_matrix, _ = intrinsics(report, imu)
    gyro, accel = (each_axis(m.t, *recorded(report, s, imu, x)) - bias(report, s, imu, x, m.t)
                   for x in ('gyro', 'accel'))
    turning = np.linalg.norm(times(np.linalg.inv(gyro_matrix), gyro), axis=1)
    force = times(mount(report, imu)[1] @ np.linalg.inv(accel_matrix), accel)
    good = np.isfinite(turning) & np.isfinite(force).all(axis=1) & np.isfinite(m.a_W).all(axis=1)
    return rates[good], turning[good], Motion(*(x[good] for x in m)), force[good]


def pose_sensor(report, s, k):
    """What is said of a pose sensor in a session; times of its poses, rows of their residuals, and of how its world has
    moved, see calibration_report.cpp."""
    found = [x for x in report.pose_sensors[k]['sessions'] if x['session'] == s + 1][0]
    name = 's%d_p%d_' % (s, k)
    return (found, report.times(name + 'residual_t'), report.rows(name + 'residual').astype(float),
            report.rows(name + 'world'))


def growth(report, s, imu):
    """Rows of the share of the data, and of the sigmas of translation, rotation, time shift and accel delay by then:
    what the samples tell beside gravity and constant biases on a trajectory that is known, brought to the sigmas of
    the result. What the trajectory's own errors cost is taken to be the same share throughout."""
    edge, before, now, after, other_edge = around(report, 's%d_i%d_growth' % (s, imu), 5)
    p_MI, R_MI = mount(report, imu)
    gravity = np.array(report.head['sessions'][s]['gravity'])
    f = [times(R_MI.T, specific_force(m, m.a_W, gravity, p_MI)) for m in (before, now, after)]
    # Columns: p_MI, R_MI about the imu axes, time shift, accel delay, gravity, biases of gyroscope and accelerometer.
    gyro, accel = np.zeros((2, len(now.t), 3, 17))
    gyro[:, :, 3:6], gyro[:, :, 6] = hats(times(R_MI.T, now.omega)), times(R_MI.T, now.alpha)
    gyro[:, :, 11:14] = accel[:, :, 14:17] = np.eye(3)
    accel[:, :, 0:3], accel[:, :, 3:6] = R_MI.T @ lever(now), hats(f[1])
    accel[:, :, 6] = (f[2] - f[0]) / (after.t - before.t)[:, None]
    accel[:, :, 7] = -accel[:, :, 6]
    accel[:, :, 8:11] = -(now.R_WM @ R_MI).swapaxes(1, 2)
    known = np.isfinite([m.a_W[:, 0] for m in (edge, before, now, after, other_edge)]).all(axis=0)
    H = 0
    for rows, x in ((gyro, 'gyro'), (accel, 'accel')):
        found = sensor(report.head['sessions'][s], x, imu)
        rows[~known] = 0
        # Of the samples that an instant stands for.
        weight = (now.t[1] - now.t[0]) * found['rate_hz'] / found['noise_found'] ** 2
        H = H + weight * np.einsum('nki,nkj->nij', rows, rows)
    H = H.reshape(SHARES, -1, 17, 17).sum(axis=1).cumsum(axis=0) + np.eye(17) / PRIOR ** 2
    down = gravity / np.linalg.norm(gravity)
    H[:, 8:11, 8:11] += np.outer(down, down) / GRAVITY_PRIOR ** 2
    sigmas = np.sqrt(np.maximum(0, np.linalg.inv(H)[:, range(8), range(8)]))
    found = imu_result(report, imu)
    final = np.r_[found['transform']['translation_std'], found['transform']['rotation_std'],
                  clock_result(report, s, imu)['time_shift_std'], found['accel_delay_std']]
    return np.c_[np.arange(1, SHARES + 1) / SHARES, sigmas * final / sigmas[-1]]
