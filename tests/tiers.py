"""Pytest plugin of the three tiers of tests: it measures their processor time and names slow tests without a mark.

`bash scripts/test.sh` runs the tests without `@pytest.mark.slow` and gives `--cpu-limit 2.5`: tests without the mark
whose own time is over 2.5 seconds are listed at the end. None fails by it, because machines differ in speed. A test's
own time is the processor time of its body, in this process and in children that it waited for. The clock on the wall is
not used, because machines are shared; fixtures do not count, because many tests share them.
"""

import resource
from collections.abc import Iterator

import pytest

from tests.compiled_code import ROOMS


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cpu-limit", type=float, metavar="S", help="list tests over S s of processor time if not slow")
    parser.addoption("--cpu-times", type=int, metavar="N", help="list the N tests that take the most processor time")


def processor_seconds() -> float:
    """Seconds that this process and its finished children have computed so far."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def compiled() -> set[tuple[str, int]]:
    """Files of numba's compiled code, with the time of their last change.

    A test in which they change has compiled for all others, and is not judged.
    """
    return {(str(path), path.stat().st_mtime_ns) for room in ROOMS for path in room.glob("__pycache__/*.nb?")}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the single cases of a parametrized test that its `slow_cases` names; what is full is slow, too."""
    for item in items:
        named = [case for mark in item.iter_markers("slow_cases") for case in mark.args]
        if item.get_closest_marker("full") or (named and item.callspec.id in named):  # type: ignore[attr-defined]
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    before, known = processor_seconds(), compiled()
    result = yield
    seconds = processor_seconds() - before
    item.user_properties.append(("cpu", seconds))
    limit = item.config.option.cpu_limit
    over = bool(limit) and seconds > limit and compiled() == known and item.get_closest_marker("slow") is None
    item.user_properties.append(("over the limit", over))
    return result


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    reports = [report for name in ("passed", "failed") for report in terminalreporter.stats.get(name, [])]
    measured = [(dict(report.user_properties), report.nodeid) for report in reports if report.user_properties]
    times = sorted(((facts["cpu"], name) for facts, name in measured), reverse=True)
    if config.option.cpu_times:
        terminalreporter.section(f"processor time: {sum(seconds for seconds, _ in times):.0f} s in {len(times)} tests")
        for seconds, name in times[: config.option.cpu_times]:
            terminalreporter.line(f"{seconds:7.2f} s  {name}")
    if over := [(facts["cpu"], name) for facts, name in measured if facts["over the limit"]]:
        terminalreporter.section(f"over {config.option.cpu_limit:g} s on this machine, and not marked slow")
        terminalreporter.line("If it is so on a fast machine, make the test faster or mark it @pytest.mark.slow.")
        for seconds, name in sorted(over, reverse=True):
            terminalreporter.line(f"{seconds:7.2f} s  {name}")
