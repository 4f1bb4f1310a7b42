#!/usr/bin/python3
"""Converts trials of the BROAD dataset (Laidig et al., Data 6(7):72, 2021) for calibrate_bag and evaluate.

convert_broad.py FOLDER OUT    FOLDER: data_mat or data_hdf5 of https://github.com/dlaidig/broad

Writes an ASL dataset of each trial, OUT/TRIAL/imu0/data.csv and OUT/TRIAL/mocap0/data.csv. Stamps count from 0; poses that
are missing stay out.
"""

import os
import sys

try:
    import numpy as np
except ImportError as error:
    sys.exit('%s: apt install python3-numpy' % error)

FIELDS = ('imu_gyr', 'imu_acc', 'opt_pos', 'opt_quat')
IMU_HEADER = ('#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],'
              'a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]')
POSE_HEADER = '#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []'


def load_mat(path):
    try:
        from scipy.io import loadmat
    except ImportError as error:
        sys.exit('%s: apt install python3-scipy' % error)
    data = loadmat(path)
    return [data[field] for field in FIELDS], float(np.squeeze(data['sampling_rate']))


def load_hdf5(path):
    try:
        import h5py
    except ImportError as error:
        sys.exit('%s: apt install python3-h5py' % error)
    with h5py.File(path, 'r') as data:
        rate = data['sampling_rate'][()] if 'sampling_rate' in data else data.attrs['sampling_rate']
        return [data[field][()] for field in FIELDS], float(np.squeeze(rate))


def write(path, header, stamps, *columns):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, 'w', encoding='ascii') as file:
        file.write(header + '\n')
        for stamp, row in zip(stamps, np.hstack(columns)):
            if not np.isnan(row).any():
                file.write('%d,%s\n' % (stamp, ','.join('%.9g' % value for value in row)))


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    folder, out = sys.argv[1:]
    trials = sorted(name for name in os.listdir(folder) if name.endswith(('.mat', '.hdf5')))
    if not trials:
        sys.exit('there is no .mat or .hdf5 in %s' % folder)
    for name in trials:
        path = os.path.join(folder, name)
        try:
            (gyro, accel, position, quaternion), rate = (load_mat if name.endswith('.mat') else load_hdf5)(path)
        except Exception as error:  # pylint: disable=broad-except
            sys.exit('%s cannot be read: %s' % (path, error))
        stamps = np.round(np.arange(len(gyro)) * (1e9 / rate)).astype(np.int64)
        trial = os.path.join(out, os.path.splitext(name)[0])
        write(os.path.join(trial, 'imu0', 'data.csv'), IMU_HEADER, stamps, gyro, accel)
        write(os.path.join(trial, 'mocap0', 'data.csv'), POSE_HEADER, stamps, position, quaternion)
        print('%s: %.0f s' % (trial, len(gyro) / rate))


if __name__ == '__main__':
    main()
