"""Batches and public datasets: calibrates each recording alone by calibrate_bag, and compares those of a dataset."""

import itertools
import os
import pathlib
import re
import sys
from collections import namedtuple

import evaluation_tables
import numpy as np
import yaml
from command_line import LOADER, DataError, InputError, output_of, program, reason_of, write
from comparison import calibration, compare, given, repeat
from evaluation_runner import Task, describe, finished, run_tasks
from evaluation_tables import is_usable

# title: with place and licence; is_imu0: the IMU of its bags is /imu0; is_in_imu: poses without a sensor.yaml are said
# to be the IMU's.
Dataset = namedtuple('Dataset', 'title is_imu0 is_in_imu')
DATASETS = {
    'tum-vi': Dataset('TUM-VI (Schubert et al., IROS 2018): https://cvg.cit.tum.de/data/datasets/'
                      "visual-inertial-dataset, CC BY 4.0. Sequences in EuRoC's format, or bags; poses are published "
                      'as those of the IMU, on its clock', True, True),
    'euroc': Dataset('EuRoC MAV (Burri et al., IJRR 2016): https://doi.org/10.3929/ethz-b-000690084, in copyright, '
                     'non-commercial use permitted. T_BS in sensor.yaml is the published calibration', True, False),
    'broad': Dataset('BROAD (Laidig et al., Data 6(7):72, 2021): https://github.com/dlaidig/broad, CC BY 4.0. First, '
                     'convert_broad.py FOLDER_OF_MAT_OR_HDF5 FOLDER. No calibration is published', False, False),
}
# One of several recordings that are calibrated, each alone. name: also of its files; group: of one rig and one source
# of poses; words: what calibrate_bag is to read; published: T_marker_imu, rows of its matrix, or None.
Sequence = namedtuple('Sequence', 'name group words published')


def dataset_of(name):
    if name not in DATASETS:
        raise InputError("dataset '%s' is unknown; must be tum-vi, euroc or broad" % name)
    return DATASETS[name]


def place(path, folder):
    """Path below the folder as a name, in which links are what they are called, and what it is in: of one session,
    perhaps."""
    name = os.path.relpath(path, folder)
    parent = os.path.dirname(name)
    return os.path.basename(os.path.abspath(path)) if name == '.' else name, parent and parent + '/'


def sensor_pose(folder):
    """T_BS of the sensor.yaml in a folder of samples, x_body = T_BS x_sensor; None without that file."""
    path = folder / 'sensor.yaml'
    try:
        return np.array(yaml.load(path.read_text(), LOADER)['T_BS']['data'], float).reshape(4, 4)
    except FileNotFoundError:
        return None
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        raise InputError('%s: data of T_BS must have 16 elements: %s' % (path, error))


def holds_poses(path):
    """Whether the header of a table names a position and a quaternion."""
    with open(path, encoding='utf-8', errors='replace') as file:
        columns = {re.split(r'[\s\[(]', name.strip('# \t\n'))[0].lower() for name in file.readline().split(',')}
    return (any(prefix + 'x' in columns for prefix in ('', 't', 'p', 'p_', 'p_rs_r_', 'pos_', 'position_')) and
            any(prefix + 'w' in columns for prefix in ('q', 'q_', 'q_rs_', 'quat_', 'orientation_')))


def asl_sequences(dataset, imu, folder):
    """The sources of poses of an ASL dataset whose IMU is in the folder `imu`."""
    root = imu.parent.parent if imu.parent.name == 'mav0' else imu.parent
    name, group = place(root, folder)
    for source in sorted(path.parent for path in imu.parent.glob('*/data.csv') if holds_poses(path)):
        T_BM, T_BI = sensor_pose(source), sensor_pose(imu)
        published = np.eye(4).tolist() if dataset.is_in_imu else None
        if T_BM is not None:
            published = (np.linalg.inv(T_BM) @ (np.eye(4) if T_BI is None else T_BI)).tolist()
        yield Sequence(name + '/' + source.name, group + source.name,
                       ['--poses', str(source / 'data.csv'), '--imu', str(imu / 'data.csv')], published)


def find_sequences(name, folder, common=()):
    """The *.bag of a folder and of the folders in it, and with a public dataset `name` its ASL datasets, each with all
    of its sources of poses. `common`: words of calibrate_bag for each. Raises InputError when there are none, saying
    where to get them."""
    dataset = dataset_of(name) if name else None
    if not os.path.isdir(folder):
        raise InputError("'%s' is not a folder with recordings" % folder)
    topic = ['--imu-topic', '/imu0'] if dataset and dataset.is_imu0 and '--imu-topic' not in common else []
    found = []
    for path in sorted(pathlib.Path(folder).rglob('*')):
        if dataset and path.name == 'data.csv' and path.parent.name == 'imu0':
            found += asl_sequences(dataset, path.parent, folder)
        elif path.suffix == '.bag':
            bag, group = place(path.with_suffix(''), folder)
            found.append(Sequence(bag, group + 'bags' if dataset else '', [str(path)] + topic, None))
    if not found:
        raise InputError("there is no sequence of '%s' below '%s'. %s" % (name, folder, dataset.title) if dataset else
                         "there is no *.bag in '%s'" % folder)
    return sorted((sequence._replace(words=sequence.words + list(common)) for sequence in found),
                  key=lambda sequence: sequence.group)


