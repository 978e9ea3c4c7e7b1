"""What the tests cost: rows, compiled programs and processor time, by file.

A plugin of conftest.py. `--costs` prints a line a file after the run, the dearest first. With
`--programs N` the run fails where it compiled more than N programs in all: compiling and tracing
take nine tenths of the suite's time, and their number, unlike seconds, is the same on any machine.
"""

import collections
import os

import jax
import pytest

#: Programs compiled and seconds of processor time (also of commands that tests start) when the last
#: phase ended.
_last = [0, 0.0]
_compiled = 0
_by_file: dict = collections.defaultdict(lambda: [0, 0, 0.0])


def _count(event, duration, **_):
    global _compiled
    _compiled += event == "/jax/core/compile/backend_compile_duration"


jax.monitoring.register_event_duration_secs_listener(_count)


def pytest_addoption(parser):
    parser.addoption("--costs", action="store_true", help="a line a file: rows, programs, seconds")
    parser.addoption("--programs", type=int, help="fail where more programs are compiled")


def pytest_collection_finish():
    _last[:] = _compiled, sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Each report takes along what its phase cost, also from a worker to the main process."""
    report = yield
    now = _compiled, sum(os.times()[:4])
    report.cost = [now[0] - _last[0], now[1] - _last[1]]
    _last[:] = now
    return report


def pytest_runtest_logreport(report):
    programs, seconds = getattr(report, "cost", (0, 0.0))
    costs = _by_file[report.nodeid.partition("::")[0]]
    costs[0] += report.when == "call"
    costs[1] += programs
    costs[2] += seconds


def _total():
    return [sum(column) for column in zip(*_by_file.values(), strict=True)] or [0, 0, 0.0]


def pytest_terminal_summary(terminalreporter, config):
    rows, programs, seconds = _total()
    if config.getoption("costs"):
        terminalreporter.section("rows, programs, seconds of processor time")
        for name, cost in sorted(_by_file.items(), key=lambda row: -row[1][2]):
            terminalreporter.write_line("{:5} {:5} {:7.1f} {}".format(*cost, name))
    most = config.getoption("programs")
    told = f"{rows} rows, {programs} programs, {seconds:.0f} s of processor time"
    terminalreporter.write_line(told if most is None else f"{told}; the budget is {most} programs")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    most = session.config.getoption("programs")
    if most is not None and not hasattr(session.config, "workerinput") and _total()[1] > most:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
