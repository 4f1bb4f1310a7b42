"""What the commands of the package that are Python have in common: errors, exit status, files, other programs."""

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import uuid
from xml.etree import ElementTree

import yaml

PROGRAMS = os.path.dirname(os.path.abspath(sys.argv[0]))  # where this one is installed, too
LOADER = getattr(yaml, 'CBaseLoader', yaml.BaseLoader)  # all scalars are texts: numbers as the programs write them


class InputError(Exception):
    """Something cannot be used as given: the text names field, value and bound."""


class DataError(Exception):
    """The input was read, but no calibration can come from it, or calibrations differ."""


class Parser(argparse.ArgumentParser):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self._negative_number_matcher = re.compile(r'-[.\d]')  # begins several, perhaps; no option does

    def error(self, message):
        raise InputError(message)


def program(name):
    return os.path.join(PROGRAMS, name)


def reason_of(error):
    """The text of an error of a program, its last line, without its name."""
    return error.strip().split('\n')[-1].split(': error: ', 1)[-1]


def output_of(command):
    """What a program of the package prints."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          encoding='utf-8', errors='surrogateescape')
    if done.returncode != 0:
        raise InputError(reason_of(done.stderr))
    return done.stdout


def ask(command):
    """The same, as YAML."""
    return yaml.load(output_of(command), LOADER)


def version():
    """Of the package; package.xml is that of the source or of the installed package."""
    here = os.path.dirname(os.path.realpath(__file__))
    return next(ElementTree.parse(path).findtext('version') for path in (
        here + '/../package.xml', here + '/../../share/imu_pose_calib/package.xml') if os.path.exists(path))


def printable(text):
    """Safe to show in a terminal, on one line."""
    return ''.join(c if c.isprintable() else '\\x%02x' % (ord(c) & 0xff) for c in text)


def write(path, data):
    """Replaces a file in one step by a text or bytes. A link stays, and what it leads to is replaced."""
    target = os.path.realpath(path)
    draft = '%s.tmp%s' % (target, uuid.uuid4().hex)
    try:
        with open(draft, 'xb') as file:
            file.write(data if isinstance(data, bytes) else data.encode())
        os.replace(draft, target)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.remove(draft)
        raise InputError("output '%s' cannot be written: %s" % (path, error.strerror))


def run_command(name, run):
    """Runs a command with the words that it is given. Returns its exit status: 0, 2 after a DataError, 1 after any
    other error, which is told on a line on stderr."""
    for number in signal.SIGINT, signal.SIGPIPE:  # ends at once
        signal.signal(number, signal.SIG_DFL)
    try:
        run([word for word in sys.argv if ':=' not in word])  # without what roslaunch adds, __name and __log
    except (DataError, InputError, OSError) as error:
        sys.stderr.write('%s: error: %s\n' % (name, printable(str(error).replace('\n', ' '))))
        return 2 if isinstance(error, DataError) else 1
    return 0
