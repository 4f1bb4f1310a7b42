#!/usr/bin/env python3
"""Include graph of the package: rooms are the folders of src and include/imu_pose_calib.

  scripts/include_graph.py            prints the arrows between rooms as a Mermaid diagram (doc/architecture.md)
  scripts/include_graph.py --check    fails when rooms or units (a header and its source) include each other
"""
import collections
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
INCLUDE = re.compile(r'^#include "imu_pose_calib/(.*)\.h"', re.MULTILINE)


def read_units():
    """{unit: units that it includes}; a unit is a path without suffix, such as core/data/segments."""
    units = collections.defaultdict(set)
    for folder, suffix in ((ROOT / "include/imu_pose_calib", ".h"), (ROOT / "src", ".cpp")):
        for path in sorted(folder.rglob("*" + suffix)):
            unit = str(path.relative_to(folder).with_suffix(""))
            units[unit] |= set(INCLUDE.findall(path.read_text())) - {unit}
    # Messages are generated and have no unit.
    return {unit: includes & units.keys() for unit, includes in units.items()}


def room_of(unit):
    return str(pathlib.PurePath(unit).parent)


def read_rooms(units):
    rooms = collections.defaultdict(set)
    for unit, includes in units.items():
        rooms[room_of(unit)] |= {room_of(other) for other in includes} - {room_of(unit)}
    return rooms


def reachable(graph, starts):
    """All nodes on paths that begin with one of the starts."""
    seen, stack = set(), list(starts)
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            stack.extend(graph.get(node, ()))
    return seen


def find_cycles(graph):
    """Groups of nodes that reach each other."""
    reach = {node: reachable(graph, others) for node, others in graph.items()}
    return sorted({tuple(sorted(o for o in reach[n] if n in reach[o])) for n in graph if n in reach[n]})


def direct_arrows(graph):
    """Arrows that no longer path implies."""
    for room in sorted(graph):
        for other in sorted(graph[room]):
            if other not in reachable(graph, graph[room] - {other}):
                yield room, other


def main():
    units = read_units()
    rooms = read_rooms(units)
    if sys.argv[1:] == ["--check"]:
        cycles = [("rooms", c) for c in find_cycles(rooms)] + [("units", c) for c in find_cycles(units)]
        for kind, cycle in cycles:
            print(f"{kind} that include each other: {', '.join(cycle)}")
        print(f"{len(units)} units in {len(rooms)} rooms, {len(cycles)} cycles")
        return 1 if cycles else 0
    print("graph TD")
    for room, other in direct_arrows(rooms):
        print(f"  {room.replace('/', '.')}[{room}] --> {other.replace('/', '.')}[{other}]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
