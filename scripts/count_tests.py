#!/usr/bin/env python3
"""Counts the test cases of a ctest run of a catkin build folder.

usage: count_tests.py BUILD LOG

Reads BUILD/ctest.json (the tests that were to run), ctest's list of failed tests and the JUnit results. A test without a
readable result is one failure, and so is one that reported no failure but left with an error. Skipped and disabled
cases are neither passed nor failed. Prints the failures, then "N passed, M failed" as the last line; the exit status
is 0 when something passed and nothing failed.
"""

import json
import pathlib
import sys
import xml.etree.ElementTree as ElementTree


class Totals:
    def __init__(self):
        self.passed = 0
        self.skipped = 0
        self.failures = []

    def add_results(self, path):
        """Adds the cases of one JUnit file and returns how many of them failed."""
        failed = 0
        for case in ElementTree.parse(path).getroot().iter("testcase"):
            name = f"{path.stem}: {case.get('classname', '')}.{case.get('name', '')}"
            problem = next((child for child in case if child.tag in ("failure", "error")), None)
            if problem is not None:
                self.failures.append(name + excerpt(problem))
                failed += 1
            elif is_skipped(case):
                self.skipped += 1
            elif not is_wrapper(path):
                self.passed += 1
        return failed


def excerpt(problem, max_lines=8):
    """The first lines of what a failure says, indented."""
    lines = (problem.get("message") or problem.text or "").splitlines()[:max_lines]
    return "".join(f"\n    {line}" for line in lines)


def is_skipped(case):
    return (
        case.find("skipped") is not None
        or case.get("status") == "notrun"
        or case.get("result") in ("skipped", "suppressed")
    )


def is_wrapper(path):
    """rostest-*.xml says that a test node ran; the node's own cases are in rosunit-*.xml."""
    return path.name.startswith("rostest-")


def failed_tests(build):
    path = build / "Testing" / "Temporary" / "LastTestsFailed.log"
    lines = path.read_text().splitlines() if path.exists() else []
    return {line.partition(":")[2] for line in lines}


def result_path(test):
    """The JUnit file that catkin's run_tests.py was told to check, or None for a plain ctest."""
    command = test.get("command", [])
    runner = [i for i, word in enumerate(command) if word.endswith("/run_tests.py")]
    return pathlib.Path(command[runner[0] + 1]) if runner else None


def count(build):
    totals = Totals()
    tests = json.loads((build / "ctest.json").read_text())["tests"]
    failed = failed_tests(build)
    expected = {test["name"]: result_path(test) for test in tests}

    # Test nodes of rostests first: their failures explain those of the rostest that ran them.
    failed_in_nodes = 0
    for path in sorted((build / "test_results").rglob("*.xml")):
        if path not in expected.values() and not path.name.startswith("MISSING-"):
            failed_in_nodes += add_or_fail(totals, path)

    for name, path in expected.items():
        found = 0 if path is None else add_or_fail(totals, path)
        if name not in failed:
            totals.passed += path is None
        elif found == 0 and not (path is not None and is_wrapper(path) and failed_in_nodes):
            totals.failures.append(f"{name}: left with an error")
    return totals


def add_or_fail(totals, path):
    try:
        return totals.add_results(path)
    except (OSError, ElementTree.ParseError):
        totals.failures.append(f"{path.stem}: no result, it crashed or ran out of time")
        return 1


def main():
    build, log = pathlib.Path(sys.argv[1]), sys.argv[2]
    totals = count(build)
    for failure in totals.failures:
        print(f"failed: {failure}")
    if totals.failures or not totals.passed:
        print(f"the whole output is in {log}")
    if totals.skipped:
        print(f"{totals.skipped} skipped")
    print(f"{totals.passed} passed, {len(totals.failures)} failed")
    return 0 if totals.passed and not totals.failures else 1


if __name__ == "__main__":
    sys.exit(main())
