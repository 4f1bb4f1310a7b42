"""Runs the programs of the package as tasks of evaluate, each in a process of its own, and keeps what they print."""

import ctypes
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import namedtuple

from command_line import write

LIMITS = ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, 3600), (resource.RLIMIT_AS, 16 << 30))  # [s], [bytes]
PR_SET_PDEATHSIG = 1
LIBC = ctypes.CDLL(None)

# A piece of work that is independent of others. name: path of its result below the folder, without ending;
# description: all that the result follows from, on one line; outcome(status, output, error): the text to keep, by exit
# status (negative: it died or took too long) and what the command has printed.
Task = namedtuple('Task', 'name description command outcome')


def describe(words):
    """Words of a command on one line, files with size and time of change."""
    return ' '.join('%s (%d bytes of %d)' % (word, os.path.getsize(word), os.stat(word).st_mtime_ns)
                    if os.path.isfile(word) else word for word in words).replace('\n', ' ')


def result_path(folder, task):
    return os.path.join(folder, 'trials', task.name + '.yaml')


def finished(folder, task):
    """The text kept of a task that has run, unless something that it follows from has changed since; else None."""
    try:
        with open(result_path(folder, task), encoding='utf-8') as file:
            return file.read() if file.readline() == '# %s\n' % task.description else None
    except FileNotFoundError:
        return None


def missing(folder, tasks):
    return [task for task in tasks if finished(folder, task) is None]


def confine():
    """In a new process: it ends with the one that started it, and what it may use up is limited."""
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    for kind, most in LIMITS:
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def progress(done, count, title, seconds):
    """A line that is written again and again: "[#####     ] 123 of 456 trials, 12 min left"."""
    left = seconds * (count - done) / done if 0 < done < count else seconds
    text = '%.0f s' % left if left < 100 else '%.0f min' % (left / 60) if left < 6000 else '%.1f h' % (left / 3600)
    ending = '' if done == 0 else ', %s left' % text if done < count else ', %s\n' % text
    sys.stderr.write('\r[%-30s] %d of %d %s\033[K%s' % ('#' * (30 * done // count), done, count, title, ending))
    sys.stderr.flush()


def run_tasks(tasks, folder, jobs, part=0, parts=1, title='tasks', quiet=True):
    """Runs those tasks of the part, every parts-th, that have no stored result, `jobs` at a time. A result is there as
    a whole or not at all, so that what was done is kept when this process is killed. Name, time [s], time of the
    processor [s] and memory [MB] of each are added to folder/usage_PART_PARTS.csv. Raises the first InputError of a
    task's outcome, and ends the others."""
    waiting = missing(folder, tasks[part::parts])[::-1]
    count, begin, running = len(waiting), time.monotonic(), {}
    is_shown = not quiet and sys.stderr.isatty()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                task, output, error = waiting.pop(), tempfile.TemporaryFile('w+'), tempfile.TemporaryFile('w+')
                process = subprocess.Popen(task.command, stdin=subprocess.DEVNULL, stdout=output, stderr=error,
                                           preexec_fn=confine)
                running[process.pid] = process, task, output, error, time.monotonic()
            if is_shown:
                progress(count - len(waiting) - len(running), count, title, time.monotonic() - begin)
            pid, status, used = os.wait4(-1, 0)
            process, task, output, error, started = running.pop(pid)
            process.returncode = os.WEXITSTATUS(status) if os.WIFEXITED(status) else -1
            with output, error:
                output.seek(0)
                error.seek(0)
                text = task.outcome(process.returncode, output.read(), error.read())
            path = result_path(folder, task)
            os.makedirs(os.path.dirname(path), exist_ok=True)
            write(path, '# %s\n%s' % (task.description, text))
            with open('%s/usage_%d_%d.csv' % (folder, part + 1, parts), 'a', encoding='utf-8') as file:
                file.write('"%s",%.3f,%.3f,%.1f\n' % (task.name, time.monotonic() - started,
                                                      used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0))
        if is_shown and count > 0:
            progress(count, count, title, time.monotonic() - begin)
    finally:
        for process, _, output, error, _ in running.values():
            with output, error:
                process.kill()
                process.wait()
