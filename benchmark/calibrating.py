"""What benchmarks in Python share: builds, runs of calibrate_bag, and how results differ."""

import os
import pathlib
import subprocess
import sys
import tempfile

import numpy
import yaml

ROOT = pathlib.Path(__file__).resolve().parent.parent
DEVEL = ROOT / ".catkin_ws/devel"


def program(name, devel=DEVEL):
    return os.path.join(devel, "lib", "imu_pose_calib", name)


def environment(devel=DEVEL, **more):
    """That finds the libraries of a devel or install space."""
    libraries = (os.path.join(devel, "lib"), os.environ.get("LD_LIBRARY_PATH"))
    return dict(os.environ, LD_LIBRARY_PATH=":".join(filter(None, libraries)), **more)


def run(name, *arguments, devel=DEVEL):
    """Runs a program of the package; its error ends this one, too."""
    done = subprocess.run([program(name, devel), *arguments], env=environment(devel), stdout=subprocess.DEVNULL,
                          stderr=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"error: {' '.join([name, *arguments])}: {done.stderr.strip()}")


def read(path):
    with open(path) as file:
        return yaml.load(file, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def arguments_of(recording):
    """BAG[@START+DURATION] as calibrate_bag takes it."""
    path, _, span = recording.partition("@")
    start, _, duration = span.partition("+")
    return [path] + (["--start", start, "--duration", duration] if span else [])


def calibrate(arguments, devel=DEVEL, binary=None, timeout=None, **more):
    """The result; None when there is none. `more`: of the environment."""
    with tempfile.TemporaryDirectory() as folder:
        output = os.path.join(folder, "result.yaml")
        command = [binary or program("calibrate_bag", devel), *arguments, "--output", output, "--quiet"]
        done = subprocess.run(command, env=environment(devel, **more), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                              text=True, timeout=timeout)
        if done.returncode == 1:
            sys.exit(done.stderr)
        return read(output) if done.returncode == 0 else None


def build_changed(folder, header, text, change):
    """`folder` becomes a copy of this repository with another header of core/base, in which `change(folder)` has its
    sources use it, and is built. Returns its devel space."""
    if not folder.exists():
        subprocess.run(["git", "clone", "-q", str(ROOT), str(folder)], check=True)
        (folder / "include/imu_pose_calib/core/base" / header).write_text(text)
        change(folder)
    subprocess.run([str(folder / "scripts/setup.sh")], check=True)
    return folder / ".catkin_ws/devel"


def turn(first, second):
    """[rad] Rotation vector of first^-1 second, quaternions x, y, z, w."""
    (q, w), (p, v) = ((numpy.array(x[:3]), x[3]) for x in (first, second))
    vector, scalar = w * p - v * q - numpy.cross(q, p), w * v + q @ p
    norm = numpy.linalg.norm(vector)
    return numpy.sign(scalar) * vector * (2.0 * numpy.arctan2(norm, abs(scalar)) / norm if norm > 0.0 else 0.0)


def chi2_per_dof(values, sigmas):
    """Of each column, about the weighted mean."""
    values, weights = numpy.array(values), 1.0 / numpy.array(sigmas) ** 2
    mean = (weights * values).sum(0) / weights.sum(0)
    return (weights * (values - mean) ** 2).sum(0) / max(len(values) - 1, 1)
