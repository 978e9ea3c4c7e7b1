"""Damaged inputs by kind, one table; `test_damaged` runs the command line on every one."""

from damaged import folders, foreign, hdf5, scenes, specifications, tables
from damaged.case import Case

CASES: dict[str, Case] = {
    f"{kind}: {name}": case
    for kind, cases in {
        "CSV": tables.CASES,
        "foreign": foreign.CASES,
        "HDF5": hdf5.CASES,
        "specification": specifications.CASES,
        "scene": scenes.CASES,
        "folder": folders.CASES,
    }.items()
    for name, case in cases.items()
}