def sequence_outcome(path):
    """Of calibrate_bag, which writes its result to `path`. Input that cannot be used fails alone."""
    def outcome(status, _, error):
        if status != 0:
            return yaml.safe_dump({'verdict': 'refused' if status == 2 else 'failed', 'warnings': '0',
                                   'reason': reason_of(error) if status > 0 else 'it died or took too long'})
        with open(path, encoding='utf-8') as file:
            stored = yaml.load(file, LOADER)
        result = {key: stored['transform'][key] for key in ('translation', 'rotation', 'covariance')}
        result['std'] = stored['transform']['translation_std'] + stored['transform']['rotation_std']
        result.update({key: [stored[key], stored[key + '_std']] for key in ('time_shift', 'accel_delay')})
        return yaml.safe_dump(dict(result, verdict=stored['imu_pose_calib']['status'],
                                   reason=stored['imu_pose_calib']['message'],
                                   warnings=str(len(stored['quality']['warnings']))))
    return outcome


def compared(group):
    """How the usable outcomes of a group, which know their sequences, scatter and differ from what is published."""
    usable = [(outcome, calibration(outcome)) for outcome in group if is_usable(outcome)]
    found = {'scatter': repeat([one for _, one in usable])} if len(usable) > 1 else {}
    audit = [(outcome, compare(given(outcome['reference']), one)) for outcome, one in usable if outcome['reference']]
    return dict(found, audit=audit) if audit else found


def run_sequences(wanted, about):
    """Calibrates those that are not yet done, and writes into the folder a result file of each, NAME.calibration.yaml,
    and the table sequences.md and sequences.csv. Those of a dataset are compared with each other and with what is
    published, else a report is drawn of each, and a page of all. Raises DataError for the bags of a batch that have no
    calibration."""
    title = dataset_of(wanted.dataset).title if wanted.dataset else 'Calibration of ' + wanted.batch
    common = [word for name in ('imu_topic', 'pose_topic', 'tf_parent', 'tf_child', 'config', 'method')
              if getattr(wanted, name) for word in ('--' + name.replace('_', '-'), getattr(wanted, name))]
    sequences = find_sequences(wanted.dataset, wanted.data or wanted.batch, common)
    tasks = []
    for sequence in sequences:
        path = '%s/%s.calibration.yaml' % (wanted.out, sequence.name)
        os.makedirs(os.path.dirname(path), exist_ok=True)
        report = [] if wanted.dataset else ['--report', path[:-len('yaml')] + 'report.html']
        tasks.append(Task(sequence.name, describe([about['version']] + sequence.words),
                          [program('calibrate_bag')] + sequence.words + ['--quiet', '--output', path] + report,
                          sequence_outcome(path)))
    run_tasks(tasks, wanted.out, wanted.jobs, wanted.part, wanted.parts, 'recordings', wanted.quiet)
    done = [dict(yaml.load(text, LOADER), name=sequence.name, group=sequence.group, reference=sequence.published)
            for sequence, text in zip(sequences, (finished(wanted.out, task) for task in tasks)) if text is not None]
    if len(done) < len(sequences):
        said = '%d recordings of the other jobs are missing\n' % (len(sequences) - len(done))
    else:
        said = write_tables(done, title, wanted)
    if not wanted.quiet:
        sys.stdout.write(said)
    failed = [outcome['name'] for outcome in done if not is_usable(outcome)]
    if failed and not wanted.dataset:
        raise DataError('%d of %d bags have no calibration: %s' % (len(failed), len(sequences), ', '.join(failed)))


def write_tables(done, title, wanted):
    """Of outcomes. Returns the table, and where the page of all is."""
    groups = []
    for name, group in itertools.groupby(done, lambda outcome: outcome['group']):
        results = list(group)
        groups.append(dict(compared(results) if wanted.dataset else {}, name=name, results=results))
    files = evaluation_tables.sequences(title, groups)
    for name, text in files.items():
        write(os.path.join(wanted.out, name), text)
    usable = ['%s/%s.calibration.yaml' % (wanted.out, outcome['name']) for outcome in done if is_usable(outcome)]
    if wanted.dataset or not usable:
        return files['sequences.md']
    page = wanted.out + '/sequences.report.html'
    output_of([program('compare_calibrations')] + usable + ['--report', page, '--fleet', title + (
        ': %d of %d recordings have a result; those of one rig and IMU should agree' % (len(usable), len(done)))])
    return files['sequences.md'] + 'Written to %s\n' % page
